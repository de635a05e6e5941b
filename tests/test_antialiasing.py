"""Temporal anti-aliasing: against plain loops, what it promises, and inside the pipeline."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
import scenes
import test_stages_oracle
from bridge import jitted_denoise, jitted_step, to_config, to_frames, to_params
from compiling import AS_USERS

from svgf_jax import SvgfError, antialiasing
from svgf_jax.pipeline import init, step
from svgf_jax.types import Config, Params, TaaHistory

SIZE = (13, 17)
ALPHA = 0.15


def jitted(strip_rows=4):
    return jax.jit(functools.partial(antialiasing.taa, strip_rows=strip_rows))


def run(images, motion, depth, alpha=ALPHA, dtype=np.float64, go=None):
    """The linear images and the display images of a sequence."""
    go, params = go or jitted(), Params(taa_alpha=np.asarray(alpha, dtype))
    history, out = antialiasing.taa_init(jnp.asarray(images[0], dtype)), []
    for image in images:
        history, linear = go(
            history, np.asarray(image, dtype), np.asarray(motion, dtype), np.asarray(depth, dtype), params=params
        )
        out.append((np.asarray(linear), np.asarray(history.color)))
    return out


STILL = np.zeros((*SIZE, 2))
FLAT = np.full(SIZE, 2.0)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_static_scene_stays_what_it_is(dtype):
    """Energy is kept: every pixel, dim or bright, is still itself after thirty frames."""
    image = np.random.default_rng(0).gamma(0.5, 3.0, (*SIZE, 3))
    linear, display = run([image] * 30, STILL, FLAT, dtype=dtype)[-1]
    np.testing.assert_allclose(linear, image, rtol=1e-9 if dtype == np.float64 else 1e-4, atol=1e-6)
    luma = image @ [0.25, 0.5, 0.25]
    np.testing.assert_allclose(display, image / (1 + luma[..., None]), rtol=1e-5, atol=1e-6)


def test_a_noise_free_pan_keeps_its_energy_and_its_detail():
    """A smooth texture moving by a fraction of a pixel: neither darker nor blurred."""
    y, x = np.mgrid[:24, :32]
    wave = lambda t: np.repeat((1.0 + 0.5 * np.sin(0.5 * (x - 0.3 * t)) * np.cos(0.4 * y))[..., None], 3, 2)  # noqa: E731
    motion = np.broadcast_to([-0.3, 0.0], (24, 32, 2))
    linear, _ = run([wave(t) for t in range(12)], motion, np.full((24, 32), 2.0), go=jitted())[-1]
    inside = (slice(4, -4), slice(8, -4))
    assert linear[inside].mean() == pytest.approx(wave(11)[inside].mean(), rel=2e-3)
    assert np.abs(linear - wave(11))[inside].max() < 0.02


def test_nothing_is_left_behind_a_moving_edge():
    """A bright bar crosses a dark wall by two pixels a frame; the wall has no motion. Where it was, it is gone."""
    height, width = 12, 40
    motion, depth = np.zeros((height, width, 2)), np.full((height, width), 4.0)
    go, params = jitted(), Params(taa_alpha=np.float64(0.1))
    history = antialiasing.taa_init(jnp.zeros((height, width, 3)))
    for t in range(12):
        bar = (np.arange(width) >= 2 * t) & (np.arange(width) < 2 * t + 6)
        image = np.where(bar[None, :, None], 5.0, 0.1) * np.ones((height, 1, 3))
        history, linear = go(
            history,
            image,
            np.where(bar[None, :, None], [-2.0, 0.0], motion),
            np.where(bar[None], 2.0, depth),
            params=params,
        )
        behind = np.asarray(linear)[:, : max(2 * t - 1, 0)]
        assert np.abs(behind - 0.1).max(initial=0) < 1e-5
        inside = np.asarray(linear)[:, 2 * t + 1 : 2 * t + 5]
        np.testing.assert_allclose(inside, 5.0, rtol=1e-5)


def halton(index, base):
    result, fraction = 0.0, 1.0
    while index:
        fraction /= base
        result += fraction * (index % base)
        index //= base
    return result


def edge(jitter_x, jitter_y, size=(20, 24)):
    """A slanted edge, one sample a pixel at (jitter_x, jitter_y) in it: 0.05 and 0.8."""
    y, x = np.mgrid[: size[0], : size[1]]
    return np.where(0.37 * (x + jitter_x) + (y + jitter_y) < 15, 0.05, 0.8)


def test_jittered_samples_become_an_edge_close_to_a_supersampled_one():
    steps = (np.arange(16) + 0.5) / 16
    smooth = np.mean([edge(i, j) for i in steps for j in steps], axis=0)
    frames = [np.repeat(edge(halton(t + 1, 2), halton(t + 1, 3))[..., None], 3, 2) for t in range(64)]
    still, flat = np.zeros((20, 24, 2)), np.full((20, 24), 2.0)
    linear = [image[..., 0] for image, _ in run(frames, still, flat, alpha=0.05, go=jitted())]
    error = lambda image: np.sqrt(np.mean((image - smooth) ** 2))  # noqa: E731
    alone = np.mean([error(frame[..., 0]) for frame in frames[32:]])
    together = np.mean([error(image) for image in linear[32:]])
    assert together < alone / 3, (together, alone)
    flicker = lambda images: np.sqrt(np.mean(np.diff(images, axis=0) ** 2))  # noqa: E731
    assert flicker(linear[32:]) < flicker([f[..., 0] for f in frames[32:]]) / 8


def test_gradients_are_finite():
    image, motion, depth = (np.asarray(a, np.float32) for a in test_stages_oracle.taa_case())
    past = TaaHistory(np.abs(np.nan_to_num(image)) / 100, np.float32(20))

    def loss(image, motion, past, alpha):
        history, linear = antialiasing.taa(past, image, motion, depth, params=Params(taa_alpha=alpha), strip_rows=4)
        return linear.sum() + history.color.sum()

    go = jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3)))
    found = go(image, motion, past, np.float32(ALPHA))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    assert float(found[3]) != 0


CONFIG = {"levels": 0, "feedback_level": 0, "taa": True}


def test_in_the_pipeline_step_by_step_is_the_scan_to_the_bit():
    """And the linear image is what taa makes of the image without it, the background's too; alpha 1 makes that the input."""
    frames = scenes.synthetic(8, 13, 14, frames=3)
    whole, config = to_frames(frames, np.float32), to_config(CONFIG)
    params = to_params(oracle.PAPER | {"alpha": 1.0}, np.float32)
    history, outputs = jitted_denoise(config, AS_USERS)(whole, params=params)
    go, state = jitted_step(config, AS_USERS), init(jax.tree.map(lambda leaf: leaf[0], whole), config=config)
    by_itself, alone = jitted(), antialiasing.taa_init(jnp.asarray(whole.emission[0]))
    for t in range(3):
        frame, scanned = (jax.tree.map(lambda leaf, t=t: leaf[t], tree) for tree in (whole, outputs))
        state, output = go(state, frame, params=params)
        jax.tree.map(np.testing.assert_array_equal, output, scanned)
        image = frame.radiance.sum(0) + frame.emission
        alone, expected = by_itself(alone, image, frame.motion, frame.depth, params=params)
        np.testing.assert_allclose(output.image, expected, rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(output.display, alone.color, rtol=1e-3, atol=1e-4)
    jax.tree.map(np.testing.assert_array_equal, state, history)
    assert (np.asarray(output.image) != image)[whole.object_id[2] == -1].any(), "the background takes part"


def test_a_history_of_other_choices_is_refused():
    frame = jax.tree.map(lambda leaf: leaf[0], to_frames(scenes.synthetic(8, 5, 6, frames=1)))
    with pytest.raises(SvgfError, match=r"lacks a past .* init\(frame, config=config\)"):
        step(init(frame), frame, config=Config(taa=True))
    with pytest.raises(SvgfError, match="has a past"):
        step(init(frame, config=Config(taa=True)), frame)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"image": (10, 24, 3)}, r"the motion is float32 \(20, 24, 2\); wanted float32 \(10, 24, 2\)"),
        ({"image": (20, 24)}, r"the image is float32 \(20, 24\); wanted float32 or float64 \[H, W, 3\]"),
        ({"motion": (19, 24, 2)}, r"the motion is float32 \(19, 24, 2\); wanted float32 \(20, 24, 2\)"),
        ({"depth": (20, 24, 1)}, r"the depth is float32 \(20, 24, 1\); wanted float32 \(20, 24\)"),
        ({"past": (10, 24, 3)}, r"the history's color is float32 \(10, 24, 3\).* taa_init\(image\)"),
    ],
)
def test_what_does_not_fit_is_told(change, complaint):
    shapes = {"image": (20, 24, 3), "motion": (20, 24, 2), "depth": (20, 24), "past": (20, 24, 3)} | change
    arrays = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    with pytest.raises(SvgfError, match=complaint):
        antialiasing.taa(antialiasing.taa_init(arrays["past"]), arrays["image"], arrays["motion"], arrays["depth"])


def test_what_is_no_float_is_told():
    image, depth = np.zeros((4, 5, 3), np.float32), np.zeros((4, 5), np.int32)
    with pytest.raises(SvgfError, match="the image is uint8"):
        antialiasing.taa_init(image.astype(np.uint8))
    with pytest.raises(SvgfError, match="the depth is int32"):
        antialiasing.taa(antialiasing.taa_init(image), image, image[..., :2], depth)
