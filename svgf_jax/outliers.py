"""Outlier removal: fireflies are brought down to the light around them before they enter the history."""

import jax
import jax.numpy as jnp
from jax import Array

from svgf_jax.sampling import STRIP_ROWS, planes, stack_planes
from svgf_jax.types import Config, Frame, Params, at_level
from svgf_jax.windows import window_range


def remove_outliers(
    illumination: Array,
    frame: Frame,
    *,
    params: Params,
    config: Config,
    strip_rows: int | None = STRIP_ROWS,
) -> Array:
    """Clamp every pixel, channel by channel, to mean +- outlier_sigma standard deviations of its neighbours.

    The neighbours are the other pixels with a surface in a window of (2 outlier_radius + 1)^2. The pixel itself is left out: among
    n pixels, itself included, none lies more than (n - 1) / sqrt(n) deviations from the mean, 6.9 for 7 x 7, however bright it is.

    Args:
        illumination: `[S, H, W, 3]`, this frame's demodulated radiance.
        frame: sanitised; only its object_id is read.
        params: per-level leaves are read at entry 0.
        config: `outlier_radius` = 0 returns `illumination` as it is.
        strip_rows: how `sampling.sum_over_taps` blocks the work; None = the plain form.

    Returns:
        `[S, H, W, 3]`; pixels without a surface, or without a neighbour that has one, are unchanged.
    """
    if not config.outlier_radius:
        return illumination
    surface = frame.object_id != -1
    colors = tuple(map(planes, illumination))
    least, most = window_range(
        colors,
        surface,
        radius=config.outlier_radius,
        sigma=at_level(params, 0).outlier_sigma,
        centre=False,
        strip_rows=strip_rows,
    )
    clamp = lambda own, low, high: jnp.where(surface, jnp.minimum(jnp.maximum(own, low), high), own)  # noqa: E731
    return stack_planes(jax.tree.map(clamp, colors, least, most))
