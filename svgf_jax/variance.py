"""Luminance variance: from the accumulated moments, or from the neighbourhood while history is short (Schied et al. 2017, 4.2).

`Config.variance` chooses other estimators to compare with: "spatial" looks at the neighbourhood however long the history is;
"temporal" (as in CUDA-Path-Tracer-Denoising) never does: a constant without history, a multiple of M2 - M1^2 with it.
"""

from functools import reduce
from itertools import cycle

import jax.numpy as jnp
from jax import Array

from svgf_jax.edges import depth_gradient, geometry_exponent, guides_of
from svgf_jax.sampling import BY_WIDTH, add_up, in_strips, planes, square_offsets, sum_over_taps
from svgf_jax.types import Config, Frame, Params, at_level

SHORT_HISTORY = 4 - 1e-3  # history length is a real number: a mean of threes and fives must not be decided by rounding
_NO_HISTORY = 1 + 1e-3  # a length below this is the frame's own
_RADIUS = 3


def estimate_variance(
    moments: Array,
    history_length: Array,
    frame: Frame,
    *,
    params: Params,
    config: Config = Config(),
    strip_rows: int | None = BY_WIDTH,
) -> Array:
    """V = max(0, M2 - M1^2), temporal where history is long enough, else over 7 x 7 pixels.

    The spatial estimate is the mean of the moments over the window with the weights w_z w_n, and is multiplied by
    max(1, short_history_boost / h). Strips of the image in which no pixel needs it are skipped.

    Where the frame brings measured variances, M2 - M1^2 is their mean over time from the first frame on: the spatial estimate is
    then the weighted mean of the neighbours' M2 - M1^2, without a boost, and "temporal" needs no initial value. A frame that brings
    none that is known counts as one that brings none.

    Args:
        moments: `[S, H, W, 2]`, accumulated M1 and M2 of the luminance.
        history_length: `[H, W]`, h.
        frame: sanitised; its normal, depth and object_id guide the estimate; a signal's h is its longest_history at most.
        params: per-level leaves are read at entry 0.
        config: its `variance` says where which of the two is taken: "svgf" as above; "spatial": 7 x 7 everywhere; "temporal":
            initial_variance without history, else variance_scale * max(0, M2 - M1^2).
        strip_rows: how `sampling.sum_over_taps` blocks the work; None = the plain form.

    Returns:
        `[S, H, W]`, >= 0; 0 where there is no surface.
    """
    scalars = at_level(params, 0)
    guides, surface = guides_of(frame), frame.object_id != -1
    measured = None if frame.variance is None else (frame.variance >= 0.0).all(axis=0)
    lengths = (history_length,)  # one for all signals, or one each
    if frame.longest_history is not None:
        lengths = tuple(jnp.minimum(history_length, longest) for longest in frame.longest_history)
    if config.variance == "temporal":
        return _temporal_only(moments, lengths, surface, measured, scalars)
    shorts = tuple(surface & ((length < SHORT_HISTORY) | (config.variance == "spatial")) for length in lengths)
    slope = depth_gradient(frame.depth, frame.object_id)
    signals = own = tuple(planes(signal) for signal in moments)
    known = None if measured is None else add_up(measured) > 0
    if measured is not None and known is not None:
        # The neighbours' variances themselves are averaged: the spread of their means is no noise.
        guides = guides._replace(surface=guides.surface * (measured | ~known).astype(frame.depth.dtype))
        signals = tuple((jnp.where(known, 0.0, m1), jnp.where(known, _variance(m1, m2), m2)) for m1, m2 in own)
    offsets = square_offsets(_RADIUS)
    steps = offsets.astype(frame.depth.dtype)

    def tap(sums, q, p, t):
        distance_y, distance_x = t
        exponent = geometry_exponent(
            p["guides"],
            q["guides"],
            p["slope"][0] * distance_x + p["slope"][1] * distance_y,
            sigma_depth=scalars.sigma_depth,
            sigma_normal=scalars.sigma_normal,
            depth_epsilon=scalars.depth_epsilon,
        )
        weight = q["guides"].surface * jnp.exp(exponent)
        weights, totals = sums
        totals = tuple(
            (m1 + weight * q1, m2 + weight * q2) for (m1, m2), (q1, q2) in zip(totals, q["moments"], strict=True)
        )
        return weights + weight, totals

    def finish(sums, p):
        weights, totals = sums
        any_weight = weights > 1e-15
        divisor = jnp.where(any_weight, weights, 1.0)
        return tuple(
            _variance(
                jnp.where(any_weight, m1 / divisor, own1),
                jnp.where(any_weight, m2 / divisor, own2),
            )
            for (m1, m2), (own1, own2) in zip(totals, p["moments"], strict=True)
        )

    zero = jnp.zeros((), moments.dtype)
    neighbours = {"guides": guides, "moments": signals}
    spatial = sum_over_taps(
        tap,
        finish,
        neighbours=neighbours,
        centre={**neighbours, "slope": slope},
        offsets=offsets,
        per_tap=(jnp.asarray(steps[:, 0]), jnp.asarray(steps[:, 1])),
        sums=(zero, tuple((zero, zero) for _ in signals)),
        where=reduce(jnp.logical_or, shorts),
        strip_rows=strip_rows,
    )

    def choose(around, signals, lengths, shorts, surface):
        chosen = []
        for v, (m1, m2), length, short in zip(around, signals, cycle(lengths), cycle(shorts), strict=False):
            boost = jnp.maximum(1.0, scalars.short_history_boost / jnp.maximum(length, 1.0))
            boost = boost if known is None else jnp.where(known, 1.0, boost)
            chosen.append(jnp.where(surface, jnp.where(short, v * boost, _variance(m1, m2)), 0.0))
        return tuple(chosen)

    return jnp.stack(in_strips(choose, spatial, own, lengths, shorts, surface))


def _temporal_only(
    moments: Array, lengths: tuple[Array, ...], surface: Array, measured: Array | None, scalars: Params
) -> Array:
    def choose(signals, lengths, surface, measured):
        chosen = []
        for (m1, m2), length in zip(signals, cycle(lengths), strict=False):
            new = length < _NO_HISTORY
            new = new if measured is None else new & ~measured
            v = jnp.where(new, scalars.initial_variance, scalars.variance_scale * _variance(m1, m2))
            chosen.append(jnp.where(surface, v, 0.0))
        return tuple(chosen)

    signals = tuple(planes(signal) for signal in moments)
    return jnp.stack(in_strips(choose, signals, lengths, surface, measured))


def _variance(first: Array, second: Array) -> Array:
    # At 0 the derivative is 0 too (V is a minimum there); jnp.maximum would pass half of a rounding error on to sqrt, whose
    # derivative at a variance that a strong edge made tiny but not 0 is larger than 1e40.
    difference = second - first * first
    return jnp.where(difference > 0.0, difference, 0.0)
