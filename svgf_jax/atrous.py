"""The edge-avoiding a-trous wavelet filter on illumination and its variance (Schied et al. 2017, section 4.3)."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from svgf_jax.color import luminance_of_planes
from svgf_jax.edges import depth_gradient, geometry_exponent, guides_of, luminance_scale
from svgf_jax.sampling import STRIP_ROWS, planes, square_offsets, sum_over_taps
from svgf_jax.types import Config, Frame, Params, at_level

_OFFSETS = square_offsets(2)


def atrous_filter(
    illumination: Array,
    variance: Array,
    frame: Frame,
    *,
    params: Params,
    config: Config,
    strip_rows: int | None = STRIP_ROWS,
) -> tuple[Array, Array, Array]:
    """All levels, with step sizes 1, 2, 4, ...

    Args:
        illumination: `[S, H, W, 3]`, accumulated.
        variance: `[S, H, W]`, of its luminance.
        frame: sanitised; its normal, depth and object_id guide the filter.
        params, config: see there.
        strip_rows: how `sampling.sum_over_taps` blocks the work; None = the plain form.

    Returns:
        The filtered illumination, the filtered variance, and the illumination to feed back into the history.
    """
    feedback = illumination
    for level in range(config.levels):
        illumination, variance = atrous_level(
            illumination, variance, frame, level=level, params=params, strip_rows=strip_rows
        )
        if level == min(config.feedback_level, config.levels - 1):
            feedback = illumination
    return illumination, variance, feedback


def atrous_level(
    illumination: Array,
    variance: Array,
    frame: Frame,
    *,
    level: int,
    params: Params,
    strip_rows: int | None = STRIP_ROWS,
) -> tuple[Array, Array]:
    """One level: C' = sum h w C / sum h w and V' = sum h^2 w^2 V / (sum h w)^2 over 5 x 5 taps 2**level apart (equations 1, 2).

    A zero sum of weights keeps the pixel. Shapes as in `atrous_filter`.
    """
    scalars = at_level(params, level)
    guides = guides_of(frame)
    slope_x, slope_y = depth_gradient(frame.depth, frame.object_id)
    colors = tuple(planes(signal) for signal in illumination)
    variances = tuple(variance)
    lumas = tuple(luminance_of_planes(*color) for color in colors)
    prefiltered = prefilter_variance(variances, guides.surface, strip_rows=strip_rows)
    scales = tuple(
        luminance_scale(v, sigma_luminance=scalars.sigma_luminance, luminance_epsilon=scalars.luminance_epsilon)
        for v in prefiltered
    )
    one = jnp.ones((), illumination.dtype)
    kernel = jnp.stack(
        [jnp.asarray(k, illumination.dtype) * one for k in (scalars.kernel_far, scalars.kernel_near, 1.0)]
    )
    kernel = jnp.concatenate([kernel, kernel[1::-1]])  # (far, near, 1, near, far)
    steps = (_OFFSETS * 2**level).astype(illumination.dtype)

    def tap(sums, q, p, t):
        distance_y, distance_x, h = t
        geometry = geometry_exponent(
            p["guides"],
            q["guides"],
            p["slope"][0] * distance_x + p["slope"][1] * distance_y,
            sigma_depth=scalars.sigma_depth,
            sigma_normal=scalars.sigma_normal,
            depth_epsilon=scalars.depth_epsilon,
        )
        kernel_weight = h * q["guides"].surface
        return tuple(
            _add_tap(
                total,
                kernel_weight * jnp.exp(geometry - jnp.abs(luma_p - luma_q) * scale),
                color,
                value,
            )
            for total, color, value, luma_p, luma_q, scale in zip(
                sums, q["color"], q["variance"], p["luma"], q["luma"], p["scale"], strict=True
            )
        )

    def finish(sums, p):
        return tuple(
            _normalise(total, color, value) for total, color, value in zip(sums, p["color"], p["variance"], strict=True)
        )

    zero = jnp.zeros((), illumination.dtype)
    neighbours = {"guides": guides, "color": colors, "variance": variances, "luma": lumas}
    results = sum_over_taps(
        tap,
        finish,
        neighbours=neighbours,
        centre={**neighbours, "slope": (slope_x, slope_y), "scale": scales},
        offsets=_OFFSETS * 2**level,
        per_tap=(jnp.asarray(steps[:, 0]), jnp.asarray(steps[:, 1]), jnp.outer(kernel, kernel).reshape(-1)),
        sums=tuple((zero, (zero, zero, zero), zero) for _ in colors),
        strip_rows=strip_rows,
    )
    filtered = jnp.stack([jnp.stack(color, axis=-1) for color, _ in results])
    return filtered, jnp.stack([value for _, value in results])


def _add_tap(total, weight: Array, color: tuple[Array, ...], variance: Array):
    weights, colors, variances = total
    colors = tuple(c + weight * q for c, q in zip(colors, color, strict=True))
    return weights + weight, colors, variances + weight * weight * variance


def _normalise(total, color: tuple[Array, ...], variance: Array):
    weights, colors, variances = total
    any_weight = weights > 1e-15  # below, the square in V' would leave float32
    divisor = jnp.where(any_weight, weights, 1.0)
    kept = tuple(jnp.where(any_weight, c / divisor, own) for c, own in zip(colors, color, strict=True))
    return kept, jnp.where(any_weight, variances / divisor / divisor, variance)


def prefilter_variance(
    variances: tuple[Array, ...], surface: Array, *, strip_rows: int | None = STRIP_ROWS
) -> tuple[Array, ...]:
    """g: the 3 x 3 Gaussian (1/4, 1/8, 1/16) of variance planes `[H, W]`, renormalised over the taps with a surface."""
    kernel = np.outer([0.25, 0.5, 0.25], [0.25, 0.5, 0.25]).reshape(-1)

    def tap(sums, q, p, h):
        weights, totals = sums
        weight = h * q[1]
        return weights + weight, tuple(t + weight * v for t, v in zip(totals, q[0], strict=True))

    def finish(sums, p):
        weights, totals = sums
        any_weight = weights > 0.0
        return tuple(jnp.where(any_weight, t / jnp.where(any_weight, weights, 1.0), 0.0) for t in totals)

    zero = jnp.zeros((), surface.dtype)
    return sum_over_taps(
        tap,
        finish,
        neighbours=(variances, surface),
        centre=surface,
        offsets=square_offsets(1),
        per_tap=jnp.asarray(kernel, surface.dtype),
        sums=(zero, jax.tree.map(lambda _: zero, variances)),
        strip_rows=strip_rows,
    )
