"""Reading an image at other pixels: neighbours, taps, reprojected positions. The only file that knows the border rule.

The border rule: a tap outside the image counts for nothing. Planes read 0 there, and every sum carries a plane that says
where a surface is (`surface` of `edges.Guides`), which reads 0 outside too.

Here an image is a tree of *planes* `[H, W]`, one a channel: on XLA:CPU a slice of a plane is vectorised, a slice of `[C, H, W]`
or `[H, W, C]` is not, and costs ten times as much.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

Planes = Any  # a tree whose leaves are [H, W] arrays
Sums = TypeVar("Sums")

BY_WIDTH = 0  # rows per strip: as many as have STRIP_PIXELS pixels
STRIP_PIXELS = (
    8192  # the fastest of 4 to 64 thousand, at 480 and at 1920 pixels width: a strip's planes fit the level-2 cache
)
UNROLL_FROM = 2**19  # pixels of an image whose taps are unrolled: half the time, for some seconds more of compilation


def planes(image: Array) -> tuple[Array, ...]:
    """Split `[H, W, C]` into C planes `[H, W]`."""
    return tuple(image[..., c] for c in range(image.shape[-1]))


def stack_planes(signals: tuple[tuple[Array, ...], ...]) -> Array:
    """S signals of C planes each -> `[S, H, W, C]`."""
    return jnp.stack([jnp.stack(signal, axis=-1) for signal in signals])


def shift(plane: Array, dy: int, dx: int) -> Array:
    """The neighbour at (+dx, +dy): `shift(a, dy, dx)[y, x] == a[y + dy, x + dx]`, 0 outside the image. `[H, W]`."""
    height, width = plane.shape
    if abs(dy) >= height or abs(dx) >= width:
        return jnp.zeros_like(plane)
    inside = plane[max(dy, 0) : height + min(dy, 0), max(dx, 0) : width + min(dx, 0)]
    return jnp.pad(inside, ((max(-dy, 0), max(dy, 0)), (max(-dx, 0), max(dx, 0))))


def split_rows(height: int, width: int, strip_rows: int) -> tuple[int, int]:
    """How many strips, and of how many rows, for strips of about `strip_rows` rows (`BY_WIDTH`: of about STRIP_PIXELS pixels).

    Never one strip: the compiler would dissolve that loop into its surroundings, and round differently in a scan over frames than
    in a step by itself.
    """
    wanted = strip_rows or max(1, STRIP_PIXELS // width)
    count = max(2, -(-height // wanted))
    return count, -(-height // count)


def unroll_taps(height: int, width: int, taps: int) -> bool:
    """Whether the loop over taps is unrolled: the sums then stay in registers, but each tap is compiled by itself."""
    return height * width >= UNROLL_FROM and taps <= 25


def square_offsets(radius: int, step_size: int = 1) -> np.ndarray:
    """The taps (dy, dx) of a square window, `[(2 radius + 1)**2, 2]` int32, in pixels."""
    reach = np.arange(-radius, radius + 1, dtype=np.int32) * step_size
    return np.stack(np.meshgrid(reach, reach, indexing="ij"), axis=-1).reshape(-1, 2)


def sum_over_taps(
    tap: Callable[[Sums, Any, Any, Any], Sums],
    finish: Callable[[Sums, Any], Planes],
    *,
    neighbours: Planes,
    centre: Planes,
    offsets: np.ndarray,
    per_tap: Any = (),
    sums: Sums,
    where: Array | None = None,
    step_size: int | Array = 1,
    largest_step: int = 1,
    strip_rows: int | None = BY_WIDTH,
) -> Planes:
    """Run a stencil: for every pixel p, add up what `tap` makes of each neighbour q, then `finish` the sums.

    The taps are a loop that carries the sums (XLA:CPU would recompute a shared weight once per sum otherwise), inside a loop over
    strips of rows that fit the cache; reverse mode recomputes a strip rather than storing its taps.

    Args:
        tap: `tap(sums, q, p, t) -> sums`; q are `neighbours` read at p + offset, p are `centre` at p, t is `per_tap` of this tap.
        finish: `finish(sums, p)` -> a tree of planes, the result.
        neighbours: planes `[H, W]` read at the taps, 0 outside the image.
        centre: planes `[H, W]` read at the pixel itself.
        offsets: `[n, 2]` integers (dy, dx), in steps.
        per_tap: tree of `[n, ...]` arrays, one entry a tap.
        sums: tree of scalars, the sums' start (usually zeros).
        where: `[H, W]` bool; a strip without a True is not computed and its result is 0. None = everywhere.
        step_size: pixels per step, an integer; may be traced (a loop over levels then compiles once) unless strip_rows is None.
        largest_step: the largest value step_size may take.
        strip_rows: rows per strip, `BY_WIDTH`; None = no strips and no loop, the plain form that the other is tested against.

    Returns:
        The tree that `finish` returns, with leaves `[H, W]`.
    """
    height, width = jax.tree.leaves(centre)[0].shape
    top, left = (int(r) * largest_step for r in np.abs(offsets).max(axis=0))

    if strip_rows is None:
        totals = jax.tree.map(lambda s: jnp.full((height, width), s), sums)
        for i, (dy, dx) in enumerate(offsets * step_size):
            q = jax.tree.map(lambda a, dy=int(dy), dx=int(dx): shift(a, dy, dx), neighbours)
            totals = tap(totals, q, centre, jax.tree.map(lambda a, i=i: a[i], per_tap))
        return finish(totals, centre)

    count, rows = split_rows(height, width, strip_rows)
    below = count * rows - height
    unroll = len(offsets) if unroll_taps(height, width, len(offsets)) else 1
    padded = jax.tree.map(lambda a: jnp.pad(a, ((top, top + below), (left, left))), neighbours)
    centred = jax.tree.map(lambda a: jnp.pad(a, ((0, below), (0, 0))), (centre, where))
    corners = jnp.asarray(offsets) * jnp.asarray(step_size, jnp.int32) + jnp.array([[top, left]], jnp.int32)

    def compute(window: Planes, p: Planes) -> Planes:
        def body(totals: Sums, at: Any) -> tuple[Sums, None]:
            (corner, t) = at
            q = jax.tree.map(lambda a: lax.dynamic_slice(a, (corner[0], corner[1]), (rows, width)), window)
            return tap(totals, q, p, t), None

        start = jax.tree.map(lambda s: jnp.full((rows, width), s), sums)
        totals, _ = lax.scan(body, start, (corners, per_tap), unroll=unroll)
        return finish(totals, p)

    def strip(first_row: Array) -> Planes:
        zero = jnp.zeros_like(first_row)
        window = jax.tree.map(
            lambda a: lax.dynamic_slice(a, (first_row, zero), (rows + 2 * top, width + 2 * left)), padded
        )
        p, wanted = jax.tree.map(lambda a: lax.dynamic_slice(a, (first_row, zero), (rows, width)), centred)
        if wanted is None:
            return compute(window, p)
        shape = jax.eval_shape(compute, window, p)
        nothing = lambda *_: jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shape)  # noqa: E731
        return lax.cond(jnp.any(wanted), compute, nothing, window, p)

    strip = jax.checkpoint(strip, prevent_cse=False)  # type: ignore[assignment]
    result = lax.map(strip, jnp.arange(count, dtype=jnp.int32) * rows)
    return jax.tree.map(lambda a: a.reshape(count * rows, width)[:height], result)


def in_strips(function: Callable[..., Planes], *images: Planes, strip_rows: int = BY_WIDTH) -> Planes:
    """Run pixel-wise arithmetic strip by strip: it stays in the cache, and is compiled, hence rounded, the same wherever it is.

    Args:
        function: trees of planes -> a tree of planes; every pixel by itself.
        images: trees of planes `[H, W]`.
        strip_rows: rows per strip, about, or `BY_WIDTH`.

    Returns:
        The tree that `function` returns, with leaves `[H, W]`.
    """
    height, width = jax.tree.leaves(images)[0].shape
    count, rows = split_rows(height, width, strip_rows)
    padded = jax.tree.map(lambda a: jnp.pad(a, ((0, count * rows - height), (0, 0))), images)
    split = jax.tree.map(lambda a: a.reshape(count, rows, width), padded)
    result = lax.map(lambda strips: function(*strips), split)
    return jax.tree.map(lambda a: a.reshape(count * rows, width)[:height], result)


def read_at(plane: Array, row: Array, column: Array) -> tuple[Array, Array]:
    """Read a plane at integer positions.

    Args:
        plane: `[H, W]`.
        row, column: integer arrays of one shape; may lie outside.

    Returns:
        The values (of the nearest pixel inside, where outside) and a bool array: inside the image.
    """
    height, width = plane.shape
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    index = jnp.clip(row, 0, height - 1) * width + jnp.clip(column, 0, width - 1)
    return plane.reshape(-1).at[index].get(mode="promise_in_bounds"), inside
