"""Cells of size x size pixels, worked on in strips of rows that stay in the cache: pixels in, cells or pixels out.

XLA:CPU computes with planes whose rows are read as they lie in memory. So nothing here is cut or spread along a row where it is
computed with: a cell's values are brought to all pixels of a row first, and the sums of a row are added up by cells last.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from svgf_jax.edges import NEVER, Guides
from svgf_jax.sampling import Planes, map_strips, on_cpu

Color = tuple[Array, ...]  # red, green, blue
CELL_STRIP_PIXELS = 24576  # of a strip: larger ones cost fewer turns of the loop, but leave the level-2 cache


class Pixels(NamedTuple):
    """What is compared, and what of each pixel says with whom: trees of planes.

    `known` is 1 where there is history; `worth` is its effective length.
    """

    guides: Guides
    slope: tuple[Array, Array]
    known: Array
    current: tuple[Color, ...]
    history: tuple[Color, ...]
    moments: tuple[tuple[Array, ...], ...]
    worth: tuple[Array, ...] | None = None


class Corner(NamedTuple):
    """One of the four cells whose central pixels surround a pixel, for some rows of pixels.

    Attributes:
        cells: what is known of it, planes `[n, w]`.
        log_share: log of its bilinear weight, `[n, w]`.
        dy, dx: from the pixel to its centre, `[n, 1]` and `[1, w]`.
    """

    cells: Planes
    log_share: Array
    dy: Array
    dx: Array


def to_cells(function: Callable[[Pixels], Planes], pixels: Pixels, *, size: int) -> Planes:
    """`function` of some rows of cells after the other: gets their pixels, planes `[n size, w size]`, and returns planes `[n, w]`.

    Beyond the image the pixels are 0. Returns planes of cells.
    """
    down = -(-pixels.known.shape[0] // size)
    found = map_strips(jax.checkpoint(function, prevent_cse=False), _split(pixels, size))  # type: ignore[arg-type]
    return jax.tree.map(lambda a: a.reshape(-1, a.shape[-1])[:down], found)


def to_pixels(
    function: Callable[[Pixels, list[Corner]], Planes], pixels: Pixels, cells: Planes, *, size: int
) -> Planes:
    """`function(pixels, corners)` of some rows of pixels after the other.

    Args:
        function: planes of pixels `[n, w size]` and the four corners -> planes of pixels.
        pixels: 0 beyond the image.
        cells: planes of cells with a margin of 1, `[h + 2, w + 2]`.
        size: of a cell.

    Returns:
        Planes of pixels.
    """
    height, width = pixels.known.shape
    split = _split(pixels, size)
    count, rows, columns = split.known.shape
    dtype = pixels.known.dtype
    first_centre = size - size // 2  # from the margin's first pixel to the first pixel whose cell above is the margin's
    # Spread here and not where they are read: the compiler would spread them anew for every use, and pixel by pixel.
    cells = jax.tree.map(lambda a: spread(jnp.pad(a, ((0, 1), (0, size))), size), cells)
    offset = from_centre(size)
    first = np.where(offset < 0, -size, 0) - offset  # from a pixel to the first of the two cells' centres along an axis
    with np.errstate(divide="ignore"):
        log_share = np.maximum(np.log(np.stack([1 + first / size, -first / size])), NEVER)
    along = lambda a: jnp.asarray(np.tile(a, columns // size)[None], dtype)  # noqa: E731
    down = lambda a: jnp.asarray(np.tile(a, rows // size)[:, None], dtype)  # noqa: E731

    def strip(given: tuple[Pixels, Array]) -> Planes:
        pixels, above = given
        corners = []
        for i, j in np.ndindex(2, 2):
            corner = (above + i, jnp.int32(first_centre + j * size))

            def read(a: Array, at=corner) -> Array:
                some = lax.dynamic_slice(a, at, (rows // size + 1, columns))
                every = jnp.broadcast_to(some[:, None], (rows // size + 1, size, columns))
                return every.reshape(-1, columns)[first_centre : first_centre + rows]

            log = down(log_share[i]) + along(log_share[j])
            corners.append(Corner(jax.tree.map(read, cells), log, down(first) + i * size, along(first + j * size)))
        return function(pixels, corners)

    given = split, jnp.arange(count, dtype=jnp.int32) * (rows // size)
    found = map_strips(jax.checkpoint(strip, prevent_cse=False), given)  # type: ignore[arg-type]
    return jax.tree.map(lambda a: a.reshape(-1, columns)[:height, :width], found)


def _split(pixels: Pixels, size: int) -> Pixels:
    """`[H, W]` -> `[count, n size, w size]`, 0 beyond the image."""
    height, width = pixels.known.shape
    down, across = -(-height // size), -(-width // size) * size
    wanted = max(1, CELL_STRIP_PIXELS // (across * size)) if on_cpu() else down
    rows = size * next(
        n for n in range(min(wanted, max(1, down // 2)), 0, -1) if down % n == 0
    )  # or else all was copied
    count = max(2, size * down // rows)  # two at least: see `split_rows`
    pad = lambda a: jnp.pad(a, ((0, count * rows - height), (0, across - width)))  # noqa: E731
    return jax.tree.map(lambda a: pad(a).reshape(count, rows, across), pixels)


def at_centres(plane: Array, size: int) -> Array:
    """The central pixels `[n, w]` of some rows of cells."""
    return plane[size // 2 :: size, size // 2 :: size]


def spread(cells: Array, size: int) -> Array:
    """`[n, w]` -> `[n, w size]`: each cell's value at every pixel of a row of it."""
    rows, across = cells.shape
    return jnp.broadcast_to(cells[:, :, None], (rows, across, size)).reshape(rows, across * size)


def gathered(row: Array, size: int) -> Array:
    """`[n, w size]` -> `[n, w]`: sums over the pixels of a row of each cell."""
    total = row[:, ::size]
    for b in range(1, size):
        total = total + row[:, b::size]
    return total


def from_centre(size: int) -> np.ndarray:
    """How far a cell's pixels are from its central one, along an axis, `[size]`."""
    return np.arange(size) - size // 2
