"""How stencils are cut into strips, and that the form for large pictures (taps unrolled) computes what the others do."""

import functools

import jax
import numpy as np
import pytest
from bridge import QUICK, to_frame
from hypothesis import given
from hypothesis import strategies as st
from scenes import synthetic

from svgf_jax import atrous, sampling
from svgf_jax.types import Params


@given(height=st.integers(1, 5000), width=st.integers(1, 9000), strip_rows=st.integers(0, 80))
def test_strips_cover_the_image_with_few_rows_to_spare(height, width, strip_rows):
    count, rows = sampling.split_rows(height, width, strip_rows)
    assert count >= 2
    assert height <= count * rows < height + count
    if strip_rows:
        assert rows <= strip_rows
    elif width <= sampling.STRIP_PIXELS:
        assert rows * width <= sampling.STRIP_PIXELS


@pytest.mark.parametrize(("height", "width", "unrolled"), [(270, 480, False), (720, 1280, True), (1080, 1920, True)])
def test_taps_are_unrolled_where_pictures_are_large(height, width, unrolled):
    assert sampling.unroll_taps(height, width, 25) == unrolled
    assert not sampling.unroll_taps(height, width, 49)  # 7 x 7: seldom asked for, long to compile


def test_unrolled_taps_add_up_to_the_same(monkeypatch):
    frame = to_frame(synthetic(3, 11, 13, frames=1)[0])

    def filtered(sigma):
        light, variance = atrous.atrous_level(
            frame.radiance,
            frame.radiance[..., 0] ** 2,
            frame,
            level=1,
            params=Params(sigma_luminance=sigma),
            strip_rows=4,
        )
        return light, variance

    def value_and_slope():
        go = jax.jit(functools.partial(jax.jvp, lambda s: filtered(s)), compiler_options=dict(QUICK))
        return go((np.float64(2.0),), (np.float64(1.0),))

    looped = value_and_slope()
    monkeypatch.setattr(sampling, "UNROLL_FROM", 0)
    for fast, slow in zip(jax.tree.leaves(value_and_slope()), jax.tree.leaves(looped), strict=True):
        assert np.isfinite(fast).all()
        np.testing.assert_allclose(fast, slow, rtol=1e-12, atol=1e-14)
