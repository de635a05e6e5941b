"""What the filter promises, one named test a promise. SVGF_EXAMPLES says how many examples each property is tried on."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
import scenes
from bridge import jitted_denoise, jitted_step, run, to_config, to_frame, to_frames, to_history, to_params
from compiling import AS_USERS
from hypothesis import given, settings
from hypothesis import strategies as st

from svgf_jax.pipeline import denoise, init, step
from svgf_jax.types import Config, Params

SIZE = (37, 14)  # more rows than a strip of the blocked loops has
LIGHT = {"levels": 3, "feedback_level": 0}  # enough levels to reach across the image, and quick to compile
BOTH = pytest.mark.parametrize("dtype", [np.float64, np.float32])
PROPERTY = settings(max_examples=int(os.environ.get("SVGF_EXAMPLES", "6")), deadline=None, derandomize=True)
SEEDS = st.integers(0, 10_000)


def surface_of(frame):
    return frame["object_id"] != -1


def floored(frame, floor=1e-3):
    return np.maximum(frame["albedo"], floor)


def demodulated(frame):
    return frame["radiance"] / floored(frame)


def awkward(seed, frames=5, **options):
    return scenes.synthetic(seed, *SIZE, frames=frames, **options)


def quiet(frames, illumination):
    """`frames` with the given illumination everywhere, without noise."""
    return [
        f
        | {"radiance": np.where(surface_of(f)[None, :, :, None], illumination * floored(f), 0) * np.ones((2, 1, 1, 1))}
        for f in frames
    ]


def long_history(frame, dtype=np.float64, length=32.0):
    """A history that has seen this very frame, standing still, for ever."""
    illumination = demodulated(frame)
    light = oracle.luminance(np.moveaxis(illumination, -1, 0))
    return to_history(
        {
            "illumination": illumination,
            "moments": np.stack([light, light**2], axis=-1),
            "history_length": np.full(light.shape[1:], length),
            "depth": frame["depth"],
            "normal": frame["normal"],
            "object_id": frame["object_id"],
        },
        dtype,
    )


def one_step(history, frame, params=oracle.PAPER, config=LIGHT, dtype=np.float64):
    result = jitted_step(to_config(config))(history, to_frame(frame, dtype), params=to_params(params, dtype))
    return jax.tree.map(np.asarray, result)


def assert_same_bits(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        x, y = np.asarray(x), np.asarray(y)
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)


# Fixed points


@BOTH
@given(seed=SEEDS, level=st.sampled_from([0.03125, 1.0, 64.0]))
@PROPERTY
def test_constant_illumination_is_a_fixed_point(dtype, seed, level):
    """Whatever the surfaces and their motion: light that is the same everywhere stays what it is."""
    frames = quiet(awkward(seed, frames=3), level)
    for (_, output), frame in zip(run(frames, config=LIGHT, dtype=dtype), frames, strict=True):
        surface = surface_of(frame)
        tolerance = 1e-12 if dtype == np.float64 else 2e-6
        np.testing.assert_allclose(output.illumination[:, surface], level, rtol=tolerance)
        expected = frame["emission"] + (level * floored(frame) * np.ones((2, 1, 1, 1))).sum(axis=0)
        np.testing.assert_allclose(output.image[surface], expected[surface], rtol=10 * tolerance)


@BOTH
def test_a_noise_free_static_scene_stays_as_it_is(dtype):
    """Once there is history: equal frames, so no variance, so nothing is blurred, however the light varies in space."""
    frame = scenes.flat(*SIZE, signals=2, albedo=0.5)
    steps = np.random.default_rng(0).permutation(SIZE[0] * SIZE[1]).reshape(SIZE)  # no two pixels alike
    frame["radiance"] *= (0.5 + steps / steps.size)[None, :, :, None]
    history = long_history(frame, dtype)
    for _ in range(20):
        history, output = one_step(history, frame, dtype=dtype)
    beauty = frame["radiance"].sum(axis=0)
    # The variance is the rounding of M2 - M1^2; its root lets in neighbours of almost equal value: sqrt(eps), not eps.
    np.testing.assert_allclose(output.image, beauty, rtol=1e-12 if dtype == np.float64 else 2e-3)


@BOTH
def test_a_noise_free_static_scene_of_flat_objects_stays_as_it_is_from_the_first_frame(dtype):
    """Objects at different depths, each lit evenly, no history needed: guides alone keep them apart."""
    frames = scenes.synthetic(5, *SIZE, frames=1, moving=False) * 8
    ids = frames[0]["object_id"]
    depth = 4.0 + 4.0 * (ids + 1)
    light = 1.0 + 0.25 * ids[None, :, :, None]
    frames = [f | {"depth": depth, "prev_depth": depth, "motion": np.zeros((*SIZE, 2))} for f in quiet(frames, light)]
    for (_, output), frame in zip(run(frames, config=LIGHT, dtype=dtype), frames, strict=True):
        expected = frame["radiance"].sum(axis=0) + frame["emission"]
        np.testing.assert_allclose(output.image, expected, rtol=1e-12 if dtype == np.float64 else 1e-5)


# Bounds and scaling


@BOTH
@given(seed=SEEDS, alpha=st.sampled_from([0.05, 0.5, 1.0]), boost=st.sampled_from([1.0, 4.0]))
@PROPERTY
def test_the_output_lies_between_the_smallest_and_the_largest_input(dtype, seed, alpha, boost):
    frames = awkward(seed, frames=3)
    params = oracle.PAPER | {"alpha": alpha, "short_history_boost": boost}
    low, high = np.inf, -np.inf
    for (_, output), frame in zip(run(frames, params, LIGHT, dtype), frames, strict=True):
        surface = surface_of(frame)
        light = demodulated(frame)[:, surface]
        low, high = np.minimum(low, light.min(axis=1)), np.maximum(high, light.max(axis=1))
        slack = 1e-5 if dtype == np.float32 else 1e-12
        got = output.illumination[:, surface]
        assert (got >= low[:, None] * (1 - slack)).all()
        assert (got <= high[:, None] * (1 + slack)).all()
        assert (output.variance >= 0).all()
        assert (output.variance_filtered >= 0).all()


def test_a_uniform_level_scales_the_variance_by_35_over_128_squared():
    height, width = 7, 8
    frame = scenes.flat(height, width, signals=2, radiance=3.0)
    history = long_history(frame)
    moments = np.asarray(history.moments).copy()
    moments[..., 1] += 2.5  # M2 = l^2 + 2.5 before, so V = (1 - alpha_moments) 2.5 now
    _, output = one_step(history._replace(moments=moments), frame, config={"levels": 1, "feedback_level": 0})
    np.testing.assert_allclose(output.variance, 2.0, rtol=1e-12)
    np.testing.assert_allclose(output.variance_filtered[:, 2:-2, 2:-2], 2.0 * (35 / 128) ** 2, rtol=1e-12)


@given(seed=SEEDS)
@PROPERTY
def test_scaling_the_radiance_scales_the_output(seed):
    """By a power of two to the bit; luminance_epsilon is a luminance and is scaled as well."""
    frames = awkward(seed, frames=3)
    for factor, exact in ((8.0, True), (0.3, False)):
        scaled = [f | {"radiance": factor * f["radiance"], "emission": factor * f["emission"]} for f in frames]
        params = oracle.PAPER | {"luminance_epsilon": factor * oracle.PAPER["luminance_epsilon"]}
        for (_, a), (_, b) in zip(run(frames, config=LIGHT), run(scaled, params, LIGHT), strict=True):
            if exact:
                np.testing.assert_array_equal(b.image, factor * a.image)
                np.testing.assert_array_equal(b.variance, factor**2 * a.variance)
            else:
                np.testing.assert_allclose(b.image, factor * a.image, rtol=1e-9, atol=1e-12)


# Symmetries


def flipped(array, axis):
    """An image `[..., H, W]` mirrored along axis "x" or "y"."""
    return np.flip(array, axis={"x": -1, "y": -2}[axis])


def flip_frame(frame, axis):
    """Every channel, `[H, W]` or `[..., H, W, C]`, mirrored, and the motion turned round."""
    out = {k: np.flip(v, axis={"x": 1, "y": 0}[axis] + max(v.ndim - 3, 0)) for k, v in frame.items()}
    out["motion"] = out["motion"] * (np.array([-1.0, 1.0]) if axis == "x" else np.array([1.0, -1.0]))
    return out


@pytest.mark.parametrize("axis", ["x", "y"])
@given(seed=SEEDS)
@PROPERTY
def test_flips_commute_with_the_filter(axis, seed):
    """Exact ties in the depth gradient (the scene's ridge) included: picking a side would show here."""
    frames = awkward(seed, frames=3)
    mirrored = [flip_frame(f, axis) for f in frames]
    for (_, a), (_, b) in zip(run(frames, config=LIGHT), run(mirrored, config=LIGHT), strict=True):
        np.testing.assert_allclose(b.variance, flipped(a.variance, axis), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(b.history_length, flipped(a.history_length, axis), rtol=1e-9)
        np.testing.assert_allclose(b.image, np.flip(a.image, {"x": 1, "y": 0}[axis]), rtol=1e-9, atol=1e-12)


def test_a_tie_in_the_depth_gradient_takes_no_side():
    """A tent seen from the front: both halves weigh the same, whichever way it is read."""
    frame = scenes.flat(3, 9, depth=4.0)
    frame["depth"] = 4.0 + 0.25 * np.abs(np.arange(9.0) - 4) * np.ones((3, 1))
    rng = np.random.default_rng(0)
    half = rng.gamma(1.0, 1.0, (1, 3, 5, 3))
    frame["radiance"] = np.concatenate([half, half[:, :, 3::-1]], axis=2)
    frame["prev_depth"] = frame["depth"]
    ((_, output),) = run([frame], config=LIGHT)
    np.testing.assert_allclose(output.image, output.image[:, ::-1], rtol=1e-12)


@given(seed=SEEDS)
@PROPERTY
def test_signals_do_not_touch_each_other(seed):
    frames = awkward(seed, frames=3)
    swapped = [f | {"radiance": f["radiance"][::-1]} for f in frames]
    runs = (run(f, config=LIGHT, dtype=np.float32, options=AS_USERS) for f in (frames, swapped))
    for (_, a), (_, b) in zip(*runs, strict=True):
        np.testing.assert_array_equal(b.illumination, a.illumination[::-1])
        np.testing.assert_array_equal(b.variance, a.variance[::-1])


def test_one_albedo_for_all_signals_is_the_same_albedo_for_each():
    frames = awkward(3, frames=3)
    each = [f | {"albedo": np.repeat(f["albedo"], 2, axis=0)} for f in frames]
    for (_, a), (_, b) in zip(run(frames, config=LIGHT), run(each, config=LIGHT), strict=True):
        np.testing.assert_allclose(b.image, a.image, rtol=1e-12)


@given(seed=SEEDS)
@PROPERTY
def test_object_ids_are_names_not_numbers(seed):
    frames = awkward(seed, frames=3)
    renamed = [f | {"object_id": np.where(surface_of(f), 2_000_000_011 - 3 * f["object_id"], -1)} for f in frames]
    for a, b in zip(run(frames, config=LIGHT), run(renamed, config=LIGHT), strict=True):
        assert_same_bits(a[1], b[1])


# Background, black, borders


@BOTH
@given(seed=SEEDS)
@PROPERTY
def test_background_passes_through_untouched(dtype, seed):
    frames = awkward(seed, frames=3)
    for frame in frames:
        frame["object_id"][-2:, -3:] = -1
        frame["radiance"][:, ~surface_of(frame)] = 0.125
    for (history, output), frame in zip(run(frames, config=LIGHT, dtype=dtype), frames, strict=True):
        background = ~surface_of(frame)
        beauty = (frame["radiance"].sum(axis=0).astype(dtype) + frame["emission"].astype(dtype))[background]
        np.testing.assert_array_equal(output.image[background], beauty)
        for plane in (output.illumination, output.variance, output.variance_filtered, history.moments):
            assert not plane[:, background].any()
        assert not history.illumination[:, background].any()
        assert not output.history_length[background].any()
        assert not output.valid[background].any()


@given(seed=SEEDS)
@PROPERTY
def test_background_gives_nothing_to_the_surfaces(seed):
    """Nothing written where there is no surface, be it huge or NaN, changes a surface pixel by one bit."""
    frames = awkward(seed, frames=3)
    for frame in frames:
        frame["object_id"][-2:, -3:] = -1
    filled = []
    for frame in frames:
        background = ~surface_of(frame)
        other = {k: v.copy() for k, v in frame.items()}
        other["radiance"][:, background] = 1e6
        for name, value in (("normal", np.nan), ("depth", np.inf), ("prev_depth", -1e9), ("motion", np.nan)):
            other[name][background] = value
        other["albedo"][:, background] = np.nan
        filled.append(other)
    for (_, a), (_, b), frame in zip(run(frames, config=LIGHT), run(filled, config=LIGHT), frames, strict=True):
        np.testing.assert_array_equal(a.image[surface_of(frame)], b.image[surface_of(frame)])
        np.testing.assert_array_equal(a.variance, b.variance)
        np.testing.assert_array_equal(a.history_length, b.history_length)
        assert np.isfinite(b.image).all()


@BOTH
@pytest.mark.parametrize("black", [0.0, 1e-5, 1e-3])
def test_black_albedo_is_finite_and_lossless(dtype, black):
    """Divided and multiplied by the same floored albedo: no light is lost where it is 0."""
    frame = awkward(2, frames=1)[0]
    frame["albedo"] = np.where(frame["albedo"] < 0.4, black, frame["albedo"])
    frame["radiance"] = np.where(surface_of(frame)[None, :, :, None], frame["radiance"] + 0.25, 0.0)
    ((_, output),) = run([frame], config={"levels": 0, "feedback_level": 0}, dtype=dtype)
    beauty = frame["radiance"].sum(axis=0) + frame["emission"]
    np.testing.assert_allclose(output.image, beauty, rtol=4 * np.finfo(dtype).eps)
    for _, output in run([frame] * 3, config=LIGHT, dtype=dtype):
        assert np.isfinite(output.image).all()


@BOTH
def test_every_pixel_of_the_border_gets_history(dtype):
    """Standing still, the first row and column accumulate like all others."""
    frames = [scenes.flat(*SIZE, signals=2)] * 6
    for t, (_, output) in enumerate(run(frames, config=LIGHT, dtype=dtype)):
        np.testing.assert_array_equal(output.history_length, t + 1.0)
        assert output.valid.all() == (t > 0)


@BOTH
def test_history_of_four_frames_is_told_with_slack(dtype):
    """h is a mean of whole numbers: 3.9995 means 4 and takes the past's variance, 3.99 the neighbourhood's."""
    frame = scenes.flat(*SIZE, signals=2)
    history = long_history(frame, dtype)
    moments = np.asarray(history.moments).copy()
    moments[..., 1] += np.linspace(0, 1, SIZE[1], dtype=dtype)  # so that the two estimates differ
    config = {"levels": 0, "feedback_level": 0}
    for length, temporal in ((2.9995, True), (3.0 - 4e-7, True), (3.0, True), (2.99, False), (2.0, False)):
        start = history._replace(moments=moments, history_length=np.full(SIZE, length, dtype))
        new, output = one_step(start, frame, config=config, dtype=dtype)
        of_the_past = np.maximum(0, new.moments[..., 1] - new.moments[..., 0] ** 2)
        assert np.allclose(output.variance, of_the_past, atol=1e-5) == temporal


# Bad pixels


@BOTH
@given(seed=SEEDS)
@PROPERTY
def test_bad_pixels_are_counted_and_never_come_out(dtype, seed):
    frames = awkward(seed, frames=3, dirty=True)
    for (history, output), frame in zip(run(frames, config=LIGHT, dtype=dtype), frames, strict=True):
        rejected = {k: int(v) for k, v in output.rejected._asdict().items()}
        assert rejected == oracle.sanitise(frame)[2]
        floats = [x for x in jax.tree.leaves((history._replace(depth=(), normal=()), output)) if x.dtype.kind == "f"]
        assert all(np.isfinite(x).all() for x in floats)
    clean = run(awkward(seed, frames=1), config=LIGHT, dtype=dtype)[0][1].rejected
    assert not any(int(v) for v in clean)


# Transformations of the program


def test_step_by_step_and_denoise_agree_to_the_bit():
    frames = awkward(21, frames=3, dirty=True)
    results = run(frames, config=LIGHT, dtype=np.float32, options=AS_USERS)
    history, outputs = whole_sequence(to_frames(frames, np.float32))
    assert_same_bits(history, results[-1][0])
    for t, (_, output) in enumerate(results):
        assert_same_bits(jax.tree.map(lambda leaf, t=t: leaf[t], outputs), output)


def whole_sequence(frames, history=None):
    """As users compile it."""
    history = init(jax.tree.map(lambda leaf: leaf[0], frames)) if history is None else history
    params = to_params(oracle.PAPER, np.float32)
    return jitted_denoise(to_config(LIGHT), AS_USERS)(frames, history=history, params=params)


def test_a_scan_in_pieces_of_one_frame_agrees_to_the_bit():
    frames = to_frames(awkward(22, frames=3), np.float32)
    end, outputs = whole_sequence(frames)
    history = None
    for t in range(3):
        history, output = whole_sequence(jax.tree.map(lambda leaf, t=t: leaf[t : t + 1], frames), history)
        assert_same_bits(output, jax.tree.map(lambda leaf, t=t: leaf[t : t + 1], outputs))
    assert_same_bits(history, end)


def test_vmap_over_a_batch_is_the_loop_over_it():
    sequences = [to_frames(awkward(seed, frames=3)) for seed in (31, 32, 33)]
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *sequences)
    go = jax.vmap(lambda frames: denoise(frames, params=to_params(oracle.PAPER), config=to_config(LIGHT)))
    _, outputs = jax.jit(go)(batch)
    for i, frames in enumerate(sequences):
        close = lambda a, b, i=i: np.testing.assert_allclose(np.asarray(a)[i], b, rtol=1e-11, atol=1e-11)  # noqa: E731
        jax.tree.map(close, outputs, jitted_denoise(to_config(LIGHT))(frames, params=to_params(oracle.PAPER))[1])


def test_parameters_may_be_vmapped_over():
    """A sweep over a parameter in one call."""
    frame = to_frame(awkward(34, frames=1)[0])
    config, paper = to_config(LIGHT), to_params(oracle.PAPER)
    floors = jnp.array([1e-3, 0.5])
    go = jax.vmap(lambda floor: step(init(frame), frame, params=paper._replace(albedo_floor=floor), config=config))
    _, outputs = jax.jit(go)(floors)
    for i in range(2):
        _, expected = one_step(init(frame), frame._asdict(), oracle.PAPER | {"albedo_floor": floors[i]})
        np.testing.assert_allclose(outputs.image[i], expected.image, rtol=1e-11, atol=1e-11)


@BOTH
def test_default_parameters_keep_the_type_of_the_frame(dtype):
    frame = to_frame(awkward(1, frames=1)[0], dtype)
    config = to_config(LIGHT)
    history, output = jax.eval_shape(lambda f: step(init(f), f, params=Params(), config=config), frame)
    leaves = [leaf for leaf in jax.tree.leaves((history, output)) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    assert {leaf.dtype for leaf in leaves} == {np.dtype(dtype)}
    started = jax.eval_shape(init, frame)
    same = jax.tree.map(lambda a, b: (a.shape, a.dtype) == (b.shape, b.dtype), started, history)
    assert all(jax.tree.leaves(same))


def test_config_is_hashable_and_the_default_is_the_paper():
    assert {Config()} == {to_config(oracle.PAPER_CONFIG)}
    assert {name: getattr(Params(), name) for name in oracle.PAPER} == pytest.approx(oracle.PAPER)
