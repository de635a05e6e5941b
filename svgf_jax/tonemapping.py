"""Tone curves: scene-linear radiance to what a screen shows, and back. NumPy or JAX, whichever the array is of.

| name                | curve on a channel x >= 0                                         | exactly undone for                     |
|---------------------|-------------------------------------------------------------------|----------------------------------------|
| `reinhard`          | x / (1 + x), Reinhard et al. 2002, equation 3                     | every x                                |
| `reinhard-extended` | x (1 + x / w^2) / (1 + x), equation 4, with w = 4 becoming white  | x <= 4                                 |
| `aces-narkowicz`    | Narkowicz 2015, a fit of the ACES output transform                | x <= 7.24, from where on all is white  |
| `aces-hill`         | Hill's closer fit of the same (RRT and sRGB ODT, in BakingLab)    | colours of which it clips no channel   |
| `linear`            | x, clipped at 1                                                   | x <= 1                                 |

A curve is a quotient of two quadratic polynomials, between two matrices for Hill's; its inverse is a root of a quadratic equation.
AgX is not among them: no maintained library offers it outside of a full colour management configuration.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from svgf_jax.types import SvgfError

WHITE = 4.0  # radiance that `reinhard-extended` shows as full white
_LARGEST = 1e18  # the square stays finite in float32; every curve has long reached its limit
Matrix = tuple[tuple[float, float, float], ...]
Array = Any  # of NumPy or JAX


class Curve(NamedTuple):
    """(n2 x^2 + n1 x + n0) / (d2 x^2 + d1 x + d0), after the matrix `before` and before the matrix `after`.

    `white` is the x from where on the curve is 1.
    """

    numerator: tuple[float, float, float]
    denominator: tuple[float, float, float]
    white: float = math.inf
    before: Matrix | None = None
    after: Matrix | None = None


CURVES = {
    "reinhard-extended": Curve((1 / WHITE**2, 1.0, 0.0), (0.0, 1.0, 1.0), white=WHITE),
    "reinhard": Curve((0.0, 1.0, 0.0), (0.0, 1.0, 1.0)),
    "aces-narkowicz": Curve((2.51, 0.03, 0.0), (2.43, 0.59, 0.14)),
    "aces-hill": Curve(
        (1.0, 0.0245786, -0.000090537),
        (0.983729, 0.4329510, 0.238081),
        before=((0.59719, 0.35458, 0.04823), (0.07600, 0.90834, 0.01566), (0.02840, 0.13383, 0.83777)),
        after=((1.60475, -0.53108, -0.07367), (-0.10208, 1.10813, -0.00605), (-0.00327, -0.07276, 1.07602)),
    ),
    "linear": Curve((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), white=1.0),
}


def tonemap(color: Array, *, curve: str = "reinhard", exposure: float = 1.0) -> Array:
    """Linear RGB to display-linear RGB in [0, 1]; for a screen, `encode_srgb` comes next.

    Args:
        color: `[..., 3]` scene-linear (any shape for the curves without matrices); negative counts as 0, infinity as very bright,
            NaN stays NaN. Lists of numbers are taken too.
        curve: a name of the table at the top of this module.
        exposure: factor on the color, finite, > 0.

    Raises:
        SvgfError: another curve or exposure, a color of whole numbers, or not of three channels where the curve has matrices.
    """
    check_exposure(exposure)
    c, color = _curve(curve), _floats(color)
    xp = _module(color)
    x = xp.clip(color, 0.0, min(min(c.white, _LARGEST) / exposure, 3e38)) * exposure
    x = x if c.before is None else _transform(x, c.before)
    y = _polynomial(x, c.numerator) / _polynomial(x, c.denominator)
    return xp.clip(y if c.after is None else _transform(y, c.after), 0.0, 1.0)


def untonemap(display: Array, *, curve: str = "reinhard", exposure: float = 1.0) -> Array:
    """The inverse of `tonemap`, as far as that lost nothing (see the table); finite for every number, also for 1."""
    check_exposure(exposure)
    c, display = _curve(curve), _floats(display)
    xp = _module(display)
    most = 1.0 - float(np.finfo(display.dtype).eps) / 2  # reinhard reaches 1 at infinity only
    y = xp.clip(display, 0.0, most if curve == "reinhard" else 1.0)
    y = y if c.after is None else xp.clip(_transform(y, _inverse(c.after)), c.numerator[2] / c.denominator[2], 1.0)
    square, slope, constant = (n - y * d for n, d in zip(c.numerator, c.denominator, strict=True))
    root = xp.sqrt(slope * slope - 4.0 * square * constant)
    # Of the two ways to write the positive root, the one that subtracts no equals.
    rises = slope > 0.0
    x = xp.where(
        rises,
        -2.0 * constant / xp.where(rises, slope + root, 1.0),
        (root - slope) / xp.where(rises, 1.0, 2.0 * square),
    )
    return (x if c.before is None else _transform(x, _inverse(c.before))) / exposure


def compress_luma(color: tuple[Array, ...]) -> tuple[Array, ...]:
    """c / (1 + luma) of the planes red, green and blue, luma = (R + 2 G + B) / 4, below 0 taken as 0 (Karis 2013).

    Reversible, keeps the hue, and has a luma below 1; a saturated channel may be larger.
    """
    scale = 1.0 + _luma(color)
    return tuple(c / scale for c in color)


def expand_luma(color: tuple[Array, ...]) -> tuple[Array, ...]:
    """The inverse of `compress_luma`; finite for a luma of 1 and above too."""
    eps = float(np.finfo(color[0].dtype).eps)
    scale = _module(color[0]).maximum(1.0 - _luma(color), eps)
    return tuple(c / scale for c in color)


def encode_srgb(linear: Array) -> Array:
    """Display-linear [0, 1] to the sRGB code value [0, 1] (IEC 61966-2-1)."""
    linear = _floats(linear)
    xp = _module(linear)
    power = 1.055 * xp.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return xp.where(linear <= 0.0031308, 12.92 * linear, power)


def decode_srgb(code: Array) -> Array:
    """The inverse of `encode_srgb`."""
    code = _floats(code)
    xp = _module(code)
    return xp.where(code <= 0.04045, code / 12.92, ((xp.maximum(code, 0.04045) + 0.055) / 1.055) ** 2.4)


def check_exposure(exposure: float) -> None:
    """Raise `SvgfError` for an exposure that means nothing."""
    if not (np.isfinite(exposure) and exposure > 0):
        raise SvgfError(f"Got the exposure {exposure}; wanted a finite number above 0, for example 1 (no change) or 2.")


def _luma(color: tuple[Array, ...]) -> Array:
    red, green, blue = color
    return _module(red).maximum(0.25 * red + 0.5 * green + 0.25 * blue, 0.0)


def _curve(name: str) -> Curve:
    if name not in CURVES:
        raise SvgfError(f"no tone curve {name!r}; there are {', '.join(CURVES)}")
    return CURVES[name]


def _floats(array: Any) -> Array:
    """The array itself, or one of float64 of numbers and lists of them."""
    if not hasattr(array, "dtype"):
        try:
            array = np.asarray(array, np.float64)
        except (TypeError, ValueError) as error:
            raise SvgfError(f"Got a {type(array).__name__} as a color ({error}); wanted an array of floats.") from error
    if array.dtype.kind in "biucOSU":
        raise SvgfError(f"Got a color of {array.dtype}; wanted floats. Divide 8-bit codes by 255 first.")
    return array


def _module(array: Array) -> Any:
    """NumPy, or whatever module the array says is its own."""
    return np if isinstance(array, np.ndarray | np.generic) else array.__array_namespace__()


def _polynomial(x: Array, coefficients: tuple[float, float, float]) -> Array:
    square, slope, constant = coefficients
    total = slope * x + constant
    return total + square * (x * x) if square else total


def _transform(color: Array, matrix: Matrix) -> Array:
    if color.shape[-1:] != (3,):
        raise SvgfError(
            f"Got a color of shape {tuple(color.shape)}; this curve mixes red, green and blue, and wants [..., 3]."
        )
    red, green, blue = color[..., 0], color[..., 1], color[..., 2]
    return _module(color).stack([r * red + g * green + b * blue for r, g, b in matrix], axis=-1)


def _inverse(matrix: Matrix) -> Matrix:
    return tuple(tuple(row) for row in np.linalg.inv(np.array(matrix)).tolist())
