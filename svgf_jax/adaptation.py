"""Following the light: correct the reprojected history where the illumination has changed, judged from the frames alone.

Reprojection sees geometry only; when a lamp flickers or a shadow moves, the history shows light that is gone. A pixel's own
sample can't tell: at one sample a pixel the noise is larger than the change. The mean over a neighbourhood on the same surface
can. So the frame I and its reprojected history H are compared as means over *cells* of light_cell x light_cell pixels, pooled
further by a-trous levels of 3 x 3 taps on the grid of cells, with the geometry weights w_z w_n and no luminance weight (noise
averages out, change does not). The history is then corrected rather than shortened: it keeps its detail and its low noise, and
takes on the new light at once.

1. *Gain*, for lamps: over a wide neighbourhood, g = 1 + s (mean I / mean H - 1), per color channel.
2. *Offset*, for shadows: what is left, over a narrow neighbourhood, o = s (mean I - g mean H).

s in [0, 1) is how significant the difference d of the mean luminances is against its own standard error e:
s = max(0, 1 - (threshold e / d)^4), where e^2 is the variance of the samples' differences inside the neighbourhood over the
effective number of them. A single firefly makes d and e large together: at thresholds of 1.5 and more it is never significant,
but on a surface of one pixel. Nor is it when there happens to be none: the variance is at least the one that the history
remembers.

Then, per pixel, from the four cells around it (bilinear, geometry weights): H' = max(0, g H + o), and the moments move with it:
M1' = g M1 + o; the variance M2 - M1^2 scales with the square of the light and turns, as s rises, into the one just observed.
Nothing here is in Schied et al. 2017; comparing means of filtered differences is the idea of A-SVGF (Schied et al. 2018), the test
against their standard error is not.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from svgf_jax.cells import Color, Corner, Pixels, at_centres, from_centre, gathered, spread, to_cells, to_pixels
from svgf_jax.color import luminance_of_planes
from svgf_jax.edges import NEVER, Guides, depth_gradient, geometry_exponent, guides_of
from svgf_jax.sampling import (
    add_margin,
    in_strips,
    planes,
    square_offsets,
    stack_planes,
    sum_over_taps,
)
from svgf_jax.types import Config, Frame, Params, Reprojected, at_level

GAIN_LEVELS = 4  # a-trous levels on the grid of cells: reach of +-15 cells
OFFSET_LEVELS = 1  # +-1 cell
LARGEST_GAIN = 50.0
_OFFSETS = square_offsets(1)
_KERNEL = np.array([1, 2, 1]) / 4.0  # 9 taps to the B3 spline's 25, and half its variance
_DARK = 1e-6  # mean luminance below which a ratio means nothing
_TINY = 1e-12


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


class Correction(NamedTuple):
    """What a cell says about its surroundings, of one signal.

    Attributes:
        gain, offset: per color channel: H' = gain H + offset.
        luminance_gain: the gain on the first moment.
        keep, variance: new variance = keep * old one + variance.
    """

    gain: Color
    offset: Color
    luminance_gain: Array
    keep: Array
    variance: Array


class Around(NamedTuple):
    """What a pixel reads of the cells near it: planes `[h, w]`; `knows` is 1 where a cell can tell anything."""

    guides: Guides
    knows: Array
    corrections: tuple[Correction, ...]


def follow_light(
    previous: Reprojected, illumination: Array, frame: Frame, *, params: Params, config: Config
) -> Reprojected:
    """The reprojected history, its illumination and moments corrected to this frame's light.

    Args:
        previous: the reprojected history.
        illumination: `[S, H, W, 3]`, this frame's demodulated radiance.
        frame: sanitised; its normal, depth and object_id guide the comparison.
        params: per-level leaves are read at entry 0.
        config: `light_cell` = 0 leaves the history as it is.

    Returns:
        `previous` with other illumination and moments, and with the change that this made; pixels without history, and those
        unlike any cell near, are unchanged.
    """
    size = config.light_cell
    if size == 0:
        return previous
    scalars = at_level(params, 0)
    pixels = Pixels(
        guides_of(frame),
        depth_gradient(frame.depth, frame.object_id),
        previous.valid.astype(frame.depth.dtype),
        tuple(planes(signal) for signal in illumination),
        tuple(planes(signal) for signal in previous.illumination),
        tuple(planes(signal) for signal in previous.moments),
    )
    cells, sums = to_cells(partial(_gather, size=size, scalars=scalars), pixels, size=size)
    corrections = _judge(cells, sums, size=size, scalars=scalars)
    around = Around(cells.guides, (cells.weight > _TINY).astype(frame.depth.dtype), corrections)
    corrected = to_pixels(
        partial(_apply, scalars=scalars), pixels._replace(current=()), add_margin(around, 1, 1), size=size
    )
    light, moments, change = zip(*corrected, strict=True)
    return previous._replace(illumination=stack_planes(light), moments=stack_planes(moments), change=jnp.stack(change))


def _brightest(dtype) -> float:
    """More light than this is not judged: what is made of fourth powers of it, derivatives too, stays finite."""
    return float(jnp.finfo(dtype).max) ** 0.25


def _weight(
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


def _gather(pixels: Pixels, *, size: int, scalars: Params) -> tuple[Cells, tuple[Sums, ...]]:
    """Sums over the cells' own pixels, weighted by likeness to the central one."""
    guides, slope, known, current, history, moments = pixels
    centre = jax.tree.map(partial(at_centres, size=size), (guides, slope))
    p, p_slope = jax.tree.map(partial(spread, size=size), centre)
    distance = jnp.asarray(from_centre(size), known.dtype)
    dx = jnp.asarray(np.tile(from_centre(size), known.shape[1] // size)[None], known.dtype)
    colors = tuple(zip(current, history, moments, strict=True))
    rows = jax.tree.map(lambda a: a.reshape(-1, size, a.shape[1]), (guides, known, colors))

    def add(sums, at):
        row, dy = at
        q, with_history, colors = jax.tree.map(lambda a: lax.dynamic_slice_in_dim(a, row, 1, 1)[:, 0], rows)
        known = with_history * p.surface * q.surface > 0.0
        weight = _weight(p, q, p_slope, dy, dx, scalars, where=known)
        weights, squares, totals = sums
        values = tuple(_compare(*pair) for pair in colors)
        totals = jax.tree.map(lambda total, value: total + weight * value, totals, values)
        return (weights + weight, squares + weight * weight, totals), None

    zero = jnp.zeros_like(p.depth)
    nothing = tuple(Sums((zero,) * 3, (zero,) * 3, zero, zero, zero, zero) for _ in colors)
    sums, _ = lax.scan(add, (zero, zero, nothing), (jnp.arange(size), distance))
    weight, square, totals = jax.tree.map(partial(gathered, size=size), sums)
    return Cells(centre[0], centre[1], weight, square), totals


def _compare(current: Color, history: Color, moments) -> Sums:
    most = _brightest(moments[0].dtype)
    current, history = jax.tree.map(lambda c: jnp.minimum(c, most), (current, history))
    l, prev_l = luminance_of_planes(*current), luminance_of_planes(*history)  # noqa: E741
    noise = jnp.clip(moments[1] - moments[0] * moments[0], 0.0, most * most)
    return Sums(current, history, l * l, l * prev_l, prev_l * prev_l, noise)


def _judge(cells: Cells, sums: tuple[Sums, ...], *, size: int, scalars: Params) -> tuple[Correction, ...]:
    """Steps 1 and 2 of the module's docstring, on the grid of cells. What a strip gives back is new: all else would be copied."""
    one, zero = (jnp.asarray(number, cells.weight.dtype) for number in (1.0, 0.0))
    as_it_is = (Correction((one,) * 3, (zero,) * 3, one, one, zero),) * len(sums)
    pool = partial(_pool, cells, size=size, scalars=scalars)

    def as_it_was(sums) -> list[Array]:
        return [compared.square for compared in _correct_sums(sums, as_it_is)]

    def after_gain(wide, sums):
        gains = _gains(*_means(*wide, levels=GAIN_LEVELS), threshold=scalars.light_gain_threshold)
        left = [compared._replace(current=()) for compared in _correct_sums(sums, gains)]
        return [gain._replace(offset=()) for gain in gains], left

    def after_offset(narrow, gains) -> list[Correction]:
        means = _means(*narrow, levels=OFFSET_LEVELS)
        corrections = _offsets(*means, gains, threshold=scalars.light_offset_threshold)
        return [correction._replace(gain=(), luminance_gain=()) for correction in corrections]

    squares = in_strips(as_it_was, sums)
    compared = tuple(Compared(s.current, s.previous, square, s.noise) for s, square in zip(sums, squares, strict=True))
    gains, left = in_strips(after_gain, pool(compared, levels=GAIN_LEVELS), sums)
    left = tuple(compared._replace(current=s.current) for compared, s in zip(left, sums, strict=True))
    found = in_strips(after_offset, pool(left, levels=OFFSET_LEVELS), gains)
    return tuple(
        gain._replace(offset=offset.offset, keep=offset.keep, variance=offset.variance)
        for gain, offset in zip(gains, found, strict=True)
    )


def _gains(effective: Array, wide: tuple[Compared, ...], *, threshold) -> tuple[Correction, ...]:
    out = []
    for current, previous, square, noise in wide:
        significance, _ = _significance(current, previous, square, effective, threshold, noise)
        scale = luminance_of_planes(*previous)
        luminance_gain = _ratio(luminance_of_planes(*current), scale, scale, significance)
        gain = tuple(_ratio(c, p, scale, significance) for c, p in zip(current, previous, strict=True))
        nothing = (jnp.zeros_like(scale),) * 3
        # Until the offset is known, `variance` holds the gain's significance.
        out.append(Correction(gain, nothing, luminance_gain, (1.0 - significance) * luminance_gain**2, significance))
    return tuple(out)


def _offsets(effective: Array, narrow: tuple[Compared, ...], gains, *, threshold) -> tuple[Correction, ...]:
    out = []
    for (current, previous, square, noise), before in zip(narrow, gains, strict=True):
        significance, observed = _significance(current, previous, square, effective, threshold, noise)
        offset = tuple(significance * (c - p) for c, p in zip(current, previous, strict=True))
        either = 1.0 - (1.0 - before.variance) * (1.0 - significance)
        scale = luminance_of_planes(*previous)
        grown = _ratio(luminance_of_planes(*current), scale, scale, significance)
        keep = before.keep * (1.0 - significance) * grown**2
        out.append(before._replace(offset=offset, keep=keep, variance=either * observed))
    return tuple(out)


def _correct_sums(sums: tuple[Sums, ...], corrections: tuple[Correction, ...]) -> tuple[Compared, ...]:
    out = []
    for s, c in zip(sums, corrections, strict=True):
        previous = tuple(g * p for g, p in zip(c.gain, s.previous, strict=True))
        square = s.current2 - 2.0 * c.luminance_gain * s.product + c.luminance_gain**2 * s.previous2
        out.append(Compared(s.current, previous, jnp.maximum(square, 0.0), c.luminance_gain**2 * s.noise))
    return tuple(out)


def _pool(cells: Cells, sums: tuple[Compared, ...], *, levels: int, size: int, scalars: Params):
    """Sums over ever wider neighbourhoods of cells: of the weights, of their squares, and of `sums`."""
    kernel = np.outer(_KERNEL, _KERNEL).reshape(-1)
    away = jnp.asarray(_OFFSETS * size, cells.weight.dtype)

    def tap(sums, q, p, t):
        dy, dx, log_h = t
        q_guides = q["guides"]
        weight = _weight(p["guides"], q_guides, p["slope"], dy, dx, scalars, where=q_guides.surface > 0.0, log=log_h)
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
            neighbours={"guides": cells.guides, "state": state},
            centre={"guides": cells.guides, "slope": cells.slope},
            offsets=_OFFSETS,
            per_tap=(distance[:, 0], distance[:, 1], jnp.asarray(np.log(kernel), away.dtype)),
            sums=jax.tree.map(lambda a: jnp.zeros((), a.dtype), state),
            step_size=step_size,
            largest_step=2 ** (levels - 1),
        ), None

    return lax.scan(level, (cells.weight, cells.square, sums), 2 ** jnp.arange(levels, dtype=jnp.int32))[0]


def _means(
    weight: Array, square: Array, totals: tuple[Compared, ...], *, levels: int
) -> tuple[Array, tuple[Compared, ...]]:
    """1 / (effective number of pixels) of neighbourhoods that `_pool` added up, and the means over them."""
    some = weight > _TINY
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
    """s of the module's docstring, and the variance of the samples' luminance."""
    difference = luminance_of_planes(*current) - luminance_of_planes(*previous)
    change = difference * difference
    variance = jnp.maximum(square - change, 0.0)
    noise = threshold * threshold * effective * jnp.maximum(variance, remembered)
    significant = change > noise + _TINY  # inside, the quotient and its derivative are bounded
    return jnp.where(significant, 1.0 - (noise / jnp.where(significant, change, 1.0)) ** 2, 0.0), variance


def _ratio(current: Array, previous: Array, scale: Array, significance: Array) -> Array:
    """1 + s (current / previous - 1), steadied by 1 % of the luminance `scale` and limited; 1 in the dark."""
    steady = 0.01 * scale
    lit = scale > _DARK
    ratio = (current + steady) / jnp.where(lit, previous + steady, 1.0)
    return 1.0 + jnp.where(lit, significance * (jnp.clip(ratio, 1.0 / LARGEST_GAIN, LARGEST_GAIN) - 1.0), 0.0)


def _apply(pixels: Pixels, corners: list[Corner], *, scalars: Params):
    """Bring the corrections to the pixels, from the 2 x 2 cells whose central pixels surround each."""
    p, slope, known, _, colors, pairs = pixels
    weights = [
        _weight(p, q.guides, slope, dy, dx, scalars, where=q.knows > 0.0, log=log_share)
        for q, log_share, dy, dx in corners
    ]
    weight = weights[0] + weights[1] + weights[2] + weights[3]
    found = (weight > 1e-8) & (known * p.surface > 0.0)
    divisor = jnp.where(found, weight, 1.0)
    a, b, c, d = (w / divisor for w in weights)
    mean = lambda i, j, k, l: a * i + b * j + c * k + d * l  # noqa: E731, E741
    corrections = jax.tree.map(mean, *(corner.cells.corrections for corner in corners))
    corrected = [_correct(*given) for given in zip(colors, pairs, corrections, strict=True)]
    as_it_was = tuple((c, m, jnp.zeros_like(known)) for c, m in zip(colors, pairs, strict=True))
    return jax.tree.map(lambda new, old: jnp.where(found, new, old), tuple(corrected), as_it_was)


def _correct(color: Color, moments: tuple[Array, ...], c: Correction):
    most = _brightest(moments[0].dtype)
    corrected = tuple(_within(g, h, o, most) for g, h, o in zip(c.gain, color, c.offset, strict=True))
    first, second = moments
    noise = _within(c.keep, jnp.maximum(second - first * first, 0.0), c.variance, most * most)
    first = _within(c.luminance_gain, first, luminance_of_planes(*c.offset), most)
    before, after = (jnp.minimum(luminance_of_planes(*rgb), most) for rgb in (color, corrected))
    change = (after - before) / jnp.maximum(jnp.maximum(after, before), _TINY)
    return corrected, (first, noise + first * first), change


def _within(gain: Array, past: Array, offset: Array, most: float) -> Array:
    """gain past + offset, from 0 to `most`; what is more already stays as it is."""
    return jnp.where(past < most, jnp.clip(gain * jnp.minimum(past, most) + offset, 0.0, most), past)
