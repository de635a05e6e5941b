"""Samples counted up one by one, and frames that bring the variance of their pixels' means."""

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
import scenes
import shots
from bridge import relative_error, to_config, to_frame, to_params

from svgf_jax import exr, moments
from svgf_jax.accumulation import accumulate, clamp_history
from svgf_jax.color import demodulate
from svgf_jax.frames import load_sequence, open_source, read_frame
from svgf_jax.pipeline import init
from svgf_jax.sanitation import sanitise
from svgf_jax.types import Reprojected
from svgf_jax.variance import estimate_variance

KINDS = pytest.mark.parametrize("start", [moments.start_sums, moments.start_welford])
SIZE = (11, 14)


def added(start, samples):
    state = start(jnp.zeros_like(samples[0]))
    for sample in samples:
        state = moments.add_sample(state, sample)
    return state


@KINDS
def test_the_accumulators_are_the_mean_and_the_variance(start):
    samples = np.random.default_rng(0).gamma(1.0, 2.0, (7, 5, 4))
    state = added(start, samples)
    np.testing.assert_allclose(moments.mean_of(state), samples.mean(0), rtol=1e-12)
    np.testing.assert_allclose(moments.variance_of(state), samples.var(0, ddof=1), rtol=1e-12)
    np.testing.assert_allclose(moments.variance_of_mean(state), samples.var(0, ddof=1) / 7, rtol=1e-12)


@KINDS
def test_parts_merge_to_the_whole_and_too_few_samples_are_unknown(start):
    samples = np.random.default_rng(1).normal(3.0, 1.0, (9, 6))
    state = moments.merge_samples(added(start, samples[:4]), added(start, samples[4:]))
    nothing = start(jnp.zeros(6))
    state = moments.merge_samples(nothing, moments.merge_samples(state, nothing))
    np.testing.assert_allclose(moments.variance_of(state), samples.var(0, ddof=1), rtol=1e-12)
    for few in (nothing, added(start, samples[:1])):
        np.testing.assert_array_equal(moments.variance_of(few), -1.0)
        np.testing.assert_array_equal(moments.variance_of_mean(few), -1.0)
    some = jnp.arange(6) < 3
    more = moments.add_sample(state, jnp.where(some, 2.0, jnp.nan), where=some)
    np.testing.assert_array_equal(more.number, [10, 10, 10, 9, 9, 9])
    np.testing.assert_allclose(moments.mean_of(more)[3:], samples.mean(0)[3:])
    assert np.isfinite(moments.variance_of(more)).all()


def test_sums_cancel_where_welford_does_not():
    samples = (4096.0 + np.random.default_rng(2).normal(0.0, 0.1, (16, 500))).astype(np.float32)
    true = samples.astype(np.float64).var(0, ddof=1)
    sums, welford = (
        np.asarray(moments.variance_of(added(start, jnp.asarray(samples))))
        for start in (moments.start_sums, moments.start_welford)
    )
    assert np.abs(welford / true - 1).max() < 1e-2
    assert np.median(np.abs(sums / true - 1)) >= 1
    assert (sums >= 0).all()


def test_two_kinds_do_not_merge():
    with pytest.raises(TypeError, match="Sums with Welford"):
        moments.merge_samples(moments.start_sums(jnp.zeros(2)), moments.start_welford(jnp.zeros(2)))


def measured_case(estimator):
    """A frame in mid-sequence with measured variances: what goes in, and accumulated moments and variance by plain loops."""
    frames = scenes.synthetic(3, *SIZE, frames=5)
    params = oracle.PAPER | {"short_history_boost": 2.0, "sigma_normal": 16.0, "initial_variance": 7.0}
    params |= {"variance_scale": 3.0}
    history = oracle.denoise(frames[:-1], params, {"levels": 1, "feedback_level": 0})[-1]["history"]
    raw = frames[-1]
    rng = np.random.default_rng(0)
    raw["variance"] = rng.gamma(1.0, 1.0, (2, *SIZE)) * (rng.random((2, *SIZE)) < 0.9)
    raw["variance"][0, rng.random(SIZE) < 0.1] = np.nan
    raw["variance"][1, rng.random(SIZE) < 0.1] = -3.0
    clean, usable, _ = oracle.sanitise({k: v for k, v in raw.items() if k != "variance"})
    taps = oracle.reproject_taps(clean, usable, history, params)
    surface = clean["object_id"] != -1
    light = np.where(surface[None, ..., None], oracle.demodulate(clean["radiance"], clean["albedo"], 1e-3), 0)
    _, second, length, valid = oracle.accumulate(light, taps, history, surface.tolist(), params)
    prev = np.stack([oracle.gather(taps, history["moments"][s]) for s in range(2)])
    known = np.isfinite(raw["variance"]) & (raw["variance"] >= 0)
    for s, y, x in np.argwhere(known & surface):
        a = max(params["alpha_moments"], 1 / length[y, x]) if valid[y, x] else 1.0
        before = max(0.0, prev[s, y, x, 1] - prev[s, y, x, 0] ** 2)
        of_radiance, of_light = (oracle.luminance(colors[s, y, x]) for colors in (clean["radiance"], light))
        v = raw["variance"][s, y, x] * ((of_light / of_radiance) ** 2 if of_radiance > 0 else 1.0)
        second[s, y, x, 1] = second[s, y, x, 0] ** 2 + (1 - a) * before + a * v
    depth, normal = clean["depth"].tolist(), clean["normal"].tolist()
    gradient = oracle.depth_gradient(depth, clean["object_id"].tolist())
    own = np.maximum(0, second[..., 1] - second[..., 0] ** 2)
    all_known = known.all(axis=0)
    if estimator == "temporal":
        new = (length < 1 + 1e-3) & ~all_known
        variance = np.where(surface, np.where(new, 7.0, 3.0 * own), 0)
    else:
        around = np.zeros_like(own)
        for y, x in np.argwhere(surface):
            around[:, y, x] = window_mean(own, surface & all_known, (y, x), depth, normal, gradient, params)
        variance = np.where(surface, np.where((length >= 4 - 1e-3) & (estimator == "svgf"), own, around), 0)
    previous = Reprojected(
        illumination=np.stack([oracle.gather(taps, s) for s in history["illumination"]]),
        moments=prev,
        history_length=oracle.gather(taps, history["history_length"]),
        valid=valid,
    )
    return raw, light, previous, params, second, length, variance


def window_mean(own, counts, at, depth, normal, gradient, params):
    """The mean of the variances of the known neighbours; the pixel's own if there is none."""
    y, x = at
    total, weights = np.zeros(len(own)), 0.0
    for qy in range(max(y - 3, 0), min(y + 4, SIZE[0])):
        for qx in range(max(x - 3, 0), min(x + 4, SIZE[1])):
            if not counts[qy, qx]:
                continue
            w = oracle.depth_weight(depth[y][x], depth[qy][qx], gradient[y][x], qx - x, qy - y, 1.0, 1e-3)
            w *= oracle.normal_weight(normal[y][x], normal[qy][qx], params["sigma_normal"])
            weights, total = weights + w, total + w * own[:, qy, qx]
    return total / weights if weights > 1e-15 else own[:, y, x]


@pytest.mark.parametrize("estimator", ["svgf", "spatial"])
def test_a_frame_whose_variance_is_nowhere_known_counts_as_one_without(estimator):
    rng = np.random.default_rng(4)
    frame, _ = sanitise(to_frame(scenes.synthetic(5, *SIZE, frames=1)[0]))
    first = jnp.asarray(rng.gamma(1.0, 1.0, (2, *SIZE)))
    pairs = jnp.stack([first, first**2 + rng.gamma(1.0, 1.0, (2, *SIZE))], axis=-1)
    length = jnp.asarray(rng.uniform(1, 6, SIZE))
    estimate = jax.jit(
        lambda frame: estimate_variance(
            pairs,
            length,
            frame,
            params=to_params({"short_history_boost": 4.0}),
            config=to_config({"variance": estimator}),
        )
    )
    unknown = frame._replace(variance=jnp.full((2, *SIZE), -1.0))
    np.testing.assert_allclose(estimate(unknown), estimate(frame), rtol=1e-12)
    assert estimate(frame)[:, frame.object_id != -1].min() > 0
    y, x = np.argwhere((frame.object_id != -1) & (length < 3))[0]
    one = estimate(frame._replace(variance=unknown.variance.at[:, y, x].set(1.0)))
    np.testing.assert_allclose(one[:, y, x], pairs[:, y, x, 1] - first[:, y, x] ** 2)  # the only neighbour that counts
    assert np.isclose(one[0], one[0, y, x]).sum() > 1  # and what its neighbours take, however little it weighs there


@pytest.mark.parametrize("estimator", ["svgf", "spatial", "temporal"])
def test_measured_variances_against_plain_loops(estimator):
    raw, light, previous, params, second, length, variance = measured_case(estimator)
    config = to_config({"variance": estimator})

    def both(frame, light, previous, params):
        frame, _ = sanitise(frame)
        accumulated = accumulate(light, previous, frame, params=params)
        lengths = accumulated.history_length
        return accumulated, estimate_variance(accumulated.moments, lengths, frame, params=params, config=config)

    go = jax.jit(both)
    accumulated, got = go(to_frame(raw), light, previous, to_params(params))
    assert (length >= 4 - 1e-3).any()
    assert ((length > 0) & (length < 4 - 1e-3)).any()
    assert relative_error(accumulated.moments, second).max() < 1e-9
    assert relative_error(got, variance, size=second[..., 1].max()).max() < 1e-9


def test_a_nearly_black_radiance_makes_no_infinite_variance():
    """The deviation is demodulated as the luminance was, by a factor of 2**30 at most."""
    frame = to_frame(scenes.flat(1, 2, radiance=1e-12) | {"variance": np.full((1, 1, 2), 4.0)})
    nothing = Reprojected(np.zeros((1, 1, 2, 3)), np.zeros((1, 1, 2, 2)), np.zeros((1, 2)), np.zeros((1, 2), bool))
    got = accumulate(np.full((1, 1, 2, 3), 1.0), nothing, frame, params=to_params(oracle.PAPER))
    np.testing.assert_allclose(got.moments[0, 0, :, 1], 1.0 + 4.0 * 2.0**60, rtol=1e-12)


def test_where_there_is_no_history_the_clamp_leaves_nothing():
    frame = to_frame(scenes.flat(3, 4))
    valid = np.arange(12).reshape(3, 4) % 3 > 0
    past = Reprojected(np.zeros((1, 3, 4, 3)), np.zeros((1, 3, 4, 2)), np.zeros((3, 4)), valid)
    config = to_config({"clamp_radius": 1})
    light = np.full((1, 3, 4, 3), 2.0)
    got = clamp_history(past, light, frame, params=to_params(oracle.PAPER), config=config, strip_rows=None)
    np.testing.assert_allclose(got.illumination[0, ..., 0], np.where(valid, 2.0, 0.0))


SAMPLES, FRAMES = 4, 6


def test_the_variance_of_the_pixels_mean_is_unbiased():
    """Four samples a pixel on a still wall in stripes of light: V is on average the true variance of the mean, from frame 1 on."""
    rng = np.random.default_rng(5)
    size, albedo = (36, 40), 0.25
    level = 0.5 + 2.0 * (np.arange(size[1]) % 2) * np.ones(size)
    true = (level**2) / SAMPLES  # exponential samples
    frame = scenes.flat(*size, albedo=albedo)

    def both(frame, previous, params):
        light = demodulate(frame.radiance, frame.albedo)
        accumulated = accumulate(light, previous, frame, params=params)
        length = accumulated.history_length
        variance = estimate_variance(accumulated.moments, length, frame, params=params)
        return Reprojected(*accumulated, valid=jnp.ones_like(length, bool)), variance

    go = jax.jit(both)
    empty = init(to_frame(frame))
    nothing = Reprojected(empty.illumination, empty.moments, empty.history_length, jnp.zeros(size, bool))
    previous = nothing
    for _ in range(FRAMES):
        samples = albedo * level * rng.exponential(1.0, (SAMPLES, *size))
        state = added(moments.start_welford, jnp.asarray(samples))
        frame["radiance"] = np.repeat(np.asarray(moments.mean_of(state))[None, ..., None], 3, axis=-1)
        frame["variance"] = np.asarray(moments.variance_of_mean(state))[None]
        previous, variance = go(to_frame(frame), previous, to_params(oracle.FALCOR))
        assert variance.mean() == pytest.approx(true.mean(), rel=0.05)
    _, guessed = go(to_frame(frame)._replace(variance=None), nothing, to_params(oracle.PAPER))
    assert guessed.mean() > 1.5 * true.mean(), "stripes are taken for noise"


def test_measured_variances_have_finite_gradients():
    raw, light, previous, params, *_ = measured_case("svgf")
    raw["variance"] = np.where(np.random.default_rng(0).random((2, *SIZE)) < 0.5, 1e30, 0.0)
    frame = to_frame(raw, np.float32)
    light, previous = jax.tree.map(lambda a: a.astype(np.float32) if a.dtype == float else a, (light, previous))

    def loss(variance, radiance, light, params):
        clean, _ = sanitise(frame._replace(variance=variance, radiance=radiance))
        accumulated = accumulate(light, previous, clean, params=params)
        v = estimate_variance(accumulated.moments, accumulated.history_length, clean, params=params)
        return jnp.mean(jnp.sqrt(v + 1))

    go = jax.jit(jax.value_and_grad(loss, argnums=(0, 1, 2, 3)))
    found = go(frame.variance, frame.radiance, light, to_params(params, np.float32))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


def test_measured_variances_come_out_of_files_with_their_signals(tmp_path):
    for number in (1, 2):
        shots.write_frame(tmp_path / f"a.{number:04d}.exr", number)
        image = exr.read(tmp_path / f"a.{number:04d}.exr")
        more = {f"{s}.variance": np.full(shots.SIZE, v, np.float32) for s, v in (("direct", 2), ("indirect", 3))}
        exr.write(tmp_path / f"a.{number:04d}.exr", image._replace(channels=image.channels | more))
    frames = load_sequence(tmp_path)
    assert frames.variance.shape == (2, 2, *shots.SIZE)
    np.testing.assert_array_equal(frames.variance[:, :, 0, 0], [[2, 3]] * 2)
    by_hand = read_frame(open_source(tmp_path, channel={"direct_variance": ["depth.Z"]}), 0).frame
    assert by_hand.variance[0, 0, -1] == 3.0
