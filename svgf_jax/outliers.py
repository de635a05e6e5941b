"""Outlier removal: fireflies are brought down to the light around them before they enter the history."""

import jax
import jax.numpy as jnp
from jax import Array

from svgf_jax.color import largest_luminance
from svgf_jax.sampling import BY_WIDTH, planes, stack_planes
from svgf_jax.types import Config, Frame, Params, SvgfError, at_level
from svgf_jax.windows import window_range


def remove_outliers(
    illumination: Array,
    frame: Frame,
    *,
    params: Params,
    config: Config,
    strip_rows: int | None = BY_WIDTH,
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
    colors = tuple(map(planes, illumination))
    sigma = at_level(params, 0).outlier_sigma
    return stack_planes(
        _clamp(colors, frame.object_id != -1, radius=config.outlier_radius, sigma=sigma, strip_rows=strip_rows)
    )


def clamp_outliers(image: Array, *, radius: int = 3, sigma: Array | float = 10.0, mask: Array | None = None) -> Array:
    """The same for any image, without a frame.

    Args:
        image: `[H, W, C]`, any C; NaN counts as 0, infinity as the largest color.
        radius: of the window, in pixels, >= 0; static. 0 = the image as it is.
        sigma: in standard deviations, >= 0; traced.
        mask: `[H, W]` bool, the pixels that count; the others are neither read nor changed. None = all.

    Returns:
        `[H, W, C]`.

    Raises:
        SvgfError: an image or a mask of another shape, a radius that is no whole number >= 0.
    """
    image = jnp.asarray(image)
    if image.ndim != 3 or image.shape[-1] == 0 or not jnp.issubdtype(image.dtype, jnp.floating):
        raise SvgfError(f"the image is {image.dtype} of shape {image.shape}; wanted real numbers, [H, W, C]")
    if mask is not None and jnp.shape(mask) != image.shape[:2]:
        raise SvgfError(f"mask has shape {jnp.shape(mask)}; the image is {image.shape}")
    if type(radius) is not int or radius < 0:
        raise SvgfError(f"radius = {radius!r}; wanted a whole number >= 0")
    if not radius:
        return image
    counts = jnp.ones(image.shape[:2], bool) if mask is None else jnp.asarray(mask, bool)
    limit = largest_luminance(image.dtype)
    known = jnp.where(counts[..., None], jnp.nan_to_num(image, posinf=limit, neginf=-limit), 0.0)
    clamped = jnp.stack(_clamp(planes(known), counts, radius=radius, sigma=sigma, strip_rows=BY_WIDTH), axis=-1)
    return jnp.where(counts[..., None], clamped, image)


def _clamp(colors, counts: Array, *, radius: int, sigma: Array | float, strip_rows: int | None):
    """A tree of planes `[H, W]`, each within its range where `counts`."""
    least, most = window_range(colors, counts, radius=radius, sigma=sigma, centre=False, strip_rows=strip_rows)
    clamp = lambda own, low, high: jnp.where(counts, jnp.minimum(jnp.maximum(own, low), high), own)  # noqa: E731
    return jax.tree.map(clamp, colors, least, most)
