"""Reading an image at other pixels: neighbours, taps, reprojected positions. The only file that knows the border rule.

The border rule: a tap outside the image counts for nothing. Planes read 0 there, and every sum carries a plane that says
where a surface is (`surface` of `edges.Guides`), which reads 0 outside too.

The rows of an image may be divided over devices (`svgf_jax.devices`). A plane is then the rows of one device, and what lies above
and below them is fetched from the others. Whether they are, and over which, is told by the mesh that JAX traces for; it is part of
what JAX caches by, as a variable of ours would not be.

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
# Wall time of two cores, 480 to 1920 pixels width: half a strip of planes fits the level-2 cache of each.
STRIP_PIXELS = 12288
# How the mesh axis is called over which the rows are divided, and then the image's height.
DIVIDED = "svgf_jax rows of "
UNROLL_FROM = 2**16  # pixels of an image whose taps are unrolled: half the time, for two seconds more of compilation


def planes(image: Array) -> tuple[Array, ...]:
    """Split `[H, W, C]` into C planes `[H, W]`."""
    return tuple(image[..., c] for c in range(image.shape[-1]))


def stack_planes(signals: tuple[tuple[Array, ...], ...]) -> Array:
    """S signals of C planes each -> `[S, H, W, C]`."""
    return jnp.stack([jnp.stack(signal, axis=-1) for signal in signals])


def shift(plane: Array, dy: int, dx: int) -> Array:
    """The neighbour at (+dx, +dy): `shift(a, dy, dx)[y, x] == a[y + dy, x + dx]`, 0 outside the image. `[H, W]`."""
    height, width = plane.shape
    if dy and _division(plane)[0] is not None:
        return shift(add_margin(plane, abs(dy), 0), 0, dx)[abs(dy) + dy :][:height]
    if abs(dy) >= height or abs(dx) >= width:
        return jnp.zeros_like(plane)
    inside = plane[max(dy, 0) : height + min(dy, 0), max(dx, 0) : width + min(dx, 0)]
    return jnp.pad(inside, ((max(-dy, 0), max(dy, 0)), (max(-dx, 0), max(dx, 0))))


def add_margin(image: Planes, rows: int, columns: int) -> Planes:
    """Planes with so many more rows and columns on every side, 0 outside the image. `[H + 2 rows, W + 2 columns]`."""
    leaves, tree = jax.tree.flatten(image)
    axis, devices, _ = _division(leaves[0])
    if axis is None or rows == 0:
        return jax.tree.map(lambda a: jnp.pad(a, ((rows, rows), (columns, columns))), image)
    height = leaves[0].shape[0]
    above, below = [], []
    for hop in range(1, -(-rows // height) + 1):  # a device with few rows needs some of the next but one
        count = min(height, rows - (hop - 1) * height)
        down = [(i, i + hop) for i in range(devices - hop)]  # 0 arrives where no device is named
        up = [(j, i) for i, j in down]
        above.insert(
            0, _together(lambda a, down=down: lax.ppermute(a, axis, down), [a[height - count :] for a in leaves])
        )
        below.append(_together(lambda a, up=up: lax.ppermute(a, axis, up), [a[:count] for a in leaves]))
    taller = (jnp.concatenate(parts) for parts in zip(*above, leaves, *below, strict=True))
    return tree.unflatten(jnp.pad(a, ((0, 0), (columns, columns))) for a in taller)


def cut_margin(image: Planes, margin: int) -> Planes:
    """Planes without the margin that they have on every side."""
    return jax.tree.map(lambda a: a[margin : a.shape[0] - margin, margin : a.shape[1] - margin], image)


def renew_margin(image: Planes, margin: int) -> Planes:
    """Planes whose margin is 0 with what belongs there: the rows of the other devices, if there are any."""
    axis, _, _ = _division(jax.tree.leaves(image)[0])
    return image if axis is None else add_margin(cut_margin(image, margin), margin, margin)


def place(plane: Array) -> tuple[int | Array, int]:
    """The number of the plane's first row in the image, and the image's height."""
    axis, _, height = _division(plane)
    return (0, height) if axis is None else (lax.axis_index(axis) * plane.shape[0], height)


def inside_image(plane: Array) -> Array:
    """1 inside the image; 0 in rows that the last device has beyond it. `[H, W]`, of the plane's type."""
    first, height = place(plane)
    if isinstance(first, int):
        return jnp.ones_like(plane)
    rows = first + lax.broadcasted_iota(jnp.int32, plane.shape, 0)
    return (rows < height).astype(plane.dtype)


def whole(image: Planes) -> Planes:
    """Planes with all rows of the image, for `read_at`."""
    leaves, tree = jax.tree.flatten(image)
    axis, _, _ = _division(leaves[0])
    if axis is None:
        return image
    return tree.unflatten(_together(lambda a: lax.all_gather(a, axis, axis=1, tiled=True), leaves))


def add_up(pixels: Array) -> Array:
    """How many pixels of the image are True, int32."""
    axis, _, _ = _division(pixels)
    count = pixels.sum(dtype=jnp.int32)
    return count if axis is None else lax.psum(count, axis)


def _together(send: Callable[[Array], Array], planes: list[Array]) -> list[Array]:
    """`send` of planes `[P, H, W]`, all of one type in one go: each go costs what it takes to wait for the other devices."""
    sent: dict[int, Array] = {}
    for kind in dict.fromkeys(plane.dtype for plane in planes):
        which = [i for i, plane in enumerate(planes) if plane.dtype == kind]
        sent |= dict(zip(which, send(jnp.stack([planes[i] for i in which])), strict=True))
    return [sent[i] for i in range(len(planes))]


def _division(plane: Array) -> tuple[str | None, int, int]:
    """The mesh axis over which rows are divided (None: they are not), how many devices it has, and the image's height."""
    mesh = jax.sharding.get_abstract_mesh()
    axis = next((name for name in mesh.manual_axes if str(name).startswith(DIVIDED)), None)
    if axis is None:
        return None, 1, plane.shape[0]
    return axis, mesh.shape[axis], int(axis.removeprefix(DIVIDED))


def split_rows(height: int, width: int, strip_rows: int) -> tuple[int, int]:
    """How many strips, and of how many rows, for strips of about `strip_rows` rows (`BY_WIDTH`: of about STRIP_PIXELS pixels).

    On other devices than CPUs `BY_WIDTH` is two strips, as long as they can be. Never one strip: the compiler would dissolve that
    loop into its surroundings, and round differently in a scan over frames than in a step by itself.
    """
    wanted = strip_rows or (max(1, STRIP_PIXELS // width) if on_cpu() else height)
    count = max(2, -(-height // wanted))
    return count, -(-height // count)


def on_cpu() -> bool:
    """Whether JAX computes on CPUs, whose caches want short strips; other devices work on all pixels of a strip at once.

    It is the default device that is asked, by which JAX also tells apart what it has traced.
    """
    settings: Any = jax.config
    chosen = settings.jax_default_device
    return (jax.default_backend() if chosen is None else getattr(chosen, "platform", chosen)) == "cpu"


def unroll_taps(height: int, width: int, taps: int) -> bool:
    """Whether the loop over taps is unrolled: the sums then stay in registers, but each tap is compiled by itself."""
    return height * width >= UNROLL_FROM and taps <= 25


def square_offsets(radius: int, step_size: int = 1) -> np.ndarray:
    """The taps (dy, dx) of a square window, `[(2 radius + 1)**2, 2]` int32, in pixels."""
    reach = np.arange(-radius, radius + 1, dtype=np.int32) * step_size
    return np.stack(np.meshgrid(reach, reach, indexing="ij"), axis=-1).reshape(-1, 2)


def offsets_around(radius: int) -> np.ndarray:
    """The same without the centre, for sums that start from it."""
    offsets = square_offsets(radius)
    return offsets[offsets.any(axis=1)]


def sum_over_taps(
    tap: Callable[[Sums, Any, Any, Any], Sums],
    finish: Callable[[Sums, Any], Planes],
    *,
    neighbours: Planes,
    centre: Planes,
    offsets: np.ndarray,
    per_tap: Any = (),
    sums: Sums | Callable[[Any], Sums],
    where: Array | None = None,
    step_size: int | Array = 1,
    largest_step: int = 1,
    strip_rows: int | None = BY_WIDTH,
    margin: int = 0,
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
        sums: tree of scalars, the sums' start (usually zeros); or `sums(p)`, planes: what the centre alone gives.
        where: `[H, W]` bool; a strip without a True is not computed and its result is 0. None = everywhere.
        step_size: pixels per step, an integer; may be traced (a loop over levels then compiles once) unless strip_rows is None.
        largest_step: the largest value step_size may take.
        strip_rows: rows per strip, `BY_WIDTH`; None = no strips and no loop, the plain form that the other is tested against.
        margin: of all planes that are given (but `where`) and returned, as far as any tap reaches; those returned have 0 there.
            `renew_margin` brings it up to date. 0 = they have none: the neighbours get one, which takes a copy of each.

    Returns:
        The tree that `finish` returns, with leaves `[H, W]`.
    """
    reach = [int(r) * largest_step for r in np.abs(offsets).max(axis=0)]
    if strip_rows is None:
        neighbours, centre = cut_margin((neighbours, centre), margin)
        totals = _start(sums, centre)
        for i, (dy, dx) in enumerate(offsets * step_size):
            q = jax.tree.map(lambda a, dy=int(dy), dx=int(dx): shift(a, dy, dx), neighbours)
            totals = tap(totals, q, centre, jax.tree.map(lambda a, i=i: a[i], per_tap))
        return jax.tree.map(lambda a: jnp.pad(a, margin), finish(totals, centre))

    height, width = (n - 2 * margin for n in jax.tree.leaves(centre)[0].shape)
    count, rows = split_rows(height, width, strip_rows)
    unroll = len(offsets) if unroll_taps(height, width, len(offsets)) else 1
    top, left = (margin, margin) if margin else reach
    wide = neighbours if margin else add_margin(neighbours, top, left)
    corners = jnp.asarray(offsets) * jnp.asarray(step_size, jnp.int32) + jnp.array([[top, left]], jnp.int32)

    def compute(window: Planes, p: Planes) -> Planes:
        def body(totals: Sums, at: Any) -> tuple[Sums, None]:
            (corner, t) = at
            q = jax.tree.map(lambda a: lax.dynamic_slice(a, (corner[0], corner[1]), (rows, width)), window)
            return tap(totals, q, p, t), None

        totals, _ = lax.scan(body, _start(sums, p), (corners, per_tap), unroll=unroll)
        return finish(totals, p)

    def strip(wide: Planes, centre: Planes, where: Array | None, first_row: Array) -> Planes:
        zero = jnp.zeros_like(first_row)
        window = jax.tree.map(
            lambda a: lax.dynamic_slice(a, (first_row, zero), (rows + 2 * top, width + 2 * left)), wide
        )
        p = jax.tree.map(lambda a: lax.dynamic_slice(a, (first_row + margin, zero + margin), (rows, width)), centre)
        if where is None:
            return compute(window, p)
        wanted = lax.dynamic_slice(where, (first_row, zero), (rows, width))
        shape = jax.eval_shape(compute, window, p)
        nothing = lambda *_: jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shape)  # noqa: E731
        return lax.cond(jnp.any(wanted), compute, nothing, window, p)

    strip = jax.checkpoint(strip, prevent_cse=False)  # type: ignore[assignment]

    def put(results: Planes, first_row: Array) -> tuple[Planes, None]:
        at = (first_row + margin, jnp.full_like(first_row, margin))
        found = strip(wide, centre, where, first_row)
        return jax.tree.map(lambda a, b: lax.dynamic_update_slice(a, b, at), results, found), None

    first_rows = jnp.minimum(jnp.arange(count, dtype=jnp.int32) * rows, height - rows)  # the last two may overlap
    shapes = jax.eval_shape(strip, wide, centre, where, first_rows[0])
    start = jax.tree.map(lambda s: jnp.zeros((height + 2 * margin, width + 2 * margin), s.dtype), shapes)
    return lax.scan(put, start, first_rows)[0]


def _start(sums: Any, p: Planes) -> Any:
    if callable(sums):
        return sums(p)
    shape = jax.tree.leaves(p)[0].shape
    return jax.tree.map(lambda s: jnp.full(shape, s), sums)


def map_strips(function: Callable[[Any], Planes], strips: Any) -> Planes:
    """`lax.map(function, strips)`, whose results take no memory before the strips, `[n, rows, W]`, are there.

    `lax.map` starts its results as zeros, and XLA:CPU makes those of all loops at the very beginning of a step.
    """
    leaves = jax.tree.leaves(strips)
    some = lax.stop_gradient(leaves[0][0, 0, 0])  # any number: all is written over
    shapes = jax.eval_shape(function, jax.tree.map(lambda a: a[0], strips))
    start = jax.tree.map(lambda s: jnp.full((len(leaves[0]), *s.shape), some.astype(s.dtype)), shapes)

    def put(results: Planes, at: Any) -> tuple[Planes, None]:
        i, strip = at
        return jax.tree.map(lambda a, b: lax.dynamic_update_index_in_dim(a, b, i, 0), results, function(strip)), None

    return lax.scan(put, start, (jnp.arange(len(leaves[0])), strips))[0]


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
    result = map_strips(lambda strips: function(*strips), split)
    return jax.tree.map(lambda a: a.reshape(count * rows, width)[:height], result)


def read_at(plane: Array, row: Array, column: Array) -> tuple[Array, Array]:
    """Read a plane at integer positions.

    Args:
        plane: `[H, W]`, of `whole`.
        row, column: integer arrays of one shape; may lie outside.

    Returns:
        The values (of the nearest pixel inside, where outside) and a bool array: inside the image.
    """
    (_, height), width = place(plane), plane.shape[1]
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    index = jnp.clip(row, 0, height - 1) * width + jnp.clip(column, 0, width - 1)
    return plane.reshape(-1).at[index].get(mode="promise_in_bounds"), inside
