"""Modulation: put the albedo back, add up the signals, and add the emission."""

import jax.numpy as jnp
from jax import Array

from svgf_jax.color import remodulate
from svgf_jax.sampling import in_strips, planes
from svgf_jax.types import Frame


def modulate(illumination: Array, frame: Frame, *, albedo_floor: Array | float = 1e-3) -> Array:
    """image = sum over signals of illumination * max(albedo, albedo_floor) + emission.

    A pixel without a surface passes through: radiance + emission.

    Args:
        illumination: `[S, H, W, 3]`, filtered.
        frame: sanitised.
        albedo_floor: the one that `demodulate` had.

    Returns:
        `[H, W, 3]`, scene-linear.
    """

    def add_up(signals, albedos, radiances, emission, surface):
        total = emission
        for i, (signal, radiance) in enumerate(zip(signals, radiances, strict=True)):
            albedo = albedos[i % len(albedos)]  # one for all, or one each
            reflected = (remodulate(c, a, albedo_floor=albedo_floor) for c, a in zip(signal, albedo, strict=True))
            passed = (jnp.where(surface, r, own) for r, own in zip(reflected, radiance, strict=True))
            total = tuple(t + c for t, c in zip(total, passed, strict=True))
        # Each is finite; two of the brightest are not, together.
        return tuple(jnp.minimum(t, float(jnp.finfo(t.dtype).max)) for t in total)

    image = in_strips(
        add_up,
        tuple(map(planes, illumination)),
        tuple(map(planes, frame.albedo)),
        tuple(map(planes, frame.radiance)),
        planes(frame.emission),
        frame.object_id != -1,
    )
    return jnp.stack(image, axis=-1)
