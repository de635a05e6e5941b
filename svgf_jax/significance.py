"""Whether the light over a neighbourhood of cells has changed by more than its noise, and the correction that follows.

Steps 1 and 2 of `adaptation`, whose docstring has the formulas, on the grid of cells.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from svgf_jax.cells import Color
from svgf_jax.color import luminance_of_planes
from svgf_jax.edges import NEVER, Guides, geometry_exponent
from svgf_jax.sampling import add_margin, cut_margin, in_strips, renew_margin, square_offsets, sum_over_taps
from svgf_jax.types import Params

GAIN_LEVELS = 4  # a-trous levels on the grid of cells: reach of +-15 cells
OFFSET_LEVELS = 1  # +-1 cell
LARGEST_GAIN = 50.0
TINY = 1e-12
_OFFSETS = square_offsets(1)
_KERNEL = np.array([1, 2, 1]) / 4.0  # 9 taps to the B3 spline's 25, and half its variance
_DARK = 1e-6  # mean luminance below which a ratio means nothing


class Cells(NamedTuple):
    """What is known of the cells, planes `[h, w]`; a cell's guides are those of its central pixel.

    Attributes:
        guides, slope: of the central pixels.
        weight: sum of the weights w of the cell's pixels that have history; 0 = nothing known.
        square: sum of w^2.
    """

    guides: Guides
    slope: tuple[Array, Array]
    weight: Array
    square: Array


class Sums(NamedTuple):
    """Weighted sums over the pixels of a cell, of one signal.

    Attributes:
        current, previous: color of this frame and of the history.
        current2, product, previous2: of l^2, l prev_l and prev_l^2, for the luminances l and prev_l.
        noise: of the variance that the history's moments tell.
    """

    current: Color
    previous: Color
    current2: Array
    product: Array
    previous2: Array
    noise: Array


class Compared(NamedTuple):
    """Weighted sums again, with the history corrected by what is known so far.

    Attributes:
        current, previous: color of this frame and of the corrected history.
        square: of the squared difference of their luminances.
        noise: of the variance that the history's moments tell, scaled with the light.
    """

    current: Color
    previous: Color
    square: Array
    noise: Array


class Gain(NamedTuple):
    """Step 1, of one signal.

    Attributes:
        color: factor per color channel.
        luminance: the factor on the first moment.
        significance: s.
        noise: that this brings in, in frames' noise.
    """

    color: Color
    luminance: Array
    significance: Array
    noise: Array


class Offset(NamedTuple):
    """Step 2, of one signal, and what both steps make of the moments and the noise.

    Attributes:
        color: what is added per color channel.
        keep, variance: new variance = keep * old one + variance.
        dimmed, noise: noise of the history, in frames' noise: new = dimmed * old + noise.
    """

    color: Color
    keep: Array
    variance: Array
    dimmed: Array
    noise: Array


class Correction(NamedTuple):
    """What a cell says about its surroundings, of one signal: H' = gain H + offset per color channel, the rest as in `Offset`."""

    gain: Color
    luminance_gain: Array
    offset: Offset


def compare(current: Color, history: Color, moments) -> Sums:
    """What a pixel adds to the sums of its cell."""
    most = brightest(moments[0].dtype)
    current, history = jax.tree.map(lambda c: jnp.minimum(c, most), (current, history))
    l, prev_l = luminance_of_planes(*current), luminance_of_planes(*history)  # noqa: E741
    noise = jnp.clip(moments[1] - moments[0] * moments[0], 0.0, most * most)
    return Sums(current, history, l * l, l * prev_l, prev_l * prev_l, noise)


def judge(cells: Cells, sums: tuple[Sums, ...], *, size: int, scalars: Params) -> tuple[Correction, ...]:
    """The correction of every cell. What a strip gives back is new: all else would be copied."""
    one, zero = (jnp.asarray(number, cells.weight.dtype) for number in (1.0, 0.0))
    as_it_is = (Gain((one,) * 3, one, zero, zero),) * len(sums)
    pool = partial(_pool, cells, size=size, scalars=scalars)

    def as_it_was(sums) -> list[Array]:
        return [compared.square for compared in _correct_sums(sums, as_it_is)]

    def after_gain(wide, sums):
        gains = _gains(*_means(*wide, levels=GAIN_LEVELS), threshold=scalars.light_gain_threshold)
        left = [compared._replace(current=()) for compared in _correct_sums(sums, gains)]
        return gains, left

    def after_offset(narrow, gains) -> tuple[Offset, ...]:
        return _offsets(*_means(*narrow, levels=OFFSET_LEVELS), gains, threshold=scalars.light_offset_threshold)

    squares = in_strips(as_it_was, sums)
    compared = tuple(Compared(s.current, s.previous, square, s.noise) for s, square in zip(sums, squares, strict=True))
    gains, left = in_strips(after_gain, pool(compared, levels=GAIN_LEVELS), sums)
    left = tuple(compared._replace(current=s.current) for compared, s in zip(left, sums, strict=True))
    offsets = in_strips(after_offset, pool(left, levels=OFFSET_LEVELS), gains)
    return tuple(Correction(g.color, g.luminance, offset) for g, offset in zip(gains, offsets, strict=True))


def _gains(effective: Array, wide: tuple[Compared, ...], *, threshold) -> tuple[Gain, ...]:
    out = []
    for current, previous, square, noise in wide:
        significance, _ = _significance(current, previous, square, effective, threshold, noise)
        scale = luminance_of_planes(*previous)
        luminance_gain = _ratio(luminance_of_planes(*current), scale, scale, significance)
        gain = tuple(_ratio(c, p, scale, significance) for c, p in zip(current, previous, strict=True))
        out.append(Gain(gain, luminance_gain, significance, significance**2 * effective))
    return tuple(out)


def _offsets(effective: Array, narrow: tuple[Compared, ...], gains, *, threshold) -> tuple[Offset, ...]:
    out = []
    for (current, previous, square, noise), gain in zip(narrow, gains, strict=True):
        significance, observed = _significance(current, previous, square, effective, threshold, noise)
        offset = tuple(significance * (c - p) for c, p in zip(current, previous, strict=True))
        neither = (1.0 - gain.significance) * (1.0 - significance)
        scale = luminance_of_planes(*previous)
        grown = _ratio(luminance_of_planes(*current), scale, scale, significance)
        keep = neither * (gain.luminance * grown) ** 2
        dimmed = 1.0 / jnp.minimum(grown, 1.0) ** 2
        out.append(
            Offset(offset, keep, (1.0 - neither) * observed, dimmed, gain.noise * dimmed + significance**2 * effective)
        )
    return tuple(out)


def _correct_sums(sums: tuple[Sums, ...], gains: tuple[Gain, ...]) -> tuple[Compared, ...]:
    out = []
    for s, gain in zip(sums, gains, strict=True):
        previous = tuple(g * p for g, p in zip(gain.color, s.previous, strict=True))
        square = s.current2 - 2.0 * gain.luminance * s.product + gain.luminance**2 * s.previous2
        out.append(Compared(s.current, previous, jnp.maximum(square, 0.0), gain.luminance**2 * s.noise))
    return tuple(out)


def _pool(cells: Cells, sums: tuple[Compared, ...], *, levels: int, size: int, scalars: Params):
    """Sums over ever wider neighbourhoods of cells: of the weights, of their squares, and of `sums`."""
    kernel = np.outer(_KERNEL, _KERNEL).reshape(-1)
    away = jnp.asarray(_OFFSETS * size, cells.weight.dtype)
    margin = 2 ** (levels - 1)
    guides, slope, state = add_margin((cells.guides, cells.slope, (cells.weight, cells.square, sums)), margin, margin)

    def tap(sums, q, p, t):
        dy, dx, log_h = t
        q_guides = q["guides"]
        weight = geometry_weight(
            p["guides"], q_guides, p["slope"], dy, dx, scalars, where=q_guides.surface > 0.0, log=log_h
        )
        weights, squares, totals = q["state"]
        return (
            sums[0] + weight * weights,
            sums[1] + weight * weight * squares,
            jax.tree.map(lambda s, v: s + weight * v, sums[2], totals),
        )

    def level(state, step_size: Array):
        distance = away * step_size.astype(away.dtype)
        return sum_over_taps(
            tap,
            lambda sums, p: sums,
            neighbours={"guides": guides, "state": renew_margin(state, margin)},
            centre={"guides": guides, "slope": slope},
            offsets=_OFFSETS,
            per_tap=(distance[:, 0], distance[:, 1], jnp.asarray(np.log(kernel), away.dtype)),
            sums=jax.tree.map(lambda a: jnp.zeros((), a.dtype), state),
            step_size=step_size,
            margin=margin,
        ), None

    return cut_margin(lax.scan(level, state, 2 ** jnp.arange(levels, dtype=jnp.int32))[0], margin)


def _means(
    weight: Array, square: Array, totals: tuple[Compared, ...], *, levels: int
) -> tuple[Array, tuple[Compared, ...]]:
    """1 / (effective number of pixels) of neighbourhoods that `_pool` added up, and the means over them."""
    some = weight > TINY
    divisor = jnp.where(some, weight, 1.0)
    effective = jnp.where(some, jnp.minimum(shared_paths(levels) * square / divisor / divisor, 1.0), 1.0)
    return effective, jax.tree.map(lambda t: jnp.where(some, t / divisor, 0.0), totals)


def shared_paths(levels: int) -> float:
    """How much larger the variance of a mean over a-trous levels is than the sum of its paths' squared weights, on a plain surface.

    The same cell is reached along several paths, whose errors are one: (sum of the paths)^2 > sum of their squares.
    """
    whole = np.ones(1)
    for i in range(levels):
        spread = np.zeros(2 * 2**i + 1)
        spread[:: 2**i] = _KERNEL
        whole = np.convolve(whole, spread)
    return float(((whole**2).sum() / (_KERNEL**2).sum() ** levels) ** 2)  # squared: rows and columns


def _significance(
    current: Color, previous: Color, square: Array, effective: Array, threshold, remembered: Array
) -> tuple[Array, Array]:
    """s of `adaptation`, and the variance of the samples' luminance."""
    difference = luminance_of_planes(*current) - luminance_of_planes(*previous)
    change = difference * difference
    variance = jnp.maximum(square - change, 0.0)
    noise = threshold * threshold * effective * jnp.maximum(variance, remembered)
    significant = change > noise + TINY  # inside, the quotient and its derivative are bounded
    return jnp.where(significant, 1.0 - (noise / jnp.where(significant, change, 1.0)) ** 2, 0.0), variance


def _ratio(current: Array, previous: Array, scale: Array, significance: Array) -> Array:
    """1 + s (current / previous - 1), steadied by 1 % of the luminance `scale` and limited; 1 in the dark."""
    steady = 0.01 * scale
    lit = scale > _DARK
    ratio = (current + steady) / jnp.where(lit, previous + steady, 1.0)
    return 1.0 + jnp.where(lit, significance * (jnp.clip(ratio, 1.0 / LARGEST_GAIN, LARGEST_GAIN) - 1.0), 0.0)


def geometry_weight(
    p: Guides,
    q: Guides,
    slope: tuple[Array, Array],
    dy: Array,
    dx: Array,
    scalars: Params,
    *,
    where: Array,
    log: Array | float = 0.0,
) -> Array:
    """w_z w_n exp(log), or 0. All goes in before the exp: its result is kept, whereas every sum would redo a product."""
    exponent = geometry_exponent(
        p,
        q,
        slope[0] * dx + slope[1] * dy,
        sigma_depth=scalars.sigma_depth,
        sigma_normal=scalars.light_sigma_normal,
        depth_epsilon=scalars.depth_epsilon,
    )
    return jnp.exp(jnp.where(where, exponent + log, NEVER))


def brightest(dtype) -> float:
    """More light than this is not judged: what is made of fourth powers of it, derivatives too, stays finite."""
    return float(jnp.finfo(dtype).max) ** 0.25
