"""Tall-skinny QR: any number of rows [J r] kept as one small triangle.

If R is the triangular factor of the rows A = [J r], then R'R = A'A: the triangle's columns have the same norms and the same
products as the rows had, so J'J, J'r and |r| are all in it, and of two stacked triangles the factor is that of all their rows.
NumPy, float64, whatever the rows came in.
"""

import numpy as np

BLOCK_ROWS = 8192
"""Rows factored at a time; a block is also one cluster of the standard errors."""


def factor_blocks(rows: np.ndarray, *, block_rows: int = BLOCK_ROWS) -> np.ndarray:
    """The triangular factors `[blocks, c, c]` of consecutive blocks of `rows` `[m, c]`."""
    count, columns = rows.shape
    block_rows = max(block_rows, columns)
    blocks = max(-(-count // block_rows), 1)
    padded = np.zeros((blocks * block_rows, columns))  # rows of zeros change no product
    padded[:count] = rows
    return np.linalg.qr(padded.reshape(blocks, block_rows, columns), mode="r")


def combine(factors: np.ndarray) -> np.ndarray:
    """The factor `[c, c]` of all the rows behind `factors` `[blocks, c, c]`, with a diagonal >= 0: it is then unique."""
    columns = factors.shape[-1]
    triangle = np.linalg.qr(factors.reshape(-1, columns), mode="r")
    return triangle * np.where(np.diag(triangle) < 0, -1.0, 1.0)[:, None]


def fold(triangle: np.ndarray, rows: np.ndarray, *, block_rows: int = BLOCK_ROWS) -> np.ndarray:
    """Fold `rows` `[m, c]` into a running `triangle` `[c, c]` (zeros to start with)."""
    return combine(np.concatenate([triangle[None], factor_blocks(rows, block_rows=block_rows)]))
