"""How stencils are cut into strips, and that the form for large pictures (taps unrolled) computes what the others do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from bridge import relative_error, to_frame, to_params
from hypothesis import given
from hypothesis import strategies as st

from svgf_jax import init, pipeline, preset, sampling


@given(height=st.integers(1, 5000), width=st.integers(1, 9000), strip_rows=st.integers(0, 80))
def test_strips_cover_the_image_with_few_rows_to_spare(height, width, strip_rows):
    count, rows = sampling.split_rows(height, width, strip_rows)
    assert count >= 2
    assert height <= count * rows < height + count
    if strip_rows:
        assert rows <= strip_rows
    elif width <= sampling.STRIP_PIXELS:
        assert rows * width <= sampling.STRIP_PIXELS


def test_strips_are_as_long_as_can_be_where_jax_does_not_compute_on_cpus(monkeypatch):
    assert sampling.split_rows(1080, 1920, sampling.BY_WIDTH) == (180, 6)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert sampling.split_rows(1080, 1920, sampling.BY_WIDTH) == (2, 540)
    assert sampling.split_rows(1080, 1920, 8) == (135, 8)
    with jax.default_device(jax.devices("cpu")[0]):  # a CPU beside a GPU
        assert sampling.split_rows(1080, 1920, sampling.BY_WIDTH) == (180, 6)


def test_a_step_is_the_same_with_strips_of_any_length(monkeypatch):
    params, config = preset("adaptive")
    params = to_params(jax.tree.map(lambda leaf: np.ravel(leaf)[0], params)._asdict())
    config = config._replace(levels=1)
    frames = [to_frame(frame) for frame in scenes.synthetic(5, 160, 200, signals=1, frames=2)]

    def filtered():
        go = jax.jit(lambda history, frame: pipeline.step.__wrapped__(history, frame, params=params, config=config))
        history = init(frames[0], config=config)
        for frame in frames:
            history, output = go(history, frame)
        return history, output

    assert sampling.split_rows(160, 200, sampling.BY_WIDTH) == (3, 54)
    short = filtered()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert sampling.split_rows(160, 200, sampling.BY_WIDTH) == (2, 80)
    for long, brief in zip(jax.tree.leaves(filtered()), jax.tree.leaves(short), strict=True):
        assert relative_error(np.asarray(long), np.asarray(brief)).max() < 1e-9


@pytest.mark.parametrize(("height", "width", "unrolled"), [(136, 224, False), (270, 480, True), (1080, 1920, True)])
def test_taps_are_unrolled_where_pictures_are_large(height, width, unrolled):
    assert sampling.unroll_taps(height, width, 25) == unrolled
    assert not sampling.unroll_taps(height, width, 49)  # 7 x 7: seldom asked for, long to compile


def test_unrolled_taps_add_up_to_the_same(monkeypatch):
    image, weights = np.random.default_rng(3).random((2, 11, 13))
    offsets = sampling.square_offsets(1)

    def blurred(sigma):
        return sampling.sum_over_taps(
            lambda sums, q, p, t: (sums[0] + t * jnp.exp(-q[1] * sigma), sums[1] + t * q[0] * p),
            lambda sums, p: sums[0] * sums[1],
            neighbours=(image, weights),
            centre=weights,
            offsets=offsets,
            per_tap=jnp.arange(9.0),
            sums=(jnp.zeros(()), jnp.zeros(())),
            step_size=2,
            largest_step=2,
            strip_rows=4,
        )

    def value_and_slope():
        go = jax.jit(lambda s, t: jax.jvp(blurred, (s,), (t,)))
        return go(np.float64(2.0), np.float64(1.0))

    looped = value_and_slope()
    monkeypatch.setattr(sampling, "UNROLL_FROM", 0)
    for fast, slow in zip(value_and_slope(), looped, strict=True):
        assert np.abs(slow).max() > 0.1
        np.testing.assert_allclose(fast, slow, rtol=1e-12, atol=1e-14)


def test_reading_outside_gives_the_nearest_pixel_and_says_so():
    plane = np.arange(12.0).reshape(3, 4)
    row, column = np.array([0, -1, -9, 2, 3, 99, 1, 1, 1]), np.array([0, 0, -1, 3, 1, 4, -5, 4, 99])
    values, inside = sampling.read_at(jnp.asarray(plane), jnp.asarray(row), jnp.asarray(column))
    np.testing.assert_array_equal(inside, [True, False, False, True, False, False, False, False, False])
    np.testing.assert_array_equal(values, plane[np.clip(row, 0, 2), np.clip(column, 0, 3)])


def test_a_strip_that_nobody_asks_for_is_zero():
    where = np.zeros((9, 3), bool)
    where[4, 1] = True
    total = sampling.sum_over_taps(
        lambda sums, q, p, t: sums + q,
        lambda sums, p: sums + p,
        neighbours=jnp.ones((9, 3)),
        centre=jnp.ones((9, 3)),
        offsets=sampling.square_offsets(1),
        sums=jnp.zeros(()),
        where=jnp.asarray(where),
        strip_rows=3,
    )
    np.testing.assert_array_equal(total, np.repeat([[0.0] * 3, [7.0, 10.0, 7.0], [0.0] * 3], 3, axis=0))
