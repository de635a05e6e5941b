"""Every public stage alone against the oracle's, on one frame in the middle of an awkward sequence.

The stages are read from their modules when a test runs, so that `test_mutants` can put a broken module in their place.
"""

import functools
import types

import jax
import numpy as np
import oracle
import oracle_taa
import pytest
import scenes
from bridge import relative_error, to_config, to_frame, to_history, to_params

from svgf_jax import accumulation, antialiasing, atrous, color, edges, pipeline, reprojection, sanitation, variance
from svgf_jax.types import Reprojected, TaaHistory

SIZE = (11, 14)
CONFIG = {"levels": 2, "feedback_level": 0}
PARAMS = oracle.PAPER | {
    "short_history_boost": 2.0,
    "alpha": [0.3, 0.9],
    "alpha_moments": 0.25,
    "sigma_depth": [2.0, 3.0],
    "sigma_normal": [16.0, 64.0],
    "sigma_luminance": [8.0, 2.0],
    "depth_epsilon": [1e-2, 3e-2],
    "luminance_epsilon": [1e-3, 1e-2],
    "max_history": 3.5,
    "albedo_floor": 2e-3,
    "kernel_near": [0.7, 0.5],
    "kernel_far": [0.2, 0.3],
}


@functools.cache
def case():
    """What goes into and comes out of every stage of the oracle, for the last frame of a sequence."""
    frames = scenes.synthetic(3, *SIZE, frames=5)
    for frame in frames:
        frame["object_id"][frame["object_id"] == 1] = -7  # a name like any other: -1 alone is no surface
    history = oracle.denoise(frames[:-1], PARAMS, CONFIG)[-1]["history"]
    c = types.SimpleNamespace(history=history, raw=frames[-1], params=to_params(PARAMS))
    rng = np.random.default_rng(0)
    c.history["history_length"] = np.where(history["object_id"] == -1, 0, rng.choice([1.0, 1.7, 2.0, 3.0], SIZE))
    c.clean, c.usable, _ = oracle.sanitise(c.raw)
    c.frame = to_frame(c.clean)
    c.surface = (c.clean["object_id"] != -1).tolist()
    c.depth, c.normal = c.clean["depth"].tolist(), c.clean["normal"].tolist()
    c.gradient = oracle.depth_gradient(c.depth, c.clean["object_id"].tolist())
    light = oracle.demodulate(c.clean["radiance"], c.clean["albedo"], PARAMS["albedo_floor"])
    c.illumination = np.where(np.array(c.surface)[None, ..., None], light, 0)
    c.taps = oracle.reproject_taps(c.clean, c.usable, c.history, PARAMS)
    c.previous = Reprojected(
        illumination=np.stack([oracle.gather(c.taps, s) for s in c.history["illumination"]]),
        moments=np.stack([oracle.gather(c.taps, s) for s in c.history["moments"]]),
        history_length=oracle.gather(c.taps, c.history["history_length"]),
        valid=np.array([[bool(t) for t in row] for row in c.taps]),
    )
    c.accumulated, c.moments, c.length, _ = oracle.accumulate(c.illumination, c.taps, c.history, c.surface, PARAMS)
    c.lengths = np.where(c.surface, rng.choice([1.0, 2.0, 2.99, 3.5, 3.998, 3.9995, 4 - 1e-7, 4.0, 5.5], SIZE), 0.0)
    c.variance = oracle.estimate_variance(c.moments, c.lengths, c.depth, c.normal, c.surface, c.gradient, PARAMS)
    c.level = functools.cache(
        lambda level: oracle.atrous_level(
            c.accumulated, c.variance, c.depth, c.normal, c.surface, c.gradient, level, PARAMS
        )
    )
    c.step = functools.cache(lambda: oracle.step(c.history, c.raw, PARAMS, CONFIG))
    return c


def compiled(function, *arguments, **static):
    return jax.tree.map(np.asarray, jax.jit(functools.partial(function, **static))(*arguments))


def assert_close(actual, expected, tolerance=1e-9):
    error = relative_error(actual, expected)
    assert error.max() < tolerance, float(error.max())


def test_the_case_is_awkward_enough():
    c = case()
    surface = np.array(c.surface)
    assert (~surface).any()
    assert (surface & ~c.previous.valid).any()
    assert (c.previous.valid & (c.previous.history_length > 1)).any()
    whole = [len(t) for row in c.taps for t in row]
    assert {1, 2, 4} <= set(whole), "taps judged one by one"
    assert any(np.isclose(t[0][2], 1 / len(t)) and len(t) in (3, 5, 6, 7, 8, 9) for row in c.taps for t in row if t), (
        "3x3"
    )
    assert (c.variance[:, surface] == 0).any()


def test_sanitise():
    for seed in (1, 2):
        raw = scenes.synthetic(seed, *SIZE, frames=1, dirty=True)[0]
        clean, usable, rejected = oracle.sanitise(raw)
        frame, counts = compiled(sanitation.sanitise, to_frame(raw))
        assert {k: int(v) for k, v in counts._asdict().items()} == rejected
        surface = clean["object_id"] != -1
        for name in ("radiance", "emission", "object_id"):
            np.testing.assert_array_equal(getattr(frame, name), clean[name])
        for name in ("depth", "normal"):
            np.testing.assert_array_equal(getattr(frame, name)[surface], clean[name][surface])
        for name in ("motion", "prev_depth"):
            np.testing.assert_array_equal(getattr(frame, name)[surface & usable], clean[name][surface & usable])
        assert (np.abs(frame.motion[~usable]).max(axis=-1) > 1e6).all(), "no history"
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(frame))


def test_demodulate():
    c = case()
    expected = oracle.demodulate(c.clean["radiance"], c.clean["albedo"], 2e-3)
    assert_close(color.demodulate(c.frame.radiance, c.frame.albedo, albedo_floor=2e-3), expected)


def test_remodulate_undoes_demodulate():
    c = case()
    light = color.demodulate(c.frame.radiance, c.frame.albedo, albedo_floor=2e-3)
    assert_close(color.remodulate(light, c.frame.albedo, albedo_floor=2e-3), c.clean["radiance"])


def test_luminance():
    rgb = np.random.default_rng(0).uniform(0, 9, (4, 5, 3))
    assert_close(color.luminance(rgb), oracle.luminance(np.moveaxis(rgb, -1, 0)))


def test_reproject():
    c = case()
    got = compiled(reprojection.reproject, to_history(c.history), c.frame, params=c.params, strip_rows=4)
    np.testing.assert_array_equal(got.valid, c.previous.valid)
    for name in ("illumination", "moments", "history_length"):
        assert_close(getattr(got, name), getattr(c.previous, name))


def test_reproject_tells_objects_apart_by_id_alone():
    """Two walls that are the same but for their name, side by side, the picture moving by a fraction of a pixel."""
    frame = scenes.flat(6, 8)
    frame["motion"][:] = [0.3, 0.6]
    frame["object_id"][:, 4:] = 5
    history = oracle.step(oracle.empty_history(frame), frame, oracle.PAPER, CONFIG)[0]
    history["history_length"] = 1.0 + np.arange(48.0).reshape(6, 8)
    clean, usable, _ = oracle.sanitise(frame)
    expected = oracle.gather(oracle.reproject_taps(clean, usable, history, oracle.PAPER), history["history_length"])
    params = to_params(oracle.PAPER)
    got = compiled(reprojection.reproject, to_history(history), to_frame(clean), params=params, strip_rows=None)
    assert_close(got.history_length, expected)


def test_reproject_compares_the_depth_that_the_surface_had():
    """Something that came nearer by a third keeps its history through prev_depth; a normal 20 degrees off, 30 not."""
    frame = scenes.flat(5, 9, depth=0.02)  # near the camera: the tolerance is relative there too
    history = oracle.step(oracle.empty_history(frame), frame | {"depth": frame["depth"] * 1.5}, oracle.PAPER, CONFIG)[0]
    frame["prev_depth"][:] = 0.03 * np.linspace(0.8, 1.2, 9)
    angle = np.radians(np.linspace(0, 40, 5))[:, None] * np.ones(9)
    frame["normal"] = np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], axis=-1)
    clean, usable, _ = oracle.sanitise(frame)
    taps = oracle.reproject_taps(clean, usable, history, oracle.PAPER)
    expected = np.array([[bool(t) for t in row] for row in taps])
    assert 0 < expected.mean() < 1
    params = to_params(oracle.PAPER | {"reproject_depth": [0.1, 1.0], "reproject_normal": [0.9, -1.0]})
    got = compiled(reprojection.reproject, to_history(history), to_frame(clean), params=params, strip_rows=None)
    np.testing.assert_array_equal(got.valid, expected)


@pytest.mark.parametrize(
    "choices",
    [
        {"reprojection": "nearest"},
        {"reprojection": "nearest", "fallback": False},
        {"fallback": False},
        {"id_test": False},
    ],
    ids=str,
)
def test_reproject_as_chosen(choices):
    c, config = case(), CONFIG | choices
    params = PARAMS | {"reproject_depth": 1.0, "reproject_normal": -0.5}  # so that ids matter
    taps = oracle.reproject_taps(c.clean, c.usable, c.history, params, config)
    assert taps != oracle.reproject_taps(c.clean, c.usable, c.history, params)
    got = compiled(
        reprojection.reproject,
        to_history(c.history),
        c.frame,
        params=to_params(params),
        config=to_config(config),
        strip_rows=4,
    )
    np.testing.assert_array_equal(got.valid, [[bool(t) for t in row] for row in taps])
    for s, signal in enumerate(c.history["illumination"]):
        assert_close(got.illumination[s], oracle.gather(taps, signal))


@pytest.mark.parametrize("choices", [{"warm_up": False}, {"clamp_radius": 1}, {"clamp_radius": 3}], ids=str)
def test_accumulate_as_chosen(choices):
    c, config = case(), CONFIG | choices
    params = PARAMS | {"clamp_sigma": [0.4, 9.0]}
    expected, moments, length, _ = oracle.accumulate(c.illumination, c.taps, c.history, c.surface, params, config)
    assert np.abs(expected - c.accumulated).max() > 0.01

    def stages(illumination, previous, frame, params, config):
        previous = accumulation.clamp_history(previous, illumination, frame, params=params, config=config, strip_rows=4)
        return accumulation.accumulate(illumination, previous, frame, params=params, config=config)

    got = compiled(stages, c.illumination, c.previous, c.frame, params=to_params(params), config=to_config(config))
    assert_close(got.illumination, expected)
    assert_close(got.moments, moments)
    assert_close(got.history_length, length)


def test_accumulate():
    c, go = case(), jax.jit(accumulation.accumulate)
    got = go(c.illumination, c.previous, c.frame, params=c.params)
    assert_close(got.illumination, c.accumulated)
    assert_close(got.moments, c.moments)
    assert_close(got.history_length, c.length)
    alone = go(c.illumination, c.previous, c.frame, params=to_params(PARAMS | {"max_history": 1.0}))
    surface = np.array(c.surface)
    assert_close(np.asarray(alone.illumination)[:, surface], np.asarray(c.illumination)[:, surface])


def test_depth_gradient():
    c = case()
    x, y = compiled(edges.depth_gradient, c.frame.depth, c.frame.object_id)
    surface = np.array(c.surface)
    gradient = np.array(c.gradient)
    assert_close(x[surface], gradient[surface, 0])
    assert_close(y[surface], gradient[surface, 1])


def test_estimate_variance():
    c = case()
    got = compiled(variance.estimate_variance, c.moments, c.lengths, c.frame, params=c.params, strip_rows=4)
    assert_close(got, c.variance)


@pytest.mark.parametrize("estimator", ["temporal", "spatial"])
def test_estimate_variance_otherwise(estimator):
    """The estimators to compare with; the case has pixels without, with short and with long history."""
    c = case()
    params = PARAMS | {"initial_variance": 7.0, "variance_scale": 3.0}
    expected = oracle.estimate_variance(
        c.moments, c.lengths, c.depth, c.normal, c.surface, c.gradient, params, estimator
    )
    got = compiled(
        variance.estimate_variance,
        *(c.moments, c.lengths, c.frame),
        params=to_params(params),
        config=to_config({"variance": estimator}),
        strip_rows=4,
    )
    assert_close(got, expected)


@pytest.mark.parametrize("level", [0, 1])
def test_atrous_level(level):
    c = case()
    light, values = compiled(
        atrous.atrous_level, c.accumulated, c.variance, c.frame, level=level, params=c.params, strip_rows=4
    )
    expected_light, expected_values = c.level(level)
    assert_close(light, expected_light)
    assert_close(values, expected_values)


def test_atrous_level_without_prefilter():
    c = case()
    light, values = compiled(
        *(atrous.atrous_level, c.accumulated, c.variance, c.frame),
        **{"level": 1, "params": c.params, "prefilter": False, "strip_rows": 4},
    )
    expected = oracle.atrous_level(
        *(c.accumulated, c.variance, c.depth, c.normal, c.surface, c.gradient, 1, PARAMS), prefilter=False
    )
    assert np.abs(expected[0] - c.level(1)[0]).max() > 0.01
    assert_close(light, expected[0])
    assert_close(values, expected[1])


@pytest.mark.parametrize("feedback_level", [-1, 0, 1, 9])
def test_feedback(feedback_level):
    """Two levels, and the history is the output of the level that was asked for."""
    c = case()
    config = to_config({"levels": 2, "feedback_level": feedback_level})
    light, values, feedback = compiled(
        atrous.atrous_filter, c.accumulated, c.variance, c.frame, params=c.params, config=config, strip_rows=4
    )
    first, between = c.level(0)
    last, final = oracle.atrous_level(first, between, c.depth, c.normal, c.surface, c.gradient, 1, PARAMS)
    assert_close(light, last)
    assert_close(values, final)
    assert_close(feedback, {-1: c.accumulated, 0: first, 1: last, 9: last}[feedback_level])


def test_the_plain_form_of_the_loops():
    c = case()
    plain = compiled(atrous.atrous_level, c.accumulated, c.variance, c.frame, level=0, params=c.params, strip_rows=None)
    assert_close(plain[0], c.level(0)[0])
    assert_close(plain[1], c.level(0)[1])


def test_the_plain_form_of_the_levels():
    c = case()
    choices = {"params": c.params, "config": to_config({"levels": 2, "feedback_level": 0})}
    fast = compiled(atrous.atrous_filter, c.accumulated, c.variance, c.frame, **choices, strip_rows=4)
    plain = compiled(atrous.atrous_filter, c.accumulated, c.variance, c.frame, **choices, strip_rows=None)
    for one, other in zip(fast, plain, strict=True):
        assert_close(np.asarray(other), one)


def test_step():
    c = case()
    raw = scenes.soil(np.random.default_rng(1), c.raw)
    history, output = oracle.step(c.history, raw, PARAMS, CONFIG)
    got_history, got = compiled(
        pipeline.step, to_history(c.history), to_frame(raw), params=c.params, config=to_config(CONFIG)
    )
    for name in ("image", "illumination", "variance", "variance_filtered", "history_length"):
        # The root of a variance that is all rounding, a difference of equal moments, is good to half the digits.
        assert_close(getattr(got, name), output[name], tolerance=1e-7)
    np.testing.assert_array_equal(got.valid, output["valid"])
    surface = history["object_id"] != -1
    for name in ("illumination", "moments", "history_length", "object_id"):
        assert_close(getattr(got_history, name), history[name], tolerance=1e-7)
    for name in ("depth", "normal"):
        assert_close(getattr(got_history, name)[surface], history[name][surface])
        assert np.isfinite(getattr(got_history, name)).all()


def test_reproject_trusts_no_sliver():
    """Of the 2x2 taps only one is consistent, and its weight is 0.0099: the 3x3 decides."""
    frame = scenes.flat(5, 6)
    frame["motion"][:] = [0.0099, 0.0]
    frame["object_id"][:, 3:] = 5
    history = oracle.step(oracle.empty_history(frame), frame, oracle.PAPER, CONFIG)[0]
    history["object_id"][:, :3] = 7
    history["object_id"][:, 3] = 0
    history["history_length"] = 1.0 + np.arange(30.0).reshape(5, 6) ** 1.5
    clean, usable, _ = oracle.sanitise(frame)
    expected = oracle.gather(oracle.reproject_taps(clean, usable, history, oracle.PAPER), history["history_length"])
    got = compiled(
        reprojection.reproject, to_history(history), to_frame(clean), params=to_params(oracle.PAPER), strip_rows=None
    )
    assert_close(got.history_length, expected)


def test_variance_of_a_constant_is_not_negative():
    c = case()
    light = np.random.default_rng(0).uniform(0, 1, (2, *SIZE))
    moments = np.stack([light, light**2 - 1e-12], axis=-1)
    length = np.full(SIZE, 9.0)
    got = compiled(variance.estimate_variance, moments, length, c.frame, params=c.params, strip_rows=4)
    assert not got.any()


def test_backs_do_not_count():
    """Two sheets back to back: n(p) . n(q) = -1."""
    frame = scenes.flat(4, 6)
    frame["normal"][:, 3:] *= -1
    light = np.random.default_rng(0).uniform(0, 1, (1, 4, 6, 3))
    got, _ = compiled(
        atrous.atrous_level,
        light,
        np.ones((1, 4, 6)),
        to_frame(frame),
        level=0,
        params=to_params(oracle.PAPER),
        strip_rows=4,
    )
    gradient = [[(0.0, 0.0)] * 6] * 4
    surface = [[True] * 6] * 4
    depth, normal = frame["depth"].tolist(), frame["normal"].tolist()
    expected, _ = oracle.atrous_level(light, np.ones((1, 4, 6)), depth, normal, surface, gradient, 0, oracle.PAPER)
    assert_close(got, expected)


def test_background_keeps_its_radiance():
    raw = {k: v.copy() for k, v in case().raw.items()}
    raw["radiance"][:, raw["object_id"] == -1] = 0.5
    config, history = to_config(CONFIG), to_history(case().history)
    _, got = compiled(pipeline.step, history, to_frame(raw), params=case().params, config=config)
    background = raw["object_id"] == -1
    assert_close(got.image[background], (1.0 + raw["emission"])[background])


def taa_case(seed=0):
    """Noise with a few very bright pixels, fractional motion, motion out of the image and broken motion, things before things."""
    rng = np.random.default_rng(seed)
    image = rng.gamma(0.7, 1.0, (*SIZE, 3)) * np.where(rng.random((*SIZE, 1)) < 0.05, 50, 1)
    image[rng.random((*SIZE, 3)) < 0.02] = np.nan
    image[rng.random((*SIZE, 3)) < 0.02] = -0.3
    motion = rng.uniform(-1.5, 1.5, (*SIZE, 2)).round(2)
    motion[rng.random(SIZE) < 0.05] = [40.0, 0.0]
    motion[rng.random(SIZE) < 0.05] = np.inf
    depth = rng.choice([0.0, 2.0, 2.0, 3.0, 5.0, np.nan], SIZE)
    return image, motion, depth


def test_taa():
    """The second frame of two: a past, clipped to the box around it and blended."""
    params = to_params(oracle.PAPER | {"taa_alpha": 0.6})
    first, image = taa_case(0)[0], taa_case(1)
    color, frames, _ = oracle_taa.taa(np.zeros((*SIZE, 3)), 0, first, *image[1:], 0.6)
    expected_color, _, expected = oracle_taa.taa(color, frames, *image, 0.6)
    past = TaaHistory(color, np.float64(frames))
    got, linear = compiled(antialiasing.taa, past, *image, params=params, strip_rows=4)
    np.testing.assert_allclose(got.color, expected_color, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(linear, expected, rtol=1e-9, atol=1e-12)
    assert float(got.frames) == 2
