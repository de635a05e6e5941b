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
A correction is noisy itself: of n frames that the history is worth remain 1 / (r (1 / n + s_g^2 / N_g) + s_o^2 / N_o), s and N
being significance and effective number of samples of gain and offset; r >= 1 is the square of the light before the offset over
that after it, since an offset leaves the history's noise as it is when it makes the light dimmer.
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
from svgf_jax.edges import Guides, depth_gradient, guides_of
from svgf_jax.sampling import add_margin, planes, stack_planes
from svgf_jax.significance import TINY, Cells, Correction, Sums, brightest, compare, geometry_weight, judge
from svgf_jax.types import Config, Frame, Params, Reprojected, at_level


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
        None if previous.effective_history is None else tuple(previous.effective_history),
    )
    gathered_from = pixels._replace(worth=None)
    cells, sums = to_cells(partial(_gather, size=size, scalars=scalars), gathered_from, size=size)
    corrections = judge(cells, sums, size=size, scalars=scalars)
    around = Around(cells.guides, (cells.weight > TINY).astype(frame.depth.dtype), corrections)
    corrected = to_pixels(
        partial(_apply, scalars=scalars), pixels._replace(current=()), add_margin(around, 1, 1), size=size
    )
    light, moments, change, worth = zip(*corrected, strict=True)
    return previous._replace(
        illumination=stack_planes(light),
        moments=stack_planes(moments),
        change=jnp.stack(change),
        effective_history=None if previous.effective_history is None else jnp.stack(worth),
    )


def _gather(pixels: Pixels, *, size: int, scalars: Params) -> tuple[Cells, tuple[Sums, ...]]:
    """Sums over the cells' own pixels, weighted by likeness to the central one."""
    guides, slope, known, current, history, moments, _ = pixels
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
        weight = geometry_weight(p, q, p_slope, dy, dx, scalars, where=known)
        weights, squares, totals = sums
        values = tuple(compare(*pair) for pair in colors)
        totals = jax.tree.map(lambda total, value: total + weight * value, totals, values)
        return (weights + weight, squares + weight * weight, totals), None

    zero = jnp.zeros_like(p.depth)
    nothing = tuple(Sums((zero,) * 3, (zero,) * 3, zero, zero, zero, zero) for _ in colors)
    sums, _ = lax.scan(add, (zero, zero, nothing), (jnp.arange(size), distance))
    weight, square, totals = jax.tree.map(partial(gathered, size=size), sums)
    return Cells(centre[0], centre[1], weight, square), totals


def _apply(pixels: Pixels, corners: list[Corner], *, scalars: Params):
    """Bring the corrections to the pixels, from the 2 x 2 cells whose central pixels surround each."""
    p, slope, known, _, colors, pairs, worth = pixels
    worth = (None,) * len(colors) if worth is None else worth
    weights = [
        geometry_weight(p, q.guides, slope, dy, dx, scalars, where=q.knows > 0.0, log=log_share)
        for q, log_share, dy, dx in corners
    ]
    weight = weights[0] + weights[1] + weights[2] + weights[3]
    found = (weight > 1e-8) & (known * p.surface > 0.0)
    divisor = jnp.where(found, weight, 1.0)
    a, b, c, d = (w / divisor for w in weights)
    mean = lambda i, j, k, l: a * i + b * j + c * k + d * l  # noqa: E731, E741
    corrections = jax.tree.map(mean, *(corner.cells.corrections for corner in corners))
    corrected = [_correct(*given) for given in zip(colors, pairs, worth, corrections, strict=True)]
    as_it_was = tuple((c, m, jnp.zeros_like(known), n) for c, m, n in zip(colors, pairs, worth, strict=True))
    return jax.tree.map(lambda new, old: jnp.where(found, new, old), tuple(corrected), as_it_was)


def _correct(color: Color, moments: tuple[Array, ...], worth: Array | None, c: Correction):
    most, offset = brightest(moments[0].dtype), c.offset
    corrected = tuple(_within(g, h, o, most) for g, h, o in zip(c.gain, color, offset.color, strict=True))
    first, second = moments
    variance = _within(offset.keep, jnp.maximum(second - first * first, 0.0), offset.variance, most * most)
    first = _within(c.luminance_gain, first, luminance_of_planes(*offset.color), most)
    before, after = (jnp.minimum(luminance_of_planes(*rgb), most) for rgb in (color, corrected))
    change = (after - before) / jnp.maximum(jnp.maximum(after, before), TINY)
    if worth is not None:
        worth = worth / jnp.maximum(offset.dimmed + worth * offset.noise, 1.0)  # less only where no cell was found
    return corrected, (first, variance + first * first), change, worth


def _within(gain: Array, past: Array, offset: Array, most: float) -> Array:
    """gain past + offset, from 0 to `most`; what is more already stays as it is."""
    return jnp.where(past < most, jnp.clip(gain * jnp.minimum(past, most) + offset, 0.0, most), past)
