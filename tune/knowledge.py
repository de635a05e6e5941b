"""What a fit knows about the numbers it found: standard errors, correlations, and what the data does not determine."""

from typing import NamedTuple

import numpy as np

from tune.free import Coordinates, slope

UNDETERMINED = 1e-4
"""A parameter that changes less than this part of the error, squared, when it is moved by an e-fold, is undetermined."""


class Knowledge(NamedTuple):
    """Of each free number, in the order of the coordinates.

    Attributes:
        standard_errors: `[n]` of the parameters in their own units, from the Gauss-Newton Hessian and the scatter of the gradient
            over blocks of pixels (a sandwich: neighbouring pixels err alike, and are not counted as independent within a block);
            inf where undetermined.
        relative_errors: `[n]` of the free coordinates: 0.1 is 10 % of a scale.
        correlations: `[n, n]` of the errors.
        leverage: `[n]`, how much of the error changes, to second order, if the parameter alone is moved by an e-fold.
        undetermined: names of those that the data does not determine by themselves (leverage near 0).
        entangled: pairs of names whose errors are correlated by more than 0.95: what one loses the other makes up for.
    """

    standard_errors: np.ndarray
    relative_errors: np.ndarray
    correlations: np.ndarray
    leverage: np.ndarray
    undetermined: tuple[str, ...]
    entangled: tuple[tuple[str, str], ...]


def learn(
    triangle: np.ndarray,
    scatter: np.ndarray,
    rows: int,
    y: np.ndarray,
    coordinates: Coordinates,
    *,
    pull: np.ndarray | float = 0.0,
) -> Knowledge:
    """What the factor `[n + 1, n + 1]` of [J r] and the scatter of its blocks' gradients say at the fitted point.

    `pull` `[n]`: what of the squares of J's columns is from terms that do not look at pixels, each at one coordinate. A prior is no
    knowledge: it is taken out again.
    """
    n = y.size
    labels = coordinates.labels
    jacobian, residual = triangle[:, :n], triangle[:, n]
    loss = max(float(residual @ residual), np.finfo(float).tiny)
    leverage = np.maximum(np.square(jacobian).sum(0) - pull, 0.0) / loss
    free = np.flatnonzero(leverage > UNDETERMINED)
    errors = np.full(n, np.inf)
    correlations = np.eye(n)
    if free.size:
        normal = jacobian[:, free].T @ jacobian[:, free] - np.diag(np.broadcast_to(pull, n)[free])
        size = np.sqrt(np.diag(normal))
        values, basis = np.linalg.eigh(normal / np.outer(size, size))
        kept = values > 1e-10 * values[-1]  # beyond, float32 derivatives say nothing
        inverse = (basis[:, kept] / values[kept]) @ basis[:, kept].T / np.outer(size, size)
        variance = loss / max(rows - n, 1) * inverse
        sandwich = inverse @ scatter[np.ix_(free, free)] @ inverse
        # The larger of the two: over few blocks the sandwich is too small.
        covariance = max(sandwich, variance, key=lambda matrix: np.diag(matrix).sum())
        deviation = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
        errors[free] = deviation
        correlations[np.ix_(free, free)] = covariance / np.outer(deviation, deviation)
    entangled = [(labels[i], labels[j]) for i in free for j in free if i < j and abs(correlations[i, j]) > 0.95]
    return Knowledge(
        standard_errors=np.where(np.isfinite(errors), errors * slope(y, coordinates), np.inf),
        relative_errors=errors,
        correlations=correlations,
        leverage=leverage,
        undetermined=tuple(labels[i] for i in range(n) if i not in free),
        entangled=tuple(entangled),
    )
