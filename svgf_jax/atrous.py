"""The edge-avoiding a-trous wavelet filter on illumination and its variance (Schied et al. 2017, section 4.3)."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from svgf_jax.color import luminance_of_planes
from svgf_jax.edges import Guides, depth_gradient, geometry_exponent, guides_of, luminance_scale
from svgf_jax.sampling import (
    BY_WIDTH,
    add_margin,
    cut_margin,
    offsets_around,
    planes,
    renew_margin,
    square_offsets,
    stack_planes,
    sum_over_taps,
)
from svgf_jax.types import Config, Frame, Params, at_level

_OFFSETS = offsets_around(2)


def atrous_filter(
    illumination: Array,
    variance: Array,
    frame: Frame,
    *,
    params: Params,
    config: Config,
    strip_rows: int | None = BY_WIDTH,
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
    if config.levels == 0:
        return illumination, variance, illumination
    margin = 2 * 2 ** (config.levels - 1)  # kept from level to level: without, each would copy every plane
    geometry = guides_of(frame), depth_gradient(frame.depth, frame.object_id)
    guides, slope = add_margin(geometry, margin, margin)
    levels = range(config.levels)
    fed_back = config.feedback_level if config.feedback_level < config.levels else config.levels - 1

    def filter_level(state, level):
        (colors, variances, feedback), (scalars, step_size, feeds_back) = state, level
        colors, variances = renew_margin((colors, variances), margin)
        colors, variances = _filter_planes(
            colors,
            variances,
            guides,
            slope,
            scalars=scalars,
            step_size=step_size,
            margin=margin,
            prefilter=config.prefilter,
            strip_rows=strip_rows,
        )
        feedback = jax.tree.map(lambda new, old: jnp.where(feeds_back, new, old), colors, feedback)
        return (colors, variances, feedback), None

    given = tuple(planes(signal) for signal in illumination), tuple(variance)
    colors, variances = jax.tree.map(lambda a: jnp.pad(a, margin), given)
    state = (colors, variances, colors)
    if strip_rows is None:
        for i in levels:
            state, _ = filter_level(state, (at_level(params, i), 2**i, i == fed_back))
    else:  # compiled once for all levels
        scalars = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (config.levels,)), params)
        steps, feeds_back = jnp.asarray([2**i for i in levels], jnp.int32), jnp.asarray([i == fed_back for i in levels])
        state, _ = lax.scan(filter_level, state, (scalars, steps, feeds_back))
    colors, variances, feedback = cut_margin(state, margin)
    return stack_planes(colors), jnp.stack(variances), stack_planes(feedback)


def atrous_level(
    illumination: Array,
    variance: Array,
    frame: Frame,
    *,
    level: int,
    params: Params,
    prefilter: bool = True,
    strip_rows: int | None = BY_WIDTH,
) -> tuple[Array, Array]:
    """One level: C' = sum h w C / sum h w and V' = sum h^2 w^2 V / (sum h w)^2 over 5 x 5 taps 2**level apart (equations 1, 2).

    A zero sum of weights keeps the pixel. Shapes as in `atrous_filter`; `prefilter` as in `Config`.
    """
    margin = 2 * 2**level
    light = tuple(planes(signal) for signal in illumination), tuple(variance)
    geometry = guides_of(frame), depth_gradient(frame.depth, frame.object_id)
    colors, variances, guides, slope = add_margin((*light, *geometry), margin, margin)
    wide = _filter_planes(
        colors,
        variances,
        guides,
        slope,
        scalars=at_level(params, level),
        step_size=2**level,
        margin=margin,
        prefilter=prefilter,
        strip_rows=strip_rows,
    )
    colors, variances = cut_margin(wide, margin)
    return stack_planes(colors), jnp.stack(variances)


def _filter_planes(
    colors: tuple[tuple[Array, ...], ...],
    variances: tuple[Array, ...],
    guides: Guides,
    slope: tuple[Array, Array],
    *,
    scalars: Params,
    step_size: int | Array,
    margin: int,
    prefilter: bool,
    strip_rows: int | None,
) -> tuple[tuple[tuple[Array, ...], ...], tuple[Array, ...]]:
    """`atrous_level` on planes with a margin: S colours of three, S variances; `slope` is grad z."""
    dtype = guides.depth.dtype
    lumas = tuple(luminance_of_planes(*color) for color in colors)
    prefiltered = variances
    if prefilter:
        prefiltered = prefilter_variance(variances, guides.surface, margin=margin, strip_rows=strip_rows)
    scales = tuple(
        luminance_scale(v, sigma_luminance=scalars.sigma_luminance, luminance_epsilon=scalars.luminance_epsilon)
        for v in prefiltered
    )
    one = jnp.ones((), dtype)
    kernel = jnp.stack([jnp.asarray(k, dtype) * one for k in (scalars.kernel_far, scalars.kernel_near, 1.0)])
    kernel = jnp.concatenate([kernel, kernel[1::-1]])  # (far, near, 1, near, far)
    steps = jnp.asarray(_OFFSETS, dtype) * jnp.asarray(step_size, dtype)

    def geometry(p, q, depth_change):
        return geometry_exponent(
            p["guides"],
            q["guides"],
            depth_change,
            sigma_depth=scalars.sigma_depth,
            sigma_normal=scalars.sigma_normal,
            depth_epsilon=scalars.depth_epsilon,
        )

    def tap(sums, q, p, t):
        distance_y, distance_x, h = t
        exponent = geometry(p, q, p["slope"][0] * distance_x + p["slope"][1] * distance_y)
        kernel_weight = h * q["guides"].surface
        return tuple(
            _add_tap(
                total,
                kernel_weight * jnp.exp(exponent - jnp.abs(luma_p - luma_q) * scale),
                color,
                value,
            )
            for total, color, value, luma_p, luma_q, scale in zip(
                sums, q["color"], q["variance"], p["luma"], q["luma"], p["scale"], strict=True
            )
        )

    def alone(p):
        weight = kernel[2] * kernel[2] * p["guides"].surface * jnp.exp(geometry(p, p, zero))
        return tuple(
            _add_tap((zero, (zero, zero, zero), zero), weight, color, value)
            for color, value in zip(p["color"], p["variance"], strict=True)
        )

    def finish(sums, p):
        return tuple(
            _normalise(total, color, value) for total, color, value in zip(sums, p["color"], p["variance"], strict=True)
        )

    zero = jnp.zeros((), dtype)
    neighbours = {"guides": guides, "color": colors, "variance": variances, "luma": lumas}
    results = sum_over_taps(
        tap,
        finish,
        neighbours=neighbours,
        centre={**neighbours, "slope": slope, "scale": scales},
        offsets=_OFFSETS,
        step_size=step_size,
        margin=margin,
        per_tap=(steps[:, 0], steps[:, 1], kernel[_OFFSETS[:, 0] + 2] * kernel[_OFFSETS[:, 1] + 2]),
        sums=alone,
        strip_rows=strip_rows,
    )
    return tuple(color for color, _ in results), tuple(value for _, value in results)


def _add_tap(total, weight: Array, color: tuple[Array, ...], variance: Array):
    weights, colors, variances = total
    colors = tuple(c + weight * q for c, q in zip(colors, color, strict=True))
    return weights + weight, colors, variances + weight * (weight * variance)  # in this order derivatives stay finite


def _normalise(total, color: tuple[Array, ...], variance: Array):
    weights, colors, variances = total
    any_weight = weights > 1e-15  # below, the square in V' would leave float32
    divisor = jnp.where(any_weight, weights, 1.0)
    kept = tuple(jnp.where(any_weight, c / divisor, own) for c, own in zip(colors, color, strict=True))
    return kept, jnp.where(any_weight, variances / divisor / divisor, variance)


def prefilter_variance(
    variances: tuple[Array, ...], surface: Array, *, margin: int = 0, strip_rows: int | None = BY_WIDTH
) -> tuple[Array, ...]:
    """g: the 3 x 3 Gaussian (1/4, 1/8, 1/16) of variance planes `[H, W]`, renormalised over the taps with a surface.

    `margin` is the planes', as for `sum_over_taps`.
    """
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
        margin=margin,
        strip_rows=strip_rows,
    )
