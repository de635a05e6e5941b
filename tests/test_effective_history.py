"""How many frames a history is worth: by plain loops, by the noise that it has, and on its way through reprojection."""

import bridge
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from test_adaptation import NOISES, WALL, WALL_PARAMS, lit
from test_reflections import frames_of_a_mirror

import svgf_jax as sj
from svgf_jax.accumulation import effective_history
from svgf_jax.reprojection import reproject, reproject_reflections
from svgf_jax.types import Config, Params, Reprojected

SHAPE = (2, 5, 7)
PLAIN = WALL._replace(levels=0, feedback_level=-1)  # nothing but the mean over time takes noise away


def case(rng):
    """A frame with a hole in its surface, and a past of which some pixels have none."""
    frame = bridge.to_frame(scenes.flat(*SHAPE[1:], signals=2))
    ids = np.where(rng.random(SHAPE[1:]) < 0.2, -1, 3).astype(np.int32)
    valid = (ids != -1) & (rng.random(SHAPE[1:]) < 0.8)
    length = np.where(valid, rng.integers(2, 20, SHAPE[1:]), 1.0) * (ids != -1)
    worth = np.where(valid, rng.uniform(0.5, 9.0, SHAPE), 0.0)
    empty = np.zeros((*SHAPE, 3))
    previous = Reprojected(empty, empty[..., :2], np.maximum(length - 1, 0), valid, effective_history=worth)
    return frame._replace(object_id=ids), previous, length


def by_loops(frame, previous, length, alpha, longest, *, warm_up):
    """The variance of (1 - a) old + a new, where the old has 1 / n of a frame's variance and the new all of it."""
    out = np.zeros(SHAPE)
    for s, y, x in np.ndindex(*SHAPE):
        if frame.object_id[y, x] == -1:
            continue
        a = max(alpha, 1 / length[y, x]) if warm_up else alpha
        if longest is not None:
            a = max(a, 1 / longest[s, y, x])
        noise = 1.0
        if previous.valid[y, x]:
            noise = (1 - a) ** 2 / previous.effective_history[s, y, x] + a**2
        out[s, y, x] = 1 / noise
    return out


@pytest.mark.parametrize("warm_up", [True, False])
@pytest.mark.parametrize("shortened", [False, True])
def test_it_is_the_variance_of_the_mean(warm_up, shortened):
    rng = np.random.default_rng(0)
    frame, previous, length = case(rng)
    longest = rng.uniform(1.0, 8.0, SHAPE) if shortened else None
    frame = frame._replace(longest_history=longest)
    count = jax.jit(lambda *a: effective_history(*a, params=Params(alpha=0.2), config=Config(warm_up=warm_up)))
    got = count(previous, length, frame)
    np.testing.assert_allclose(got, by_loops(frame, previous, length, 0.2, longest, warm_up=warm_up), rtol=1e-12)


def test_it_and_its_derivatives_are_finite_even_of_a_history_worth_nothing():
    frame, previous, length = case(np.random.default_rng(1))
    nothing = previous._replace(effective_history=np.zeros(SHAPE), valid=np.ones(SHAPE[1:], bool))

    def total(alpha, worth):
        past = nothing._replace(effective_history=worth)
        return effective_history(past, length, frame, params=Params(alpha=alpha), config=Config(warm_up=False)).sum()

    for alpha in (0.0, 0.5, 1.0):
        value, slopes = jax.value_and_grad(total, argnums=(0, 1))(jnp.float64(alpha), jnp.zeros(SHAPE))
        assert np.isfinite(value)
        assert all(np.isfinite(slope).all() for slope in slopes)


@pytest.mark.parametrize("factor", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("noise", ["uniform", "exponential"])
def test_it_tells_the_noise_of_an_accumulated_wall(noise, factor):
    """The variance of one frame over that of the history, after the first frame and before and after a step of the light."""
    rng, step = np.random.default_rng(3), bridge.jitted_step(PLAIN)
    one = NOISES[noise](rng, 10**6).var()
    history, told, seen = sj.init(lit(rng, noise, 1, 1.0), effective_history=True), [], []
    for light in (1.0,) * 9 + (factor,) * 2:
        history, output = step(history, lit(rng, noise, 1, light), params=WALL_PARAMS)
        seen.append(one * light**2 / np.asarray(history.illumination[0, ..., 1]).var())
        told.append(1 / np.mean(1 / np.asarray(output.effective_history)))
    assert told[0] == 1
    np.testing.assert_allclose(told, seen, rtol=0.13)
    assert told[-1] > 0.9 * (2 - 0.35) / 0.35  # of what the mean over time alone is worth in the end


def test_it_is_brought_along_like_the_light():
    """Reprojected as a channel of the illumination is, by surfaces and by reflections."""
    first, second = (jax.tree.map(jnp.asarray, frame) for frame in frames_of_a_mirror())
    rng = np.random.default_rng(2)
    history = sj.init(first, effective_history=True)._replace(
        depth=first.depth, normal=first.normal, object_id=first.object_id, illumination=rng.random(first.radiance.shape)
    )
    history = jax.tree.map(jnp.asarray, history._replace(effective_history=history.illumination[..., 1]))
    history = jax.tree.map(lambda a: a.astype(jnp.float32) if a.dtype == jnp.float64 else a, history)
    params = jax.tree.map(np.float32, Params())
    by_surface = jax.jit(reproject)(history, second, params=params)
    by_both = jax.jit(reproject_reflections)(by_surface, history, second, params=params)
    assert np.asarray(by_surface.valid).any()
    assert np.any(by_both.effective_history != by_surface.effective_history)
    for previous in (by_surface, by_both):
        np.testing.assert_array_equal(previous.effective_history, previous.illumination[..., 1])
