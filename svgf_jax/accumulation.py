"""Temporal accumulation: exponential moving averages of illumination and luminance moments (Schied et al. 2017, section 4.1).

Before it, by choice, the clamp of temporal anti-aliasing (Karis 2014) and of GAMES202's homework 5: history that is nothing like
its surroundings now is drawn towards them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from svgf_jax.color import luminance_of_moments, luminance_of_planes
from svgf_jax.sampling import BY_WIDTH, in_strips, planes, stack_planes
from svgf_jax.types import Config, Frame, Params, Reprojected, at_level
from svgf_jax.windows import window_range

_LEAST_WORTH = 1e-2  # frames; of less, the quotient and its derivative would soon be infinite


class Accumulated(NamedTuple):
    """Illumination `[S, H, W, 3]`, moments `[S, H, W, 2]` and history length `[H, W]` with this frame in; 0 without a surface."""

    illumination: Array
    moments: Array
    history_length: Array


def accumulate(
    illumination: Array, previous: Reprojected, frame: Frame, *, params: Params, config: Config = Config()
) -> Accumulated:
    """Blend this frame into its history with a = max(alpha, 1/h), h = min(prev_h + 1, max_history); a = 1 without history.

    Where the frame says how long a signal's history is worth keeping, that signal's h is at most that.

    Where the frame brings a measured variance v of its pixels' means, the second moment is M1^2 + (1 - a) V' + a v with V' the
    variance in the history, so that M2 - M1^2 is a mean of measured variances; it is right from the first frame on.

    Args:
        illumination: `[S, H, W, 3]`, this frame's demodulated radiance.
        previous: the reprojected history.
        frame: sanitised; its object_id and longest_history are read, and its variance and radiance where it has a variance.
        params: per-level leaves are read at entry 0.
        config: without `warm_up`, a = alpha wherever there is history.
    """
    scalars = at_level(params, 0)
    measured = None if frame.variance is None else tuple(zip(frame.variance, map(planes, frame.radiance), strict=True))

    def blend(colors, previous_colors, previous_moments, previous_length, valid, surface, measured, longest):
        length = jnp.where(valid, jnp.minimum(previous_length + 1.0, scalars.max_history), 1.0)
        least = _least_weight(length, config)
        weight = _blend_weight(scalars.alpha, least, valid)
        weight_moments = _blend_weight(scalars.alpha_moments, least, valid)
        if longest is not None:  # a shorter history is one that leans more on this frame
            previous_colors, previous_moments = _shortened(
                previous_colors, previous_moments, colors, longest, (weight, weight_moments)
            )
        lumas = [luminance_of_moments(color) for color in colors]
        moments = [(luma, luma * luma) for luma in lumas]
        blended_moments = jax.tree.map(
            lambda old, new: _blend(old, new, weight_moments), previous_moments, tuple(moments)
        )
        if measured is not None:
            blended_moments = tuple(
                (m1, _measured_moment(m1, m2, old, luma, variance, radiance, weight_moments))
                for (m1, m2), old, luma, (variance, radiance) in zip(
                    blended_moments, previous_moments, lumas, measured, strict=True
                )
            )
        blended = (
            jax.tree.map(lambda old, new: _blend(old, new, weight), previous_colors, colors),
            blended_moments,
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
        measured,
        None if frame.longest_history is None else tuple(frame.longest_history),
    )
    return Accumulated(illumination=stack_planes(colors), moments=stack_planes(moments), history_length=length)


def effective_history(
    previous: Reprojected, history_length: Array, frame: Frame, *, params: Params, config: Config = Config()
) -> Array | None:
    """How many frames the accumulated illumination is worth by its noise: n = 1 / ((1 - a)^2 / prev_n + a^2), a as in `accumulate`.

    A mean of n frames with equal weights has as much noise per pixel. What spatial filters take away, and the bilinear mean of
    reprojection, is not counted, nor what a clamp does.

    Args:
        previous: the reprojected history; without an `effective_history` there is none here either.
        history_length: `[H, W]`, the accumulated one.
        frame: sanitised; its object_id and longest_history are read.
        params: per-level leaves are read at entry 0.
        config: its `warm_up` is read.

    Returns:
        `[S, H, W]`, n; 0 where there is no surface.
    """
    if previous.effective_history is None:
        return None
    alpha = at_level(params, 0).alpha

    def count(signals, length, valid, surface, longest):
        least = _least_weight(length, config)
        weight = _blend_weight(alpha, least, valid)
        weights = [weight for _ in signals] if longest is None else [jnp.maximum(weight, 1.0 / n) for n in longest]
        noise = [(1.0 - a) ** 2 / jnp.maximum(n, _LEAST_WORTH) + a**2 for n, a in zip(signals, weights, strict=True)]
        return tuple(jnp.where(surface, 1.0 / jnp.maximum(share, 1e-9), 0.0) for share in noise)

    longest = None if frame.longest_history is None else tuple(frame.longest_history)
    surface = frame.object_id != -1
    return jnp.stack(
        in_strips(count, tuple(previous.effective_history), history_length, previous.valid, surface, longest)
    )


def clamp_history(
    previous: Reprojected,
    illumination: Array,
    frame: Frame,
    *,
    params: Params,
    config: Config,
    strip_rows: int | None = BY_WIDTH,
) -> Reprojected:
    """Clamp the history, channel by channel, to mean +- clamp_sigma standard deviations of this frame around each pixel.

    The window has (2 clamp_radius + 1)^2 pixels, of which those with a surface count. The moments are left as they are: they tell
    how much the light varies over time.

    Args:
        previous: the reprojected history.
        illumination: `[S, H, W, 3]`, this frame's.
        frame: sanitised; only its object_id is read.
        params: per-level leaves are read at entry 0.
        config: `clamp_radius` 0 returns `previous` as it is.
        strip_rows: how `sampling.sum_over_taps` blocks the work; None = the plain form.
    """
    if not config.clamp_radius:
        return previous
    sigma = at_level(params, 0).clamp_sigma
    colors = tuple(map(planes, illumination))
    least, most = window_range(
        colors, frame.object_id != -1, radius=config.clamp_radius, sigma=sigma, strip_rows=strip_rows
    )
    clamp = lambda old, low, high: jnp.minimum(jnp.maximum(old, low), high)  # noqa: E731
    clamped = jax.tree.map(clamp, tuple(map(planes, previous.illumination)), least, most)
    # Where there is no history the 0 stays: nothing reads it, and nothing should.
    held = jax.tree.map(lambda a: jnp.where(previous.valid, a, 0.0), clamped)
    return previous._replace(illumination=stack_planes(held))


def _shortened(previous_colors, previous_moments, colors, longest, weights: tuple[Array, Array]):
    """History drawn towards this frame so far that blending with the weight a gives what the weight max(a, 1 / longest) would."""
    out_colors, out_moments = [], []
    for old, pair, color, frames in zip(previous_colors, previous_moments, colors, longest, strict=True):
        share, share_moments = (jnp.maximum(1.0 / frames - a, 0.0) / jnp.maximum(1.0 - a, 1e-6) for a in weights)
        luma = luminance_of_moments(color)
        out_colors.append(tuple(_blend(o, c, share) for o, c in zip(old, color, strict=True)))
        out_moments.append((_blend(pair[0], luma, share_moments), _blend(pair[1], luma * luma, share_moments)))
    return tuple(out_colors), tuple(out_moments)


def _measured_moment(
    first: Array, second: Array, previous: tuple[Array, Array], luma: Array, variance: Array, radiance, weight: Array
) -> Array:
    """The second moment that makes M2 - M1^2 the mean of the measured variances; the plain one where it was not measured.

    The variance is the radiance's; its deviation is demodulated as the pixel's luminance was, which is exact where samples differ
    in brightness, not in hue.
    """
    light = luminance_of_planes(*radiance)
    lit = light > 0.0
    ratio = jnp.minimum(jnp.where(lit, luma / jnp.where(lit, light, 1.0), 1.0), 2.0**30)
    past = jnp.maximum(previous[1] - previous[0] * previous[0], 0.0)
    measured = first * first + _blend(past, variance * ratio * ratio, weight)
    return jnp.where(variance >= 0.0, measured, second)


def _least_weight(length: Array, config: Config) -> Array:
    return 1.0 / jnp.maximum(length, 1.0) if config.warm_up else jnp.zeros_like(length)


def _blend_weight(alpha: Array | float, least: Array, valid: Array) -> Array:
    return jnp.where(valid, jnp.maximum(alpha, least), 1.0)


def _blend(previous: Array, current: Array, weight: Array) -> Array:
    return (1.0 - weight) * previous + weight * current
