"""Repair what a renderer should not have written, before it can enter the history, and count it."""

import jax.numpy as jnp
from jax import Array

from svgf_jax.color import largest_luminance
from svgf_jax.sampling import add_up, planes
from svgf_jax.types import Frame, Rejected

_NOWHERE = 1e9  # a motion that points outside every image: no history
_LARGEST_RADIANCE = 2.0**40
"""Hundreds of times the sun in cd/m^2. Derivatives hold products of several radiances; of larger ones they would leave float32."""
_LARGEST_ALBEDO = 2.0**20
"""Derivatives of what is spread to a pixel are multiplied by its albedo, and divided by the squares of others."""


def sanitise(frame: Frame) -> tuple[Frame, Rejected]:
    """Make every number of a frame finite.

    Radiance: non-finite or negative components become 0, those above 2**40 become that. Emission: non-finite ones become 0,
    negative ones stay. A non-finite normal, depth, albedo or position, or a depth beyond 2e17 (in float32): no surface. A
    normal that is not of unit length by more than 1 % is brought to it; one of zeros stays. A larger albedo than 2**20 counts
    as that, in dividing by it as in multiplying. A non-finite motion or prev_depth: no history. Guides read 0 where there is
    no surface, the albedo 1. A measured variance that is not finite or negative becomes -1, unknown. A non-finite
    reflected motion or depth, or such a depth beyond 2e17: the reflection moves with the surface.

    Args:
        frame: one frame; shapes as in `Frame`.

    Returns:
        The repaired frame and the counts of repaired pixels.
    """
    radiance_finite, emission_finite = jnp.isfinite(frame.radiance), jnp.isfinite(frame.emission)
    negative = radiance_finite & (frame.radiance < 0.0)
    radiance_bright = radiance_finite & (frame.radiance > _LARGEST_RADIANCE)
    was_surface = frame.object_id != -1
    guided = (
        jnp.isfinite(frame.normal).all(axis=-1) & _usable(frame.depth) & jnp.isfinite(frame.albedo).all(axis=(0, 3))
    )
    if frame.position is not None:
        guided &= jnp.isfinite(frame.position).all(axis=-1)
    traced = jnp.isfinite(frame.motion).all(axis=-1) & _usable(frame.prev_depth)
    surface = was_surface & guided
    normal, unusual = _to_unit_length(jnp.where(surface[..., None], frame.normal, 0.0))

    repaired = Frame(
        radiance=jnp.minimum(jnp.where(radiance_finite & ~negative, frame.radiance, 0.0), _LARGEST_RADIANCE),
        albedo=jnp.where(surface[None, :, :, None], jnp.minimum(frame.albedo, _LARGEST_ALBEDO), 1.0),
        emission=jnp.where(emission_finite, frame.emission, 0.0),
        normal=normal,
        depth=jnp.where(surface, frame.depth, 0.0),
        prev_depth=jnp.where(surface & traced, frame.prev_depth, 0.0),
        motion=jnp.where((surface & traced)[..., None], frame.motion, _NOWHERE),
        object_id=jnp.where(surface, frame.object_id, -1),
        variance=None if frame.variance is None else _known_variance(frame.variance),
        position=None if frame.position is None else jnp.where(surface[..., None], frame.position, 0.0),
        **_reflections(frame, surface),
    )
    rejected = Rejected(
        radiance=add_up(~radiance_finite.all(axis=(0, 3))),
        negative=add_up(negative.any(axis=(0, 3))),
        emission=add_up(~emission_finite.all(axis=-1)),
        surface=add_up(was_surface & ~guided),
        motion=add_up(surface & ~traced),
        normal=add_up(unusual),
        bright=add_up(radiance_bright.any(axis=(0, 3))),
    )
    return repaired, rejected


def _usable(depth: Array) -> Array:
    """Depths are multiplied by each other, in the derivatives of their weights."""
    return jnp.abs(depth) < float(jnp.finfo(depth.dtype).max) ** 0.5 / 2**6


def _to_unit_length(normal: Array) -> tuple[Array, Array]:
    """Longer ones would weigh more than all else together: 1.1 ** 128 = 200000. A unit normal stays as it is, to the bit."""
    x, y, z = planes(normal)
    largest = jnp.maximum(jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.abs(z))
    some = largest > 1e-18
    divisor = jnp.where(some, largest, 1.0)
    scaled = tuple(c / divisor for c in (x, y, z))  # squares neither overflow nor vanish
    square = jnp.where(some, scaled[0] * scaled[0] + scaled[1] * scaled[1] + scaled[2] * scaled[2], 1.0)
    unusual = some & (jnp.abs(square * largest * largest - 1.0) > 0.02)
    length = jnp.sqrt(square)
    return jnp.stack(
        [jnp.where(unusual, s / length, c) for s, c in zip(scaled, (x, y, z), strict=True)], axis=-1
    ), unusual


def _reflections(frame: Frame, surface: Array) -> dict[str, Array]:
    """What is not finite, or too far, moves with the surface; a length that is not a number is that of this frame alone."""
    if frame.reflected_motion is None:
        return {}
    assert frame.reflected_prev_depth is not None  # `check_frame` saw to it: all three or none
    assert frame.longest_history is not None
    traced = surface[None] & jnp.isfinite(frame.reflected_motion).all(axis=-1) & _usable(frame.reflected_prev_depth)
    longest = jnp.where(jnp.isfinite(frame.longest_history), frame.longest_history, 1.0)
    return {
        "reflected_motion": jnp.where(traced[..., None], frame.reflected_motion, _NOWHERE),
        "reflected_prev_depth": jnp.where(traced, frame.reflected_prev_depth, 0.0),
        "longest_history": jnp.maximum(longest, 1.0),
    }


def _known_variance(variance: Array) -> Array:
    """Kept so small that its division by the square of the least albedo floor, 2**-30, stays finite."""
    known = jnp.isfinite(variance) & (variance >= 0.0)
    return jnp.where(known, jnp.minimum(variance, largest_luminance(variance.dtype) ** 2 / 2.0**60), -1.0)
