"""Mean and variance of samples that come one at a time: for renderers that hold several samples a pixel.

Two accumulators of the same statistics. `Sums` holds the sum and the sum of squares: one addition each, but the variance is then a
small difference of large numbers, and cancels in float32 once the mean is some thousand deviations large. `Welford` (B. P. Welford,
Technometrics 4(3), 1962) holds the mean and the sum of squared deviations from it, and does not cancel; two of them merge as in
Chan, Golub and LeVeque 1979 (equation 2.1). Both add, merge, jit, vmap and differentiate:

    samples = start_welford(jnp.zeros((H, W)))
    for luminance in renderer:
        samples = add_sample(samples, luminance)
    frame = frame._replace(variance=variance_of_mean(samples)[None])
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

UNKNOWN = -1.0  # what `Frame.variance` takes for: not measured


class Sums(NamedTuple):
    """Number of samples, their sum and the sum of their squares; arrays of one shape."""

    number: Array
    total: Array
    squares: Array


class Welford(NamedTuple):
    """Number of samples, their mean and the sum of their squared deviations from it; arrays of one shape."""

    number: Array
    mean: Array
    deviations: Array


def start_sums(like: Array) -> Sums:
    """No samples yet, of the shape and dtype of `like`."""
    nothing = jnp.zeros_like(like)
    return Sums(nothing, nothing, nothing)


def start_welford(like: Array) -> Welford:
    """No samples yet, of the shape and dtype of `like`."""
    nothing = jnp.zeros_like(like)
    return Welford(nothing, nothing, nothing)


def add_sample(samples: Sums | Welford, value: Array, *, where: Array | bool = True) -> Sums | Welford:
    """One more sample for each pixel, or only for those `where` it is True (adaptive sampling). Gives the kind it was given."""
    value = jnp.where(where, value, 0.0)  # what is not a sample may be anything, NaN too
    one = jnp.where(where, jnp.ones_like(samples.number), 0.0)
    if isinstance(samples, Sums):
        return Sums(samples.number + one, samples.total + value, samples.squares + value * value)
    return _merge_welford(samples, Welford(one, value, jnp.zeros_like(value)))


def merge_samples(one: Sums | Welford, other: Sums | Welford) -> Sums | Welford:
    """The samples of both, as if they had been added one by one. Both of one kind, else TypeError."""
    if isinstance(one, Sums) and isinstance(other, Sums):
        return Sums(*(a + b for a, b in zip(one, other, strict=True)))
    if isinstance(one, Welford) and isinstance(other, Welford):
        return _merge_welford(one, other)
    raise TypeError(f"cannot merge {type(one).__name__} with {type(other).__name__}; wanted two of one kind")


def mean_of(samples: Sums | Welford) -> Array:
    """The mean of the samples; 0 where there is none."""
    if isinstance(samples, Welford):
        return samples.mean
    return samples.total / jnp.maximum(samples.number, 1.0)


def variance_of(samples: Sums | Welford) -> Array:
    """The variance of the samples, unbiased (divided by number - 1); -1, unknown, where there are fewer than two."""
    if isinstance(samples, Welford):
        deviations = samples.deviations
    else:
        deviations = samples.squares - samples.total * samples.total / jnp.maximum(samples.number, 1.0)
        deviations = jnp.where(deviations > 0.0, deviations, 0.0)  # rounding
    return jnp.where(samples.number >= 2.0, deviations / jnp.maximum(samples.number - 1.0, 1.0), UNKNOWN)


def variance_of_mean(samples: Sums | Welford) -> Array:
    """The variance of the mean of the samples, unbiased: what `Frame.variance` wants. -1, unknown, for fewer than two samples."""
    known = samples.number >= 2.0
    return jnp.where(known, variance_of(samples) / jnp.maximum(samples.number, 1.0), UNKNOWN)


def _merge_welford(one: Welford, other: Welford) -> Welford:
    number = one.number + other.number
    share = other.number / jnp.maximum(number, 1.0)
    difference = other.mean - one.mean
    return Welford(
        number,
        one.mean + difference * share,
        one.deviations + other.deviations + difference * difference * share * one.number,
    )
