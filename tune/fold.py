"""Tall-skinny QR: any number of rows [J r] kept as one small triangle.

If R is the triangular factor of the rows A = [J r], then R'R = A'A: the triangle's columns have the same norms and the same
products as the rows had, so J'J, J'r and |r| are all in it, and of two stacked triangles the factor is that of all their rows.
NumPy, float64, whatever the rows came in.
"""

import numpy as np

BLOCK_ROWS = 8192
"""Rows factored at a time; a block is also one cluster of the standard errors."""

_WELL_CONDITIONED = 1e-5


def factor_blocks(rows: np.ndarray, *, block_rows: int = BLOCK_ROWS) -> np.ndarray:
    """The triangular factors `[blocks, c, c]` of consecutive blocks of `rows` `[m, c]`."""
    count = max(-(-len(rows) // block_rows), 1)
    blocks = (np.asarray(rows[i * block_rows : (i + 1) * block_rows], np.float64) for i in range(count))
    return np.stack([_factor(block) for block in blocks])


def combine(factors: np.ndarray) -> np.ndarray:
    """The factor `[c, c]` of all the rows behind `factors` `[blocks, c, c]`, with a diagonal >= 0: it is then unique."""
    columns = factors.shape[-1]
    triangle = np.asarray(np.linalg.qr(factors.reshape(-1, columns), mode="r"))
    return triangle * np.where(np.diag(triangle) < 0, -1.0, 1.0)[:, None]


def fold(triangle: np.ndarray, rows: np.ndarray, *, block_rows: int = BLOCK_ROWS) -> np.ndarray:
    """Fold `rows` `[m, c]` into a running `triangle` `[c, c]` (zeros to start with)."""
    return combine(np.concatenate([triangle[None], factor_blocks(rows, block_rows=block_rows)]))


def _factor(block: np.ndarray) -> np.ndarray:
    """The triangular factor `[c, c]` of a block, to Householder's accuracy but in matrix products, where LAPACK crawls.

    CholeskyQR2 (Yamamoto et al. 2015): A'A = R1'R1, Q = A / R1, Q'Q = R2'R2, R = R2 R1. The second pass restores the digits that
    the first one lost, unless the columns are nearly dependent: then it is Householder's QR after all.
    """
    columns = block.shape[1]
    size = np.sqrt(np.einsum("ij,ij->j", block, block))
    present = np.flatnonzero(size > 0)
    triangle = np.zeros((columns, columns))
    if not present.size:
        return triangle
    scaled = block[:, present] / size[present]
    try:
        first = np.linalg.cholesky(scaled.T @ scaled).T
        if np.diag(first).min() < _WELL_CONDITIONED:
            raise np.linalg.LinAlgError
        quotient = scaled @ np.linalg.inv(first)
        factor = np.linalg.cholesky(quotient.T @ quotient).T @ first
    except np.linalg.LinAlgError:
        padded = np.concatenate([scaled, np.zeros((max(present.size - len(scaled), 0), present.size))])
        factor = np.asarray(np.linalg.qr(padded, mode="r"))
    triangle[np.ix_(present, present)] = factor * size[present]
    return triangle
