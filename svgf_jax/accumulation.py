"""Temporal accumulation: exponential moving averages of illumination and luminance moments (Schied et al. 2017, section 4.1)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from svgf_jax.color import largest_luminance, luminance_of_planes
from svgf_jax.sampling import in_strips, planes, stack_planes
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

    def blend(colors, previous_colors, previous_moments, previous_length, valid, surface):
        length = jnp.where(valid, jnp.minimum(previous_length + 1.0, scalars.max_history), 1.0)
        weight = _blend_weight(scalars.alpha, length, valid)
        weight_moments = _blend_weight(scalars.alpha_moments, length, valid)
        lumas = [jnp.minimum(luminance_of_planes(*color), largest_luminance(length.dtype)) for color in colors]
        moments = [(luma, luma * luma) for luma in lumas]
        blended = (
            jax.tree.map(lambda old, new: _blend(old, new, weight), previous_colors, colors),
            jax.tree.map(lambda old, new: _blend(old, new, weight_moments), previous_moments, tuple(moments)),
            length,
        )
        return jax.tree.map(lambda a: jnp.where(surface, a, 0.0), blended)

    colors, moments, length = in_strips(
        blend,
        tuple(map(planes, illumination)),
        tuple(map(planes, previous.illumination)),
        tuple(map(planes, previous.moments)),
        previous.history_length,
        previous.valid,
        frame.object_id != -1,
    )
    return Accumulated(illumination=stack_planes(colors), moments=stack_planes(moments), history_length=length)


def _blend_weight(alpha: Array | float, length: Array, valid: Array) -> Array:
    return jnp.where(valid, jnp.maximum(alpha, 1.0 / jnp.maximum(length, 1.0)), 1.0)


def _blend(previous: Array, current: Array, weight: Array) -> Array:
    return (1.0 - weight) * previous + weight * current
