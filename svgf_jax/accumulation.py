"""Temporal accumulation: exponential moving averages of illumination and luminance moments (Schied et al. 2017, section 4.1)."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from svgf_jax.color import luminance
from svgf_jax.types import Frame, Params, Reprojected, at_level


class Accumulated(NamedTuple):
    """Illumination `[S, H, W, 3]`, moments `[S, H, W, 2]` and history length `[H, W]` with this frame in; 0 without a surface."""

    illumination: Array
    moments: Array
    history_length: Array


def accumulate(illumination: Array, previous: Reprojected, frame: Frame, *, params: Params) -> Accumulated:
    """Blend this frame into its history with a = max(alpha, 1/h), h = min(prev_h + 1, max_history); a = 1 without history.

    Args:
        illumination: `[S, H, W, 3]`, this frame's demodulated radiance.
        previous: the reprojected history.
        frame: sanitised; only its object_id is read.
        params: per-level leaves are read at entry 0.
    """
    scalars = at_level(params, 0)
    surface = frame.object_id != -1
    length = jnp.where(previous.valid, jnp.minimum(previous.history_length + 1.0, scalars.max_history), 1.0)
    weight = _blend_weight(scalars.alpha, length, previous.valid)[None, :, :, None]
    weight_moments = _blend_weight(scalars.alpha_moments, length, previous.valid)[None, :, :, None]

    luma = jnp.minimum(luminance(illumination), _largest_luminance(illumination.dtype))
    moments = jnp.stack([luma, luma * luma], axis=-1)
    blended = _blend(previous.illumination, illumination, weight)
    blended_moments = _blend(previous.moments, moments, weight_moments)
    return Accumulated(
        illumination=jnp.where(surface[None, :, :, None], blended, 0.0),
        moments=jnp.where(surface[None, :, :, None], blended_moments, 0.0),
        history_length=jnp.where(surface, length, 0.0),
    )


def _blend_weight(alpha: Array | float, length: Array, valid: Array) -> Array:
    return jnp.where(valid, jnp.maximum(alpha, 1.0 / jnp.maximum(length, 1.0)), 1.0)


def _blend(previous: Array, current: Array, weight: Array) -> Array:
    return (1.0 - weight) * previous + weight * current


def _largest_luminance(dtype) -> float:
    """Squares of luminances below this, and sums of them with weights, stay finite."""
    return float(jnp.finfo(dtype).max) ** 0.5 / 2**6
