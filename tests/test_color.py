"""Colour arithmetic at its ends: light too bright for the sums of the filter is held back, all other light is not touched."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from svgf_jax import color


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_illumination_is_held_where_sums_of_it_stay_finite(dtype):
    """On a black surface a bright sample would become infinite."""
    most = np.finfo(dtype).max
    radiance = np.array([most, most / 2**11, 3.0, 0.0], dtype).reshape(1, 1, 4, 1) * np.ones(3, dtype)
    albedo = np.array([0.0, 1.0, 0.5, 0.0], dtype).reshape(1, 1, 4, 1) * np.ones(3, dtype)
    light = np.asarray(color.demodulate(radiance, albedo))[0, 0, :, 0]
    np.testing.assert_allclose(light, np.array([most / 2**12, most / 2**12, 6.0, 0.0], dtype), rtol=1e-6)


@pytest.mark.parametrize(("dtype", "most"), [(np.float32, 2.0**58), (np.float64, 2.0**506)])
def test_luminance_has_a_square_that_can_be_summed(dtype, most):
    """Two to the sixth less than the root of the largest number: 4096 squares have a sum."""
    assert color.largest_luminance(dtype) == pytest.approx(most, rel=1e-6)
    assert np.isfinite(np.full(4095, most, dtype) ** 2).all()
    assert np.isfinite((np.full(4095, most, dtype) ** 2).sum(dtype=dtype))
    brightest = color.luminance_of_moments((np.full((1, 1), most * 2, dtype),) * 3)
    np.testing.assert_allclose(brightest, most, rtol=1e-6)


def test_light_held_at_its_largest_does_not_change_with_the_albedo():
    """The derivative of min(r, most d) / d would be inf - inf."""
    radiance, albedo = (jnp.full((1, 2, 2, 3), value, jnp.float32) for value in (3e38, 1e-4))
    loss = lambda floor, light: jnp.sum(1e3 * color.demodulate(light, albedo, albedo_floor=floor))  # noqa: E731
    assert jax.grad(loss)(jnp.float32(1e-3), radiance) == 0.0
    dim = jnp.full_like(radiance, 3.0)
    assert jax.grad(loss)(jnp.float32(0.5), dim) == pytest.approx(-1e3 * 12 * 3 / 0.5**2)  # other light does
