"""Bad pixels: whatever is in a frame, the output is finite and within bounds, repairs are counted, and the history recovers.

More of them, for all presets, and gradients: bench/spoil_pixels.py.
"""

import bad_pixels
import bridge
import jax
import numpy as np
import pytest
import scenes
from hypothesis import HealthCheck, given, settings

from svgf_jax.modulation import modulate
from svgf_jax.pipeline import init
from svgf_jax.types import Config, Frame, Params

F32 = np.finfo(np.float32)
ALPHA = 0.2


@pytest.fixture(scope="module")
def run():
    """The preset `paper` over a sequence with a leading T: the outputs; one compilation for all tests here."""
    step, params = bridge.jitted_step(Config()), bridge.to_params({}, np.float32)

    def over(frames: Frame):
        first, *_ = each = [jax.tree.map(lambda a, t=t: a[t], frames) for t in range(len(frames.depth))]
        history, outputs = init(first), []
        for frame in each:
            history, output = step(history, frame, params=params)
            outputs.append(output)
        return jax.tree.map(lambda *leaves: np.stack(leaves), *outputs)

    return over


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(case=bad_pixels.cases)
def test_anything_may_be_wrong(run, case):
    frames = bad_pixels.build(case)
    bad_pixels.check(frames, run(frames))


def wall(count: int) -> list[dict]:
    return [scenes.flat(*bad_pixels.SIZE, signals=2) for _ in range(count)]


def stack(frames) -> Frame:
    return bridge.to_frames(frames, np.float32)


BAD, AFTER = 4, 12
KINDS = {
    "nan": ("radiance", (0, 5, 5), np.nan),
    "inf": ("radiance", (0, 5, 5), np.inf),
    "negative": ("radiance", (0, 5, 5), -3.0),
    "firefly of 1e6": ("radiance", (0, 5, 5), 1e6),
    "black": ("radiance", ..., 0.0),
    "exposure times 1e6": ("radiance", ..., 1e6),
    "no motion": ("motion", ..., np.nan),
    "far motion": ("motion", ..., 1e6),
    "no depth": ("depth", ..., np.nan),
    "no normal": ("normal", ..., np.nan),
    "another object": ("object_id", ..., 77),
    "all background": ("object_id", ..., -1),
}


@pytest.mark.parametrize("kind", KINDS)
def test_the_history_recovers_within_its_window(run, kind):
    """A wall of light 1. n frames after the bad ones, what is left of them is at most (1 - alpha)^n of the largest error."""
    channel, where, value = KINDS[kind]
    frames = wall(6 + BAD + AFTER)
    for frame in frames[6 : 6 + BAD]:
        frame[channel][where] = value
    output = run(stack(frames))
    assert np.isfinite(output.image).all()
    error = np.abs(output.image - 2.0).max((1, 2, 3))  # two signals
    assert error[:6].max() < 1e-5
    worst = error[5 + BAD] if channel == "radiance" else 0.0
    left = worst * (1 - ALPHA) ** np.arange(1, AFTER + 1)
    assert (error[6 + BAD :] <= left * (1 + 1e-4) + 1e-5).all(), np.c_[error[6 + BAD :], left]
    assert (output.history_length[-1] >= AFTER).all()  # and it is long again


def test_what_was_repaired_is_counted(run):
    frames = wall(1)
    frames[0]["radiance"][0, 0, :3, 0] = np.nan, np.inf, -np.inf
    frames[0]["radiance"][1, 1, :3] = -1
    frames[0]["emission"][2, 2] = np.inf
    frames[0]["albedo"][0, 3, 3] = np.nan
    frames[0]["motion"][4, 4] = np.inf
    frames[0]["normal"][5, :5] *= 3
    frames[0]["radiance"][1, 6, :4, 1] = 2e12
    counts = {name: int(count[0]) for name, count in run(stack(frames)).rejected._asdict().items()}
    assert counts == {"radiance": 3, "negative": 3, "emission": 1, "surface": 1, "motion": 1, "normal": 5, "bright": 4}


@pytest.mark.parametrize("length", [1e-15, 0.5, 1.02, 40.0, 1e30])
def test_normals_of_any_length_mean_the_same(run, length):
    frames = scenes.synthetic(3, *bad_pixels.SIZE, frames=2)
    plain = run(stack(frames))
    for frame in frames:
        frame["normal"] = frame["normal"] * length
    other = run(stack(frames))
    np.testing.assert_allclose(other.image, plain.image, rtol=1e-3, atol=1e-5)
    surfaces = [(frame["object_id"] != -1).sum() for frame in frames]
    np.testing.assert_array_equal(other.rejected.normal, surfaces)
    np.testing.assert_array_equal(plain.rejected.normal, 0)


def test_normals_as_half_floats_round_them_stay_as_they_are(run):
    frames = wall(1)
    frames[0]["normal"][..., 2] = -1.009
    assert run(stack(frames)).rejected.normal == 0
    frames[0]["normal"][..., 2] = 0.0
    assert run(stack(frames)).rejected.normal == 0  # zeros have no direction to keep


def test_light_beside_an_albedo_that_is_none_stays_finite(run):
    frames = wall(1)
    frames[0]["radiance"][:] = 1e14
    frames[0]["albedo"][0, ::2] = 0.0
    frames[0]["albedo"][0, 1::2] = 1e30
    assert np.isfinite(run(stack(frames)).image).all()


def test_the_sum_of_the_brightest_lights_stays_finite(run):
    frames = wall(1)
    frames[0]["albedo"][:] = 1.0
    frame = jax.tree.map(lambda leaf: leaf[0], stack(frames))
    image = modulate(np.full_like(frame.radiance, 3e38), frame)
    assert np.asarray(image).min() == F32.max
    frames[0]["radiance"][:] = 3e38
    frames[0]["albedo"][:] = 1e5
    assert np.isfinite(run(stack(frames)).image).all()


def test_the_bound_of_the_campaign_is_a_bound():
    """`bad_pixels.check` sees what breaks it."""
    frames = stack(wall(1))
    rejected = dict.fromkeys(
        ("radiance", "negative", "emission", "surface", "motion", "normal", "bright"), np.zeros(1, int)
    )
    from svgf_jax.types import Output, Rejected

    light = np.ones((1, 2, *bad_pixels.SIZE, 3), np.float32)
    zero = light[..., 0] * 0
    output = Output(light[:, 0], light, zero, zero, zero[:, 0], zero[:, 0] > 0, Rejected(**rejected))
    assert bad_pixels.check(frames, output) == 1.0
    for broken in (
        output._replace(illumination=light * 1.001),
        output._replace(illumination=-light),
        output._replace(image=light[:, 0] * np.nan),
        output._replace(rejected=output.rejected._replace(negative=np.ones(1, int))),
    ):
        with pytest.raises(AssertionError):
            bad_pixels.check(frames, broken)
    assert Params().alpha == ALPHA
