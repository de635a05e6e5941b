"""Colour arithmetic: luminance, and demodulation by albedo."""

from typing import Any

import jax.numpy as jnp
from jax import Array, lax

from svgf_jax.sampling import planes, stack_planes

LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709, linear


def luminance(color: Array) -> Array:
    """Rec. 709 luminance of linear RGB: `[..., 3]` -> `[...]`."""
    return luminance_of_planes(color[..., 0], color[..., 1], color[..., 2])


def luminance_of_planes(red: Array, green: Array, blue: Array) -> Array:
    """Rec. 709 luminance of three planes of one shape."""
    return LUMINANCE[0] * red + LUMINANCE[1] * green + LUMINANCE[2] * blue


def largest_luminance(dtype: Any) -> float:
    """Squares of luminances up to this, and sums of them with weights, stay finite."""
    return float(jnp.finfo(dtype).max) ** 0.5 / 2**6


def luminance_of_moments(color: tuple[Array, ...]) -> Array:
    """Luminance as the moments take it: limited, so that its square is finite."""
    return jnp.minimum(luminance_of_planes(*color), largest_luminance(color[0].dtype))


def demodulate(radiance: Array, albedo: Array, *, albedo_floor: Array | float = 1e-3) -> Array:
    """Illumination: radiance / max(albedo, albedo_floor), per signal and channel.

    The result is kept below the largest float / 2**12, so that sums of it stay finite; sanitised frames are far from it.

    Args:
        radiance: `[S, H, W, 3]`, finite, >= 0.
        albedo: `[S or 1, H, W, 3]`, finite.
        albedo_floor: > 0.

    Returns:
        `[S, H, W, 3]`.
    """
    largest = float(jnp.finfo(radiance.dtype).max) / 2**12
    divisors = jnp.broadcast_to(jnp.maximum(albedo, albedo_floor), radiance.shape)
    return stack_planes(  # the quotient last: XLA:CPU then computes a plane once, whoever reads it
        tuple(
            tuple(_quotient(r, d, largest) for r, d in zip(planes(signal), planes(divisor), strict=True))
            for signal, divisor in zip(radiance, divisors, strict=True)
        )
    )


def _quotient(light: Array, divisor: Array, largest: float) -> Array:
    """At most `largest`, where it does not change with the divisor: derivatives of the two would be beyond float32 each."""
    divisor = jnp.where(light < largest * divisor, divisor, lax.stop_gradient(divisor))
    return jnp.minimum(light, largest * divisor) / divisor


def remodulate(illumination: Array, albedo: Array, *, albedo_floor: Array | float = 1e-3) -> Array:
    """The inverse of `demodulate`, with the same floor, so that an identity filter is lossless. Shapes as there."""
    return illumination * jnp.maximum(albedo, albedo_floor)
