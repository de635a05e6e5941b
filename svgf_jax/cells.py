"""Cells of size x size pixels, worked on in strips that stay in the cache: pixels in, cells or pixels out."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from svgf_jax.edges import Guides
from svgf_jax.sampling import Planes, split_rows

STRIP_CELLS = 4  # rows of cells whose pixels are in hand at once: the fastest of 1 to 16 at 1920 pixels width

Color = tuple[Array, ...]  # red, green, blue


class Pixels(NamedTuple):
    """What is compared, and what of each pixel says with whom: trees of planes; `known` is 1 where there is history."""

    guides: Guides
    slope: tuple[Array, Array]
    known: Array
    current: tuple[Color, ...]
    history: tuple[Color, ...]
    moments: tuple[tuple[Array, ...], ...]


def over_cells(function: Callable[..., Planes], pixels: Pixels, around: Planes = None, *, size: int) -> Planes:
    """`function(pixels, around)` of a strip of cells after the other, so that all stays in the cache.

    It gets the pixels as *phases* `[size^2, rows, w]`: entry a * size + b holds pixel (a, b) of every cell, 0 beyond the image; and
    of `around`, planes of cells with a margin of 1, `[rows + 2, w + 2]`. It returns planes of cells `[rows, w]`, or phases again.
    """
    height, width = pixels.known.shape
    down, across = -(-height // size), -(-width // size)
    count, rows = split_rows(down, across, STRIP_CELLS)
    below = count * rows - down
    around = jax.tree.map(lambda a: jnp.pad(a, ((0, below), (0, 0))), around)

    def split(plane: Array) -> Array:
        padded = jnp.pad(plane, ((0, (down + below) * size - height), (0, across * size - width)))
        return padded.reshape(count, rows, size, across, size)

    def join(found: Array) -> Array:
        if found.ndim == 2:
            return found
        return found.reshape(size, size, rows, across).transpose(2, 0, 3, 1).reshape(rows * size, across * size)

    def strip(given: tuple[Array, Pixels]) -> Planes:
        first, pixels = given
        phases = jax.tree.map(lambda a: a.transpose(1, 3, 0, 2).reshape(size * size, rows, across), pixels)
        near = jax.tree.map(lambda a: lax.dynamic_slice_in_dim(a, first, rows + 2), around)
        return jax.tree.map(join, function(phases, near))

    strips = jnp.arange(count, dtype=jnp.int32) * rows, jax.tree.map(split, pixels)
    found = lax.map(jax.checkpoint(strip, prevent_cse=False), strips)  # type: ignore[arg-type]
    crop = lambda a: a[:down] if a.shape[1] == across else a[:height, :width]  # noqa: E731
    return jax.tree.map(lambda a: crop(a.reshape(-1, a.shape[-1])), found)


def from_centre(size: int) -> np.ndarray:
    """Offsets (dy, dx) of a cell's pixels from its central one, `[size^2, 2]`, in the order of the phases."""
    reach = np.arange(size) - size // 2
    return np.stack(np.meshgrid(reach, reach, indexing="ij"), axis=-1).reshape(-1, 2)
