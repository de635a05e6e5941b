"""What an EXR file says about itself, read without decoding a pixel and without the OpenEXR library.

The bindings do not tell the pixel types of a file that they have not decoded, allocate before the size can be judged,
and answer a file that ends too soon with a warning on the terminal and no picture. So the header and the table of
chunks are looked at here first, and nothing is read or allocated on the word of the file alone.
Format: https://openexr.com/en/latest/OpenEXRFileLayout.html
"""

import re
import struct
from os import PathLike
from typing import BinaryIO, NamedTuple

import numpy as np

from svgf_jax.types import SvgfError

Window = tuple[int, int, int, int]
"""xmin, ymin, xmax, ymax, all inclusive, in pixels."""

PathName = str | PathLike[str]

_LINES_PER_CHUNK = {
    **{"none": 1, "rle": 1, "zips": 1, "zip": 16, "piz": 32, "pxr24": 16, "b44": 32, "b44a": 32, "dwaa": 32},
    **{"dwab": 256, "htj2k256": 256, "htj2k32": 32, "lj2k": 256, "zstd": 1},
}
_COMPRESSIONS = tuple(_LINES_PER_CHUNK)  # in the order of their numbers in the file
_KINDS = ("scanlineimage", "tiledimage", "deepscanline", "deeptile")

_MAGIC = b"\x76\x2f\x31\x01"
_VERSION, _SINGLE_TILE, _LONG_NAMES, _DEEP, _MULTI_PART = 2, 0x200, 0x400, 0x800, 0x1000
_FLAGS = _VERSION | _SINGLE_TILE | _LONG_NAMES | _DEEP | _MULTI_PART
_PIXEL_TYPES = {0: np.dtype(np.uint32), 1: np.dtype(np.float16), 2: np.dtype(np.float32)}
_ATTRIBUTES = {"channels", "chunkCount", "compression", "dataWindow", "displayWindow", "name", "tiles", "type"}
_MOST_ATTRIBUTES = 2**16  # of a file: each takes time before anything else can be judged
_LONGEST_NAME = 255  # bytes
_FARTHEST = 2**30  # of a corner: farther out the library's own arithmetic ends
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")


class Channel(NamedTuple):
    """One channel: its pixel type and its subsampling in x and y (1 = every pixel has a sample)."""

    dtype: np.dtype
    sampling: tuple[int, int]


class Tiles(NamedTuple):
    """Width and height of a tile, the levels (0 = one, 1 = mip map, 2 = rip map), and whether their sizes round up."""

    width: int
    height: int
    levels: int
    round_up: bool


class Part(NamedTuple):
    """One part of a file. `kind` is scanlineimage, tiledimage, deepscanline or deeptile; `tiles` is None without any."""

    name: str
    kind: str
    channels: dict[str, Channel]
    data_window: Window
    display_window: Window
    compression: str
    tiles: Tiles | None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        left, top, right, bottom = self.data_window
        return right - left + 1, bottom - top + 1

    @property
    def lines(self) -> int:
        """Lines of a chunk that is no tile."""
        return _LINES_PER_CHUNK[self.compression]


class Layout(NamedTuple):
    """A file's parts, each with its table of chunks: the place of every one in the file, of `bytes` in all."""

    parts: tuple[Part, ...]
    tables: tuple[np.ndarray, ...]
    multi_part: bool
    bytes: int


def read_layout(file: BinaryIO, path: str, size: int) -> Layout:
    """The layout of an open file of so many bytes.

    Raises SvgfError: empty, not an EXR, damaged header, or pixel data that is not all there.
    """
    if size == 0:
        raise SvgfError(f"{path}: the file is empty; wanted an EXR. Is it still being rendered, or was the disk full?")
    magic = file.read(4)
    if magic != _MAGIC:
        raise SvgfError(f"{path}: not an EXR file (it starts with {magic!r}); convert it to OpenEXR first.")
    try:
        parts, counts, multi_part = _read_parts(file, size)
        tables = tuple(np.frombuffer(_exactly(file, 8 * count, size), "<u8") for count in counts)
    except (struct.error, ValueError, LookupError, EOFError) as error:
        raise SvgfError(
            f"{path}: the EXR header is damaged or cut off ({error}; file of {size} bytes). Render or copy it again."
        ) from None
    layout = Layout(tuple(parts), tables, multi_part, size)
    _check_complete(file, path, layout)
    return layout


def head_size(layout: Layout, part: Part) -> int:
    """Bytes before the pixels of a chunk: its part, its place, its size."""
    return (4 if layout.multi_part else 0) + (16 if part.tiles else 4) + 4


def count_levels(part: Part) -> list[tuple[int, int]]:
    """Width and height in pixels of every level, in the order of the table; one of the picture's size without levels."""
    width, height = part.size
    if part.tiles is None or part.tiles.levels == 0:
        return [(width, height)]
    across, down = (_halves(length, part.tiles.round_up) for length in (width, height))
    if part.tiles.levels == 1:
        return [
            (across[min(i, len(across) - 1)], down[min(i, len(down) - 1)]) for i in range(max(len(across), len(down)))
        ]
    return [(x, y) for y in down for x in across]


def _halves(length: int, round_up: bool) -> list[int]:
    lengths = [length]
    while lengths[-1] > 1:
        lengths.append((lengths[-1] + round_up) // 2)
    return lengths


def _check_complete(file: BinaryIO, path: str, layout: Layout) -> None:
    """Every chunk must start inside the file, and the last one must end there."""
    start = file.tell()
    offsets = np.concatenate(layout.tables)
    there = (offsets >= start) & (offsets < layout.bytes)
    end = layout.bytes
    if there.all() and offsets.size:
        last = int(np.argmax(offsets))
        owner = int(np.searchsorted(np.cumsum([table.size for table in layout.tables]), last, side="right"))
        if "deep" not in layout.parts[owner].kind:  # those have other heads, and are refused elsewhere
            file.seek(int(offsets[last]) + head_size(layout, layout.parts[owner]) - 4)
            length = file.read(4)
            end = file.tell() + struct.unpack("<i", length)[0] if len(length) == 4 else layout.bytes + 1
    if not there.all() or end > layout.bytes:
        missing = int(offsets.size - there.sum()) or "the last"
        raise SvgfError(
            f"{path}: the pixel data is cut off ({missing} of {offsets.size} chunks missing, file of {layout.bytes} "
            "bytes). Is it still being rendered or copied, or was the disk full? Render or copy this frame again."
        )


def _read_parts(file: BinaryIO, size: int) -> tuple[list[Part], list[int], bool]:
    flags = struct.unpack("<I", _exactly(file, 4, size))[0]
    if flags & 0xFF != _VERSION or flags & ~_FLAGS:
        raise ValueError(f"version and flags {flags:#x}")
    multi_part = bool(flags & _MULTI_PART)
    parts: list[Part] = []
    counts: list[int] = []
    budget = _MOST_ATTRIBUTES
    while True:
        attributes, budget = _read_attributes(file, size, budget)
        if not attributes and multi_part and parts:
            return parts, counts, True
        part = _part(attributes, flags)
        parts.append(part)
        counts.append(_count_chunks(part, attributes))
        if not multi_part:
            return parts, counts, False


def _read_attributes(file: BinaryIO, size: int, budget: int) -> tuple[dict[str, bytes], int]:
    """One header's attributes by name, raw; those of no interest here (they can be megabytes) are skipped."""
    attributes = {}
    while name := _string(file):
        _string(file)
        length = struct.unpack("<i", _exactly(file, 4, size))[0]
        budget -= 1
        if not 0 <= length <= size - file.tell() or name in attributes or budget < 0:
            raise ValueError(f"attribute {name!r} of {length} bytes")
        if name in _ATTRIBUTES:
            attributes[name] = _exactly(file, length, size)
        else:
            file.seek(length, 1)
    return attributes, budget


def _part(attributes: dict[str, bytes], flags: int) -> Part:
    kind = attributes.get("type", b"").rstrip(b"\0").decode() or _old_kind(flags)
    if kind not in _KINDS:
        raise ValueError(f"a part of type {kind!r}")
    data_window, display_window = (struct.unpack("<4i", attributes[f"{name}Window"]) for name in ("data", "display"))
    left, top, right, bottom = data_window
    if left > right or top > bottom or max(map(abs, data_window)) > _FARTHEST:
        raise ValueError(f"data window {data_window}")
    number = attributes["compression"][0]
    if number >= len(_COMPRESSIONS):
        raise ValueError(f"compression number {number}, which is not known")
    return Part(
        name=_text(attributes.get("name", b"").rstrip(b"\0")),
        kind=kind,
        channels=_channels(attributes["channels"]),
        data_window=data_window,
        display_window=display_window,
        compression=_COMPRESSIONS[number],
        tiles=_tiles(attributes["tiles"]) if "tile" in kind else None,
    )


def _old_kind(flags: int) -> str:
    if flags & _DEEP:
        return "deepscanline"
    return "tiledimage" if flags & _SINGLE_TILE else "scanlineimage"


def _tiles(raw: bytes) -> Tiles:
    width, height, mode = struct.unpack("<IIB", raw)
    if not (0 < width < _FARTHEST and 0 < height < _FARTHEST and mode & 15 < 3 and mode >> 4 < 2):
        raise ValueError(f"tiles of {width} x {height}, mode {mode}")
    return Tiles(width, height, mode & 15, mode >> 4 == 1)


def _channels(raw: bytes) -> dict[str, Channel]:
    channels = {}
    at, before = 0, b""
    while raw[at] != 0:
        end = raw.index(0, at)
        pixel_type, _, x, y = struct.unpack_from("<iiii", raw, end + 1)
        name = _text(raw[at:end])
        if not (x > 0 and y > 0) or pixel_type not in _PIXEL_TYPES:
            raise ValueError(f"channel {name!r} of type {pixel_type}, sampled at {x} x {y}")
        if raw[at:end] <= before:  # the library would sort the names, and leave the pixels as they lie
            raise ValueError(f"channel {name!r} out of alphabetical order or twice there")
        before = raw[at:end]
        channels[name] = Channel(_PIXEL_TYPES[pixel_type], (x, y))
        at = end + 17
    if not channels:
        raise ValueError("no channels")
    return channels


def _count_chunks(part: Part, attributes: dict[str, bytes]) -> int:
    """How many chunks the part has; what the file itself says, where it does, must be the same."""
    if part.tiles is None:
        count = -(-part.size[1] // part.lines)
    else:
        across, down = part.tiles.width, part.tiles.height
        count = sum(-(-width // across) * -(-height // down) for width, height in count_levels(part))
    if "chunkCount" in attributes:
        said = struct.unpack("<i", attributes["chunkCount"])[0]
        if said != count and "deep" not in part.kind:
            raise ValueError(f"{said} chunks; {count} make the picture")
    return count


def _string(file: BinaryIO) -> str:
    """A zero-terminated name."""
    raw = file.read(_LONGEST_NAME + 1)
    end = raw.find(b"\0")
    if end < 0:
        raise ValueError("a name longer than 255 bytes") if len(raw) > _LONGEST_NAME else EOFError("the file ends here")
    file.seek(end + 1 - len(raw), 1)
    return _text(raw[:end])


def _text(raw: bytes) -> str:
    """A name; one that could steer a terminal no program gave."""
    text = raw.decode("utf-8", "replace")
    if _CONTROL.search(text):
        raise ValueError(f"a name with control characters, {text!r:.80}")
    return text


def _exactly(file: BinaryIO, count: int, size: int) -> bytes:
    raw = file.read(count) if 0 <= count <= size else b""
    if len(raw) != count:
        raise EOFError("the file ends here")
    return raw
