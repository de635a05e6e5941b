"""Classic window filters: Gaussian, bilateral, and the joint bilateral filter of GAMES202, over large footprints three ways.

Every output pixel i is a mean of the input over a window, sum_j J(i, j) C_j / sum_j J(i, j), with

    J(i, j) = exp(-|i - j|^2 / 2 sigma_space^2 - |C_i - C_j|^2 / 2 sigma_color^2
                  - D_normal^2 / 2 sigma_normal^2 - D_plane^2 / 2 sigma_plane^2 - sum_g |g_i - g_j|^2 / 2 sigma_g^2)

    D_normal = arccos(n_i . n_j), the dot product clamped to [-1, 1];
    D_plane = n_i . (x_j - x_i) / |x_j - x_i|, 0 at j = i;

the kernel of GAMES202's homework 5 (2021), with any further guides g. Taps outside the image, and pixels that the mask leaves out,
count for nothing; a sum of weights below 1e-15 leaves the input pixel. A pixel whose color is not finite counts for nothing either,
and becomes the mean of the others by the remaining factors of J, 0 without any; one with a NaN among its guides is as if left out
by the mask. `footprint` says how the window is covered:

- `full`: all (2 radius + 1)^2 taps at once, the definition.
- `separable`: a row of 2 radius + 1 taps, then a column of them on its result. The same for a Gaussian, to rounding; otherwise an
  approximation: a pixel that can't be seen from the corner of an L is missed.
- `atrous`: `levels` passes of 5 x 5 taps, 2**level pixels apart. A level's taps along an axis are (p, 1 - 2p, p) convolved with
  itself, of variance 4p steps^2 (p = 1/4 is the B3 spline), and the variances of passes add: p is chosen, first level first, so
  that they sum to the variance of the window's own kernel, exp(-d^2 / 2 sigma_space^2) for |d| <= radius. The footprint then is as
  wide as the window's, but smooth, without its square corners. A box of radius 2**k has the variance of k levels of B3 splines,
  so that many are the default. `last_pass` adds 3 x 3 taps (1/4, 1/2, 1/4) at the end, which blur the lattice of the wide steps.

The passes of `separable` and `atrous` hand on sums of colors and of weights, which are divided once, at the end; all of them read
the image that came in, not the one half filtered, as a guide. Both bring them closer to `full`.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from svgf_jax.sampling import planes, square_offsets, sum_over_taps
from svgf_jax.types import SvgfError

FOOTPRINTS = ("full", "separable", "atrous")
_NEVER = 1e3  # exp(-this) is 0 in every float type
_LARGEST = 1e15  # guides beyond are cut off: squares of their differences stay finite
_LARGE = 2.0**64
_SMALLEST_SIGMA = 1e-9
_LEAST_WEIGHT = 1e-15  # below, a sum of weights counts as zero
_SAME_POINT = 1e-18  # squared distance below which D_plane is 0
_WIDEST = 1 / 3  # the largest p of an a-trous level; beyond, the taps fall apart into a lattice


def gaussian_filter(
    image: Array,
    *,
    sigma: Array | float,
    radius: int,
    footprint: str = "full",
    levels: int | None = None,
    last_pass: bool = False,
    mask: Array | None = None,
) -> Array:
    """The mean with weights exp(-|i - j|^2 / 2 sigma^2) over a square window.

    Args:
        image: `[H, W, C]`, any C.
        sigma: in pixels, >= 0; traced.
        radius: of the window, in pixels, >= 0; static.
        footprint, levels, last_pass: see the module's docstring; the last two are of "atrous", `levels` None = log2(radius),
            rounded.
        mask: `[H, W]` bool, the pixels that count; the others are neither read nor changed. None = all.

    Returns:
        `[H, W, C]`.

    Raises:
        SvgfError: unknown footprint, radius or levels that are no whole numbers >= 0, levels or last_pass with another
            footprint than "atrous", shapes that do not fit together.
    """
    return joint_bilateral_filter(
        image,
        sigma_space=sigma,
        sigma_color=None,
        radius=radius,
        footprint=footprint,
        levels=levels,
        last_pass=last_pass,
        mask=mask,
    )


def bilateral_filter(
    image: Array,
    *,
    sigma_space: Array | float,
    sigma_color: Array | float,
    radius: int,
    footprint: str = "full",
    levels: int | None = None,
    last_pass: bool = False,
    mask: Array | None = None,
) -> Array:
    """The bilateral filter (Tomasi and Manduchi 1998): a Gaussian in pixel distance times one in color difference.

    Args:
        image: `[H, W, C]`, any C.
        sigma_space: in pixels, >= 0; traced.
        sigma_color: in units of the image, >= 0; traced.
        radius, footprint, levels, last_pass, mask: as for `gaussian_filter`.

    Returns:
        `[H, W, C]`.
    """
    return joint_bilateral_filter(
        image,
        sigma_space=sigma_space,
        sigma_color=sigma_color,
        radius=radius,
        footprint=footprint,
        levels=levels,
        last_pass=last_pass,
        mask=mask,
    )


def joint_bilateral_filter(
    image: Array,
    *,
    normal: Array | None = None,
    position: Array | None = None,
    guides: Sequence[tuple[Array, Any]] = (),
    sigma_space: Array | float = 32.0,
    sigma_color: Array | float | None = 0.6,
    sigma_normal: Array | float = 0.1,
    sigma_plane: Array | float = 0.1,
    radius: int = 16,
    footprint: str = "full",
    levels: int | None = None,
    last_pass: bool = False,
    mask: Array | None = None,
) -> Array:
    """The joint (cross) bilateral filter: the kernel J of the module's docstring. The defaults are those of GAMES202's homework 5.

    A guide that is not given leaves its factor out of J.

    Args:
        image: `[H, W, C]`, any C.
        normal: `[H, W, 3]`, unit length; gives D_normal.
        position: `[H, W, 3]`, world space, any unit; with `normal` gives D_plane.
        guides: pairs (g `[H, W]` or `[H, W, K]`, sigma_g): depth, albedo, a less noisy color, ...
        sigma_space: in pixels, >= 0; traced like all sigmas.
        sigma_color: in units of the image, >= 0; None = the image does not guide itself.
        sigma_normal: in radians, >= 0.
        sigma_plane: sine of an angle, >= 0.
        radius, footprint, levels, last_pass, mask: as for `gaussian_filter`.

    Returns:
        `[H, W, C]`.

    Raises:
        SvgfError: as for `gaussian_filter`; a guide that is no pair, a position without normal.
    """
    image = jnp.asarray(image)
    _check(
        image, normal, position, guides, mask, radius=radius, footprint=footprint, levels=levels, last_pass=last_pass
    )
    dtype = image.dtype
    wanted = jnp.ones(image.shape[:2], bool) if mask is None else jnp.asarray(mask, bool)
    for array in (normal, position, *(g for g, _ in guides)):
        if array is not None:
            wanted &= ~jnp.isnan(jnp.asarray(array, dtype).reshape(*image.shape[:2], -1)).any(axis=-1)
    finite = jnp.isfinite(image).all(axis=-1)
    counts = wanted & finite

    def clean(array) -> tuple[Array, ...]:
        array = jnp.asarray(array, dtype)
        return tuple(_bounded(jnp.where(wanted, g, 0.0)) for g in (planes(array) if array.ndim == 3 else (array,)))

    if sigma_color is not None:
        guides = [*guides, (jnp.where(finite[..., None], image, 0.0), sigma_color)]
    guided = bool(guides) or normal is not None
    guide = Guide(
        normal=() if normal is None else clean(normal),
        position=() if position is None else clean(position),
        others=tuple(clean(g) for g, _ in guides),
        # Without guides a pixel outside the mask still hands on the sums of its row: a Gaussian stays separable.
        counts=counts.astype(dtype) if guided else jnp.ones_like(counts, dtype),
        known=() if sigma_color is None else finite.astype(dtype),
    )
    falloff = Falloff(
        normal=_falloff(sigma_normal, dtype),
        plane=_falloff(sigma_plane, dtype),
        others=tuple(_falloff(sigma, dtype) for _, sigma in guides),
    )
    # Sums of large colors, and what their derivatives pass through, would overflow; a power of two changes no digit.
    large = jnp.max(jnp.abs(image), where=counts[..., None], initial=0.0) > _LARGE
    scale = jnp.where(large, _LARGE, jnp.ones((), dtype))
    sums = tuple(jnp.where(counts, plane, 0.0) / scale for plane in planes(image)), counts.astype(dtype)
    space = _falloff(sigma_space, dtype)
    gather = functools.partial(_gather, guide=guide, falloff=falloff)
    if footprint == "atrous":
        levels = _default_levels(radius) if levels is None else levels
        steps, kernels = _atrous_passes(space, radius, levels, last_pass)
        gather = functools.partial(gather, offsets=square_offsets(2), largest_step=2 ** max(levels - 1, 0))
        passes = jnp.asarray(steps, jnp.int32), kernels
        sums, _ = lax.scan(lambda sums, each: (gather(sums, step_size=each[0], kernel=each[1]), None), sums, passes)
    else:
        for offsets in _window(radius, footprint):
            kernel = jnp.exp(-space * jnp.asarray((offsets**2).sum(axis=1), dtype))
            sums = gather(sums, offsets=offsets, kernel=kernel)
    colors, weight = sums
    counted = wanted & (weight > _LEAST_WEIGHT)
    divisor = jnp.where(counted, weight, 1.0)
    kept = planes(jnp.where((wanted & ~finite)[..., None], 0.0, image))
    return jnp.stack(
        [jnp.where(counted, c / divisor * scale, own) for c, own in zip(colors, kept, strict=True)], axis=-1
    )


class Guide(NamedTuple):
    """What J reads at a pixel, as planes `[H, W]`; () = not given. `counts` is 1 where it may be read, 0 elsewhere and outside.

    `known` is 0 where the pixel has no color to compare others with, the last of `others`.
    """

    normal: tuple[Array, ...]
    position: tuple[Array, ...]
    others: tuple[tuple[Array, ...], ...]
    counts: Array
    known: Array | tuple[()]


class Falloff(NamedTuple):
    """1 / (2 sigma^2) of the factors of J."""

    normal: Array
    plane: Array
    others: tuple[Array, ...]


def _gather(
    sums,
    *,
    guide: Guide,
    falloff: Falloff,
    offsets: np.ndarray,
    kernel: Array,
    step_size: int | Array = 1,
    largest_step: int = 1,
):
    """One pass: sum_j kernel(j - i) J'(i, j) (colors_j, weight_j), J' being J without its first factor."""

    def tap(totals, q, p, h):
        values, q_guide = q
        weight = h * q_guide.counts * _likeness(p, q_guide, falloff)
        return jax.tree.map(lambda total, value: total + weight * value, totals, values)

    return sum_over_taps(
        tap,
        lambda totals, p: totals,
        neighbours=(sums, guide),
        centre=guide,
        offsets=offsets,
        per_tap=kernel,
        sums=jax.tree.map(lambda plane: jnp.zeros((), plane.dtype), sums),
        step_size=step_size,
        largest_step=largest_step,
    )


def _likeness(p: Guide, q: Guide, falloff: Falloff) -> Array:
    """J(p, q) without its first factor."""
    terms = [k * _square(a, b) for k, a, b in zip(falloff.others, p.others, q.others, strict=True)]
    if not isinstance(p.known, tuple):
        terms[-1] = p.known * terms[-1]
    if p.normal:
        terms.append(falloff.normal * squared_angle(_dot(p.normal, q.normal)))
    if p.position:
        terms.append(falloff.plane * _plane_distance_squared(p, q))
    if not terms:
        return jnp.ones_like(p.counts)
    exponent = functools.reduce(jnp.add, terms)
    near = exponent < _NEVER  # beyond, the weight is 0, and so is its derivative, which could overflow
    return jnp.exp(-jnp.where(near, exponent, _NEVER))


def _plane_distance_squared(p: Guide, q: Guide) -> Array:
    """D_plane^2 = (n_p . d)^2 / |d|^2, d = x_q - x_p."""
    between = tuple(b - a for a, b in zip(p.position, q.position, strict=True))
    length = _dot(between, between)
    apart = length > _SAME_POINT
    along = _dot(p.normal, between)
    inverse = 1.0 / jnp.where(apart, length, 1.0)  # a quotient's derivative would overflow where the square does not
    return jnp.where(apart, along * inverse * along, 0.0)


def squared_angle(cosine: Array) -> Array:
    """arccos(cosine)^2, the cosine clamped to [-1, 1]; smooth at 1, where arccos itself has no slope.

    With u = 1 - cosine it is u times a smooth function of u, for u <= 1 a polynomial (to rounding in float32, 1e-13 in
    float64); beyond, (pi - angle of the opposite)^2. XLA's arccos is not vectorised on a CPU, and
    takes eight times as long.
    """
    u = jnp.where(cosine < 1.0, 1.0 - cosine, jnp.zeros_like(cosine))
    opposite = u > 1.0
    near = jnp.where(opposite, jnp.where(u < 2.0, 2.0 - u, jnp.zeros_like(u)), u)
    quotient = jnp.zeros_like(u)
    for coefficient in _angle_series(16 if u.dtype == jnp.float64 else 8):
        quotient = quotient * near + coefficient
    square = near * quotient
    some = opposite & (square > 1e-12)  # sqrt has no derivative at 0
    angle = jnp.pi - jnp.where(some, jnp.sqrt(jnp.where(some, square, 1.0)), 0.0)
    return jnp.where(opposite, angle * angle, square)


@functools.cache
def _angle_series(degree: int) -> tuple[float, ...]:
    """Coefficients of arccos(1 - u)^2 / u for 0 <= u <= 1, highest power first."""
    from numpy.polynomial import Chebyshev, Polynomial

    function = lambda u: (2 * np.arcsin(np.sqrt(u / 2))) ** 2 / u  # noqa: E731
    fit = Chebyshev.interpolate(function, degree, domain=[0, 1])
    return tuple(float(c) for c in fit.convert(kind=Polynomial, domain=[0, 1], window=[0, 1]).coef[::-1])


def _window(radius: int, footprint: str) -> tuple[np.ndarray, ...]:
    """The taps of the passes of `full` or `separable`."""
    square = square_offsets(radius)
    row, column = square[square[:, 0] == 0], square[square[:, 1] == 0]
    return (square,) if footprint == "full" else (row, column)


def _default_levels(radius: int) -> int:
    return max(1, round(math.log2(radius))) if radius else 0


def _atrous_passes(space: Array, radius: int, levels: int, last_pass: bool) -> tuple[list[int], Array]:
    """The step sizes of n passes, and the weights `[n, 25]` of their taps, which sum to 1.

    The variances along an axis of the levels, and of the last pass, add up to that of the window.
    """
    square = jnp.asarray(np.arange(-radius, radius + 1) ** 2, space.dtype)
    bell = jnp.exp(-space * square)
    left = (bell * square).sum() / bell.sum() - (0.5 if last_pass else 0.0)
    most = jnp.clip(left / 4.0 / ((4**levels - 1) / 3), 0.25, _WIDEST) if levels else left  # the same p at all levels
    kernels = []
    for level in range(levels):
        p = jnp.clip(left / 4.0 ** (level + 1), 0.0, most)
        left = left - p * 4.0 ** (level + 1)
        near, far = 2.0 * p * (1.0 - 2.0 * p), p * p
        kernels.append(jnp.stack([far, near, 1.0 - 2.0 * near - 2.0 * far, near, far]))
    if last_pass:
        kernels.append(jnp.asarray([0.0, 0.25, 0.5, 0.25, 0.0], space.dtype))
    steps = [2**level for level in range(levels)] + [1] * last_pass
    taps = [jnp.outer(kernel, kernel).reshape(-1) for kernel in kernels]
    return steps, jnp.stack(taps) if taps else jnp.zeros((0, 25), space.dtype)


def _falloff(sigma: Array | float, dtype) -> Array:
    """1 / (2 sigma^2); finite, and with a finite derivative, for any sigma from 0 to infinity."""
    inverse = 1.0 / jnp.maximum(jnp.asarray(sigma, dtype), _SMALLEST_SIGMA)
    return 0.5 * inverse * inverse


def _bounded(plane: Array) -> Array:
    small = jnp.abs(plane) < _LARGEST
    return jnp.where(small, plane, _LARGEST * jnp.sign(jnp.where(small, 0.0, plane)))


def _dot(a: tuple[Array, ...], b: tuple[Array, ...]) -> Array:
    return sum((x * y for x, y in zip(a[1:], b[1:], strict=True)), a[0] * b[0])


def _square(a: tuple[Array, ...], b: tuple[Array, ...]) -> Array:
    difference = tuple(x - y for x, y in zip(a, b, strict=True))
    return _dot(difference, difference)


def _check(image, normal, position, guides, mask, *, radius, footprint, levels, last_pass) -> None:
    if footprint not in FOOTPRINTS:
        raise SvgfError(f"no footprint {footprint!r}; there are {', '.join(FOOTPRINTS)}")
    whole = lambda n: isinstance(n, int | np.integer) and not isinstance(n, bool) and n >= 0  # noqa: E731
    if not (whole(radius) and (levels is None or whole(levels))):
        raise SvgfError(f"radius = {radius!r}, levels = {levels!r}; wanted whole numbers >= 0")
    if footprint != "atrous" and (levels is not None or last_pass):
        raise SvgfError(f"footprint {footprint!r} has no levels and no last_pass; leave them out, or take 'atrous'")
    if image.ndim != 3 or image.shape[-1] == 0 or not jnp.issubdtype(image.dtype, jnp.floating):
        raise SvgfError(f"the image is {image.dtype} of shape {image.shape}; wanted real numbers, [H, W, C]")
    if position is not None and normal is None:
        raise SvgfError(
            "a position guides along its plane only; give the normal too, or give it in guides, with a sigma"
        )
    for guide in guides:
        if not (isinstance(guide, tuple | list) and len(guide) == 2):
            raise SvgfError(f"a guide is a {type(guide).__name__}; wanted pairs: guides=[(depth, 0.1), (albedo, 0.05)]")
    size = image.shape[:2]
    named = [("normal", normal, {(*size, 3)}), ("position", position, {(*size, 3)}), ("mask", mask, {size})]
    named += [("a guide", g, {size, (*size, *jnp.shape(g)[2:3])}) for g, _ in guides]
    for name, array, wanted in named:
        if array is not None and jnp.shape(array) not in wanted:
            raise SvgfError(f"{name} has shape {jnp.shape(array)}; the image is {image.shape}")
