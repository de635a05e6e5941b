"""Following the light: against plain loops, on steps of the light with exact statistics, and what it must leave alone."""

import functools

import bridge
import compiling
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes

import svgf_jax as sj
from svgf_jax import exr, significance
from svgf_jax.adaptation import follow_light
from svgf_jax.color import demodulate
from svgf_jax.edges import Guides
from svgf_jax.outputs import WriteOptions, compose
from svgf_jax.reprojection import reproject
from svgf_jax.sanitation import sanitise
from svgf_jax.types import Config, Params, Reprojected, at_level

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
KERNEL = np.array([1, 2, 1]) / 4
PARAMS, CONFIG = sj.preset("adaptive")


# The oracle: one pixel, one cell, one tap at a time, from the module's docstring.


def meetings(levels):
    """(sum of all paths from a cell to another)^2 over the sum of their squares, on a plane without an end."""
    paths, squares = {(0, 0): 1.0}, 1.0
    for level in range(levels):
        after = {}
        for (y, x), h in paths.items():
            for dy, dx in np.ndindex(3, 3):
                q = (y + (dy - 1) * 2**level, x + (dx - 1) * 2**level)
                after[q] = after.get(q, 0.0) + h * KERNEL[dy] * KERNEL[dx]
        paths, squares = after, squares * (KERNEL**2).sum() ** 2
    return sum(h * h for h in paths.values()) / squares


def follow_light_by_loops(previous, illumination, frame, params, size):
    ids, depth, normal = frame["object_id"], frame["depth"], frame["normal"]
    height, width = depth.shape
    slope = slopes(depth, ids)
    rows, columns = -(-height // size), -(-width // size)

    def weight(p, q):
        if ids[p] == -1 or ids[q] == -1:
            return 0.0
        dy, dx = q[0] - p[0], q[1] - p[1]
        tolerance = params.sigma_depth * abs(slope[p] @ [dx, dy]) + params.depth_epsilon * depth[p]
        cosine = normal[p] @ normal[q]
        if cosine <= 1e-30:
            return 0.0
        return np.exp(-abs(depth[p] - depth[q]) / tolerance) * cosine**params.light_sigma_normal

    def inside(p):
        return 0 <= p[0] < height and 0 <= p[1] < width

    def centre(cell):
        return (cell[0] * size + size // 2, cell[1] * size + size // 2)

    cells = [(i, j) for i in range(rows) for j in range(columns) if inside(centre((i, j)))]
    out = {k: np.array(v) for k, v in previous.items() if k != "change"}
    out["change"] = np.zeros(illumination.shape[:3])
    worth = out["effective_history"]
    for signal in range(len(illumination)):
        current, history = illumination[signal], previous["illumination"][signal]
        # Sums over each cell's own pixels: weight, weight^2, and the weighted samples themselves.
        sums = {}
        for cell in cells:
            found = []
            for y in range(cell[0] * size, min(height, cell[0] * size + size)):
                for x in range(cell[1] * size, min(width, cell[1] * size + size)):
                    if previous["valid"][y, x]:
                        m1, m2 = previous["moments"][signal, y, x]
                        noise = max(0.0, m2 - m1**2)
                        found.append((weight(centre(cell), (y, x)), current[y, x], history[y, x], noise))
            sums[cell] = found

        def pooled(levels, gain, luminance_gain, sums=sums):
            """Mean current and corrected previous color, mean squared difference, 1 / effective number, per cell."""
            state = {}
            for cell, samples in sums.items():
                total = np.zeros(10)
                for w, i, h, noise in samples:
                    difference = i @ LUMINANCE - luminance_gain[cell] * (h @ LUMINANCE)
                    total += w * np.array(
                        [1, w, *i, *(gain[cell] * h), difference**2, luminance_gain[cell] ** 2 * noise]
                    )
                state[cell] = total
            for level in range(levels):
                after = {}
                for cell in state:
                    total = np.zeros(10)
                    for dy in range(-1, 2):
                        for dx in range(-1, 2):
                            q = (cell[0] + dy * 2**level, cell[1] + dx * 2**level)
                            if q in state:
                                w = KERNEL[dy + 1] * KERNEL[dx + 1] * weight(centre(cell), centre(q))
                                total += w * np.array([1, w, *[1] * 8]) * state[q]
                    after[cell] = total
                state = after
            shared = meetings(levels)
            return {
                cell: (t[2:5] / t[0], t[5:8] / t[0], t[8:] / t[0], min(1.0, shared * t[1] / t[0] ** 2))
                if t[0] > 1e-12
                else (np.zeros(3), np.zeros(3), np.zeros(2), 1.0)
                for cell, t in state.items()
            }

        def significant(i, h, square, share, threshold):
            change = (i @ LUMINANCE - h @ LUMINANCE) ** 2
            variance = max(0.0, square[0] - change)
            noise = threshold**2 * share * max(variance, square[1])
            return (1 - (noise / change) ** 2 if change > noise + 1e-12 else 0.0), variance

        def ratio(i, h, scale, s):
            return 1 + s * (np.clip((i + 0.01 * scale) / (h + 0.01 * scale), 1 / 50, 50) - 1) if scale > 1e-6 else 1.0

        gain, luminance_gain = {c: np.ones(3) for c in cells}, dict.fromkeys(cells, 1.0)
        surely, corrections, added = {}, {}, {}
        for cell, (i, h, square, share) in pooled(4, gain, luminance_gain).items():
            s, _ = significant(i, h, square, share, params.light_gain_threshold)
            scale = h @ LUMINANCE
            gain[cell] = np.array([ratio(a, b, scale, s) for a, b in zip(i, h, strict=True)])
            luminance_gain[cell] = ratio(i @ LUMINANCE, scale, scale, s)
            surely[cell], added[cell] = s, s**2 * share
        for cell, (i, h, square, share) in pooled(1, gain, luminance_gain).items():
            s, variance = significant(i, h, square, share, params.light_offset_threshold)
            grown = ratio(i @ LUMINANCE, h @ LUMINANCE, h @ LUMINANCE, s)
            keep = (1 - surely[cell]) * (1 - s) * (luminance_gain[cell] * grown) ** 2
            new = (1 - (1 - surely[cell]) * (1 - s)) * variance
            dimmed = max(1, 1 / grown) ** 2
            noise = [dimmed, dimmed * added[cell] + s**2 * share]
            corrections[cell] = np.array([*gain[cell], *(s * (i - h)), luminance_gain[cell], keep, new, *noise])

        known = {c for c in cells if sum(w for w, *_ in sums[c]) > 1e-12}
        for y in range(height):
            for x in range(width):
                at = ((y - size // 2) / size, (x - size // 2) / size)
                corner = (int(np.floor(at[0])), int(np.floor(at[1])))
                total, weights = np.zeros(11), 0.0
                for dy in (0, 1):
                    for dx in (0, 1):
                        q = (corner[0] + dy, corner[1] + dx)
                        if q in known:
                            part = (1 - abs(at[0] - q[0])) * (1 - abs(at[1] - q[1]))
                            w = part * weight((y, x), centre(q))
                            total, weights = total + w * corrections[q], weights + w
                if not previous["valid"][y, x] or weights <= 1e-8:
                    continue
                c = total / weights
                out["illumination"][signal, y, x] = np.maximum(0, c[:3] * history[y, x] + c[3:6])
                before, after = history[y, x] @ LUMINANCE, out["illumination"][signal, y, x] @ LUMINANCE
                out["change"][signal, y, x] = (after - before) / max(after, before, 1e-12)
                m1, m2 = previous["moments"][signal, y, x]
                variance = c[7] * max(0, m2 - m1**2) + c[8]
                m1 = max(0, c[6] * m1 + c[3:6] @ LUMINANCE)
                out["moments"][signal, y, x] = m1, variance + m1**2
                worth[signal, y, x] = 1 / (c[9] / worth[signal, y, x] + c[10])
    return out


def slopes(depth, ids):
    height, width = depth.shape
    out = np.zeros((height, width, 2))
    for y in range(height):
        for x in range(width):
            for axis, (dy, dx) in enumerate([(0, 1), (1, 0)]):
                sides = []
                for sign in (1, -1):
                    q = (y + sign * dy, x + sign * dx)
                    if 0 <= q[0] < height and 0 <= q[1] < width and ids[q] == ids[y, x]:
                        sides.append(sign * (depth[q] - depth[y, x]))
                sides.sort(key=abs)
                if len(sides) == 2 and abs(sides[0]) == abs(sides[1]):
                    out[y, x, axis] = (sides[0] + sides[1]) / 2
                elif sides:
                    out[y, x, axis] = sides[0]
    return out


@pytest.mark.parametrize("size", [4, 3])
def test_the_stage_is_what_its_docstring_says(size):
    rng = np.random.default_rng(size)
    frames = scenes.synthetic(size, 22, 19, frames=2, signals=2)
    frame, _ = sanitise(bridge.to_frame(frames[1]))
    history = sj.init(bridge.to_frame(frames[0]))._replace(
        illumination=rng.gamma(2.0, 0.5, (2, 22, 19, 3)),
        moments=np.stack([m := rng.gamma(2.0, 0.5, (2, 22, 19)), m**2 + rng.gamma(1.0, 1.0, m.shape)], axis=-1),
        history_length=np.full((22, 19), 5.0),
        depth=frames[0]["depth"],
        normal=frames[0]["normal"],
        object_id=np.asarray(frames[0]["object_id"], np.int32),
        effective_history=rng.uniform(1.0, 5.0, (2, 22, 19)),
    )
    illumination = demodulate(frame.radiance, frame.albedo)
    illumination = illumination.at[1].multiply(4.0)  # a change beyond the scene's own
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), PARAMS._replace(light_sigma_normal=20.0))
    previous = reproject(jax.tree.map(jnp.asarray, history), frame, params=params)
    previous = previous._replace(valid=previous.valid.at[6:12, 6:12].set(False))  # whole cells that can tell nothing
    stage = functools.partial(follow_light, config=Config(light_cell=size))
    got = jax.jit(stage)(previous, illumination, frame, params=params)
    plain = jax.tree.map(np.asarray, frame)._asdict()
    wanted = follow_light_by_loops(
        jax.tree.map(np.asarray, previous)._asdict(),
        np.asarray(illumination),
        plain,
        PARAMS._replace(light_sigma_normal=20.0),
        size,
    )
    assert np.abs(wanted["illumination"] - np.asarray(previous.illumination)).max() > 0.1
    assert 0.5 < np.abs(wanted["change"]).max() <= 1.0
    assert (wanted["effective_history"] < 0.9 * np.asarray(previous.effective_history)).any()
    for name in ("illumination", "moments", "change", "effective_history"):
        np.testing.assert_allclose(np.asarray(getattr(got, name)), wanted[name], rtol=1e-9, atol=1e-9)


def test_without_cells_the_history_is_left_alone():
    previous = object()
    assert follow_light(previous, None, None, params=Params(), config=Config()) is previous  # type: ignore[arg-type]


# Steps of the light on a plain wall, whose statistics are exact.

NOISES = {
    "uniform": lambda rng, shape: rng.uniform(0.0, 2.0, shape),
    "exponential": lambda rng, shape: rng.exponential(1.0, shape),
    "heavy-tailed": lambda rng, shape: rng.lognormal(-0.75, np.sqrt(1.5), shape),  # mean 1, variance 3.5
}
STEADY, AFTER = 10, 3
SHAPE = (112, 120)
# What the history gets is the first level's: further levels would only take their time.
WALL_PARAMS, WALL = (
    PARAMS._replace(**{k: v[:1] for k, v in PARAMS._asdict().items() if np.ndim(v)}),
    CONFIG._replace(levels=1),
)
assert CONFIG.feedback_level == 0


def lit(rng, noise: str, samples: int, factor: float):
    light = NOISES[noise](rng, (samples, 1, *SHAPE, 1)).mean(axis=0) * factor
    return bridge.to_frame({**scenes.flat(*SHAPE), "radiance": np.broadcast_to(light, (1, *SHAPE, 3))}, np.float32)


@functools.cache
def steady(noise: str, samples: int, config: Config = WALL):
    """The history of a wall of luminance 1 after `STEADY` frames."""
    rng = np.random.default_rng(7)
    history = sj.init(lit(rng, noise, samples, 1.0), effective_history=True)
    for _ in range(STEADY):
        history, _ = bridge.jitted_step(config)(history, lit(rng, noise, samples, 1.0), params=WALL_PARAMS)
    return history


@pytest.mark.parametrize("factor", [0.1, 2.0, 10.0])
@pytest.mark.parametrize("samples", [1, 2, 4])
@pytest.mark.parametrize("noise", list(NOISES))
def test_a_step_of_the_light_is_followed_at_once(noise, samples, factor):
    history, rng, travelled = steady(noise, samples), np.random.default_rng(8), []
    for _ in range(AFTER):
        frame = lit(rng, noise, samples, factor)
        history, output = bridge.jitted_step(WALL)(history, frame, params=WALL_PARAMS)
        travelled.append((float(output.image.mean()) - 1.0) / (factor - 1.0))
    assert min(travelled[1:]) > 0.9, travelled
    assert max(travelled[1:]) < 1.1, travelled


@pytest.mark.parametrize("noise", list(NOISES))
@pytest.mark.parametrize("samples", [1, 2, 4])
def test_steady_noise_is_not_taken_for_change(noise, samples):
    """By its variance the history is worth nearly as much as without the stage, and by the corrections' own count."""
    with_stage, without = (steady(noise, samples, config) for config in (WALL, WALL._replace(light_cell=0)))
    light = np.asarray(with_stage.illumination[0, ..., 1])
    assert np.asarray(without.illumination[0, ..., 1]).var() / light.var() > 0.9
    assert abs(light.mean() - 1.0) < 0.03
    assert (1 / without.effective_history).mean() / (1 / with_stage.effective_history).mean() > 0.97


def test_step_by_step_and_scan_agree_to_the_bit_and_bad_pixels_stay_out():
    """Compiled as users have it: what the compiler may round differently it would here."""
    frames = bridge.to_frames(scenes.synthetic(3, 29, 34, frames=3, signals=1, dirty=True), np.float32)
    lean = {"levels": 0, "variance": "temporal", "fallback": False, "reprojection": "nearest"}  # quick to compile
    config, params = Config(light_cell=4, **lean), Params()
    start = sj.init(jax.tree.map(lambda leaf: leaf[0], frames), effective_history=True)
    _, scanned = bridge.jitted_denoise(config, compiling.AS_USERS)(frames, history=start, params=params)
    history = start
    for t in range(3):
        frame = jax.tree.map(lambda leaf, t=t: leaf[t], frames)
        history, output = bridge.jitted_step(config, compiling.AS_USERS)(history, frame, params=params)
        jax.tree.map(lambda a, b, t=t: np.testing.assert_array_equal(a, b[t]), output, scanned)
        assert all(np.isfinite(a).all() for a in (output.illumination, output.change, history.moments))
    assert np.abs(output.change).max() > 0.1


def test_it_is_differentiable_in_its_parameters_and_the_history():
    """Forward and reverse mode agree with each other and are finite, with dark pixels and pixels without history."""
    frame = bridge.to_frame(scenes.synthetic(5, 17, 18, signals=1)[0])
    frame = jax.tree.map(jnp.asarray, frame)
    rng = np.random.default_rng(0)
    dimmed = rng.uniform(0.3, 0.9, frame.radiance.shape) * (rng.random((17, 18, 1)) > 0.1)
    past = frame.radiance * dimmed
    names = ("light_gain_threshold", "light_offset_threshold", "light_sigma_normal")

    def error(values, past, plain=0.0):
        params = jax.tree.map(jnp.asarray, Params(**dict(zip(names, values, strict=True))))
        first = jnp.minimum(past[..., 0], 1e150)
        moments = jnp.stack([first, first**2], axis=-1)
        known = jnp.asarray(np.arange(18)[None] != np.arange(17)[:, None])
        worth = 1.0 + jnp.log1p(first)
        previous = Reprojected(past, moments, jnp.full((17, 18), 3.0), known, effective_history=worth)
        followed = follow_light(previous, frame.radiance, frame, params=params, config=Config(light_cell=4))
        lights = (followed.illumination, followed.moments)
        told = jnp.sum(followed.change) + jnp.sum(followed.effective_history)
        return sum(jnp.sum(jnp.log1p(a)) + plain * jnp.sum(a) for a in lights) + told

    values = tuple(jnp.asarray(v, jnp.float64) for v in (1.0, 1.0, 64.0))
    gradient = jax.jit(jax.grad(error, argnums=(0, 1)))
    reverse = gradient(values, past, 0.0)
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(reverse))
    assert all(float(g) != 0.0 for g in reverse[0][:2])
    for bright in (1e60, 1e100, 1e149, 1e154, 1e277, 1e300):
        for plain in (0.0, 1.0):  # the filter's slopes need not get smaller with brighter light
            found = jax.tree.leaves(gradient(values, bright * past, plain))
            assert all(np.isfinite(g).all() for g in found), (bright, plain)
    towards = (
        tuple(jnp.asarray(v) for v in (0.3, -0.2, 1.0)),
        past * rng.normal(size=past.shape),
    )  # what is dark stays dark: 0 is a kink
    forward = jax.jit(lambda at: jax.jvp(error, at, towards))
    slope = forward((values, past))[1]
    wanted = sum(jnp.sum(g * d) for g, d in zip(jax.tree.leaves(reverse), jax.tree.leaves(towards), strict=True))
    np.testing.assert_allclose(slope, wanted, rtol=1e-8)
    delta = 1e-7
    moved = [jax.tree.map(lambda a, d, s=s: a + s * delta * d, (values, past), towards) for s in (1, -1)]
    ahead, behind = (float(forward(at)[0]) for at in moved)
    np.testing.assert_allclose(slope, (ahead - behind) / (2 * delta), rtol=1e-4)


def test_the_change_is_a_layer_among_the_diagnostics():
    ramp = np.linspace(-1.0, 1.0, 12, dtype=np.float32).reshape(3, 4)
    picture = np.zeros((3, 4, 3), np.float32)
    output = sj.Output(picture, picture[None], None, None, ramp, ramp > 0, None, change=np.stack([ramp, -ramp]))
    options = WriteOptions(diagnostics=True, full_float=True)
    image, _ = compose(
        output, exr.new_image({"Z": ramp}), options=options, signals=("direct", "indirect"), attributes={}
    )
    np.testing.assert_array_equal(image.channels["svgf.change.direct"], ramp)
    np.testing.assert_array_equal(image.channels["svgf.change.indirect"], -ramp)


@pytest.mark.parametrize("brightness", [100.0, 10000.0])
def test_a_firefly_is_no_change_of_the_light(brightness):
    """One pixel never is, however bright: it makes the difference and its error large together."""
    frame = lit(np.random.default_rng(5), "uniform", 4, 1.0)
    bright = frame.radiance.copy()
    bright[0, 55, 61] = brightness
    outputs = [
        bridge.jitted_step(WALL)(steady("uniform", 4), frame._replace(radiance=r), params=WALL_PARAMS)[1]
        for r in (frame.radiance, bright)
    ]
    changes = [np.abs(np.asarray(output.change)) for output in outputs]
    assert changes[1].max() <= changes[0].max() + 1e-3


@pytest.mark.parametrize("levels", [1, 4])
def test_the_effective_number_is_that_of_the_errors_seen(levels):
    """The variance of a pooled mean of pure noise over many trials is 1 / (effective number) of the cells' own."""
    size, trials = 37, 600
    plane = lambda value: jnp.full((size, size), value)  # noqa: E731
    guides = Guides(plane(2.0), (plane(0.0), plane(0.0), plane(-1.0)), plane(1.0))
    cells = significance.Cells(guides, (plane(0.0), plane(0.0)), plane(1.0), plane(1.0))

    def pooled(noise):
        color = (noise,) * 3
        sums = (significance.Compared(color, color, noise, noise),)
        totals = significance._pool(cells, sums, levels=levels, size=4, scalars=at_level(PARAMS, 0))
        effective, (mean,) = significance._means(*totals, levels=levels)
        return effective[size // 2, size // 2], mean.current[0][size // 2, size // 2]

    noise = np.random.default_rng(6).normal(size=(trials, size, size))
    effective, means = jax.jit(lambda n: jax.lax.map(pooled, n))(noise)
    assert np.var(means) == pytest.approx(float(effective[0]), rel=0.15)
