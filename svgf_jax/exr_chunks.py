"""Whether every chunk of an EXR file lies where its table says, under its own place in the picture, and is all there.

The library mends some damaged tables by guessing, and tells of other damage on the terminal; a read that it calls a success
must not hold another chunk's pixels, or memory that nobody wrote.
"""

import os
from typing import BinaryIO

import numpy as np

from svgf_jax.exr_layout import Layout, Part, count_levels, head_size
from svgf_jax.limits import PLAUSIBLE
from svgf_jax.types import SvgfError


def check_size(path: str, layout: Layout, ratio: int) -> None:
    """Raise SvgfError where a file claims more pixels than its bytes are likely to hold, before they are allocated."""
    claimed = sum(part.size[0] * part.size[1] * _pixel_bytes(part) for part in layout.parts)
    if claimed > PLAUSIBLE and claimed > ratio * layout.bytes:
        raise SvgfError(
            f"{path}: {claimed / 1e9:.2g} GB of pixels in a file of {layout.bytes} bytes. Render or copy this frame again; if "
            f"it is known to be all of one colour, raise max_ratio (--max-ratio {-(-claimed // layout.bytes)})."
        )


def check_tiles(path: str, layout: Layout) -> None:
    """Raise SvgfError for tiles far larger than their picture: the library keeps room for whole ones."""
    for part in layout.parts:
        if part.tiles is not None:
            largest = max(PLAUSIBLE, part.size[0] * part.size[1] * _pixel_bytes(part))
            if part.tiles.width * part.tiles.height * _pixel_bytes(part) > largest:
                raise SvgfError(
                    f"{path}: tiles of {part.tiles.width} x {part.tiles.height} in a picture of {part.size[0]} x "
                    f"{part.size[1]}; the header is damaged. Render or copy this frame again."
                )


def _pixel_bytes(part: Part) -> int:
    return sum(channel.dtype.itemsize for channel in part.channels.values())


def check_chunks(file: BinaryIO, path: str, layout: Layout) -> None:
    """Raise SvgfError that names the first chunk that is not what its table and header say."""
    for number, (part, table) in enumerate(zip(layout.parts, layout.tables, strict=True)):
        places = _places(part)
        own = np.full((len(places), 1), number) if layout.multi_part else np.empty((len(places), 0), np.int64)
        wanted = np.concatenate([own, places], axis=1)
        length = head_size(layout, part)
        heads = b"".join(os.pread(file.fileno(), length, int(offset)) for offset in table)
        if len(heads) == length * len(wanted):
            found = np.frombuffer(heads, "<i4").reshape(len(wanted), -1).astype(np.int64)
            ends = table.astype(np.int64) + length + found[:, -1]  # inside the file: the layout was checked
            sound = (found[:, :-1] == wanted).all(axis=1) & (found[:, -1] >= 0) & (ends <= layout.bytes)
            if sound.all():
                continue
            which = f"{int(np.argmin(sound)) + 1} of {len(sound)}"
        else:
            which = f"one of {len(wanted)}"
        raise SvgfError(
            f"{path}: the pixel data is corrupt (chunk {which} is not where the table says, or not whole). "
            "Render or copy this frame again."
        )


def _places(part: Part) -> np.ndarray:
    """What stands in the head of each chunk: the first line `[N, 1]`, or column, row and levels of the tile `[N, 4]`."""
    if part.tiles is None:
        _, top, _, bottom = part.data_window
        return np.arange(top, bottom + 1, part.lines)[:, None]
    sizes = count_levels(part)
    columns = len({width for width, _ in sizes}) if part.tiles.levels == 2 else 1
    found = []
    for i, (width, height) in enumerate(sizes):
        across, down = -(-width // part.tiles.width), -(-height // part.tiles.height)
        y, x = np.divmod(np.arange(across * down), across)
        level = divmod(i, columns)[::-1] if part.tiles.levels == 2 else (i, i)
        found.append(np.stack([x, y, np.full_like(x, level[0]), np.full_like(x, level[1])], axis=1))
    return np.concatenate(found)
