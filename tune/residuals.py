"""What a fit minimises: a flat list of terms, each residual of one signature with its weight.

`residual(now, before, away)` sees this frame, the one before it and how far the free coordinates are from where they started; it
returns any array. A term adds `weight * mean(residual**2)` of every frame, so a residual of twice the size says the same.
Pixels without a known target are zero, and so is what needs a frame before the first.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from svgf_jax import SvgfError, tonemap


class Seen(NamedTuple):
    """One frame as a residual sees it.

    Attributes:
        image: `[H, W, 3]`, filtered; it carries the derivatives.
        target: `[H, W, 3]`, the reference, or a second noisy render; finite.
        known: `[H, W]`, 1 where there is a target, else 0.
        pilot: `[H, W, 3]`, the image that the starting parameters give; a constant of the fit.
    """

    image: Array
    target: Array
    known: Array
    pilot: Array


Residual = Callable[[Seen, Seen, Array], Array]


class Term(NamedTuple):
    """A residual and its weight.

    Attributes:
        name: for people.
        residual: see the top of this module.
        weight: >= 0. The terms that look at pixels are 1 together at the start of a fit; others are compared with that.
        pixels: whether it looks at pixels (else only at the coordinates).
        pilot: whether it reads `Seen.pilot`, which costs one more run of the filter.
    """

    name: str
    residual: Residual
    weight: float = 1.0
    pixels: bool = True
    pilot: bool = False


def image_error(now: Seen, before: Seen, away: Array) -> Array:
    """x / (1 + x) of the image less that of the target: what PSNR looks at."""
    return now.known[..., None] * (tonemap(now.image) - tonemap(now.target))


def log_error(now: Seen, before: Seen, away: Array) -> Array:
    """log(1 + x) of the image less that of the target: bright places count for more than in `image_error`."""
    return now.known[..., None] * (_log(now.image) - _log(now.target))


def temporal_error(now: Seen, before: Seen, away: Array) -> Array:
    """What changes from frame to frame in the image but not in the target, in x / (1 + x): flicker."""
    change = tonemap(now.image) - tonemap(before.image)
    wanted = tonemap(now.target) - tonemap(before.target)
    return (now.known * before.known)[..., None] * (change - wanted)


def noisy_error(now: Seen, before: Seen, away: Array) -> Array:
    """Image less a noisy but unbiased target, linear in both, so that the noise cancels (Lehtinen et al. 2018, noise2noise).

    Divided by (1 + pilot)^2, the derivative of x / (1 + x): to first order `image_error`. The pilot does not depend on the target
    nor, during a fit, on the parameters: dividing by the image itself would make a brighter image look better.
    """
    return now.known[..., None] * _linear_weight(now) * (now.image - now.target)


def noisy_temporal_error(now: Seen, before: Seen, away: Array) -> Array:
    """`temporal_error` against noisy targets, in the manner of `noisy_error`."""
    change = now.image - before.image - (now.target - before.target)
    return (now.known * before.known)[..., None] * _linear_weight(now) * change


def prior(now: Seen, before: Seen, away: Array) -> Array:
    """How far the free coordinates are from their start, in e-folds."""
    return away


def huber(residual: Residual, width: float) -> Residual:
    """`residual`, its square growing only linearly beyond `width`: the signed square root of Huber's function."""
    return partial(_reshaped, residual, _huber, width)


def geman_mcclure(residual: Residual, width: float) -> Residual:
    """`residual`, its square levelling off at `width`^2: r / sqrt(1 + (r / width)^2)."""
    return partial(_reshaped, residual, _geman_mcclure, width)


REFERENCE = (
    Term("image", image_error),
    Term("temporal", temporal_error, 0.5),
    Term("prior", prior, 0.02, pixels=False),
)
"""The terms for a reference."""

NOISY = (
    Term("image", noisy_error, pilot=True),
    Term("temporal", noisy_temporal_error, 0.5, pilot=True),
    Term("prior", prior, 1e-5, pixels=False),
)
"""The terms for a second noisy render; its noise is most of the error, so the prior is smaller against it."""

SPACES = {"reinhard": image_error, "log1p": log_error}
ROBUST: dict[str, Callable[[Residual, float], Residual] | None] = {
    "none": None,
    "huber": huber,
    "geman-mcclure": geman_mcclure,
}


def reference_terms(
    *,
    space: str = "reinhard",
    temporal: float = 0.5,
    prior_weight: float = 0.02,
    robust: str = "none",
    width: float = 0.1,
) -> tuple[Term, ...]:
    """`REFERENCE` with choices: the space of the image error, weights, a robust form and from which residual on it differs."""
    for got, known, what in ((space, SPACES, "space"), (robust, ROBUST, "robust form")):
        if got not in known:
            raise SvgfError(f"no {what} {got!r}; there are {', '.join(known)}")
    shape = ROBUST[robust] or (lambda residual, width: residual)
    return (
        Term("image", shape(SPACES[space], width)),
        Term("temporal", shape(temporal_error, width), temporal),
        Term("prior", prior, prior_weight, pixels=False),
    )


def noisy_terms(*, temporal: float = 0.5, prior_weight: float = 1e-5) -> tuple[Term, ...]:
    """`NOISY` with other weights. There is no robust form: a robust mean of a noisy target is not its mean."""
    image, change, still = NOISY
    return (image, change._replace(weight=temporal), still._replace(weight=prior_weight))


def _log(color: Array) -> Array:
    return jnp.log1p(jnp.maximum(color, 0.0))


def _linear_weight(seen: Seen) -> Array:
    return lax.stop_gradient(1.0 / (1.0 + jnp.maximum(seen.pilot, 0.0)) ** 2)


def _reshaped(residual: Residual, shape, width: float, now: Seen, before: Seen, away: Array) -> Array:
    return shape(residual(now, before, away), width)


def _huber(r: Array, width: float) -> Array:
    size = jnp.abs(r)
    far = size > width
    root = jnp.sqrt(jnp.where(far, 2.0 * width * size - width**2, 1.0))  # sqrt has no derivative at 0
    return jnp.where(far, jnp.sign(r) * root, r)


def _geman_mcclure(r: Array, width: float) -> Array:
    return r / jnp.sqrt(1.0 + (r / width) ** 2)
