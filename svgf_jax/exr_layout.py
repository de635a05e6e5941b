"""What an EXR file says about itself, read without decoding a pixel and without the OpenEXR library.

The bindings do not tell the pixel types of a file that they have not decoded, allocate before the size can be judged,
and answer a file that ends too soon with a warning on the terminal and no picture. So the header and the table of
chunks are looked at here first. Format: https://openexr.com/en/latest/OpenEXRFileLayout.html
"""

import struct
from os import PathLike, fspath
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from svgf_jax.types import SvgfError

Window = tuple[int, int, int, int]
"""xmin, ymin, xmax, ymax, all inclusive, in pixels."""

PathName = str | PathLike[str]

_COMPRESSIONS = dict(enumerate(("none", "rle", "zips", "zip", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab")))

_MAGIC = b"\x76\x2f\x31\x01"
_SINGLE_TILE, _DEEP, _MULTI_PART = 0x200, 0x800, 0x1000
_PIXEL_TYPES = {0: np.dtype(np.uint32), 1: np.dtype(np.float16), 2: np.dtype(np.float32)}
_LINES_PER_CHUNK = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256, 10: 256, 11: 32}
_ATTRIBUTES = {"channels", "chunkCount", "compression", "dataWindow", "displayWindow", "name", "tiles", "type"}


class Channel(NamedTuple):
    """One channel: its pixel type and its subsampling in x and y (1 = every pixel has a sample)."""

    dtype: np.dtype
    sampling: tuple[int, int]


class Part(NamedTuple):
    """One part of a file.

    `kind` is scanlineimage, tiledimage, deepscanline or deeptile; `chunks` is -1 and `compression` "" where unknown.
    """

    name: str
    kind: str
    channels: dict[str, Channel]
    data_window: Window
    display_window: Window
    chunks: int
    compression: str


def read_layout(path: PathName) -> list[Part]:
    """The parts of a file.

    Raises SvgfError: missing, empty, not an EXR, damaged header, or pixel data that is not all there.
    """
    path = Path(fspath(path))
    try:
        size = path.stat().st_size
        if path.is_dir():
            raise SvgfError(f"{path}: this is a folder; wanted one EXR file.")
        with path.open("rb") as file:
            return _read_layout(file, path, size)
    except OSError as error:
        raise SvgfError(f"{path}: cannot be read ({error.strerror or error}).") from error


def _read_layout(file: BinaryIO, path: Path, size: int) -> list[Part]:
    if size == 0:
        raise SvgfError(f"{path}: the file is empty; wanted an EXR. Is it still being rendered, or was the disk full?")
    magic = file.read(4)
    if magic != _MAGIC:
        raise SvgfError(f"{path}: not an EXR file (it starts with {magic!r}); convert it to OpenEXR first.")
    try:
        parts, multi_part = _read_parts(file)
        tables = [np.frombuffer(_exactly(file, 8 * part.chunks), "<u8") for part in parts if part.chunks >= 0]
    except (struct.error, ValueError, LookupError, EOFError) as error:
        raise SvgfError(
            f"{path}: the EXR header is damaged or cut off ({error}; file of {size} bytes). Render or copy it again."
        ) from None
    if len(tables) == len(parts):
        _check_complete(file, path, size, parts, np.concatenate(tables), multi_part)
    return parts


def _check_complete(
    file: BinaryIO, path: Path, size: int, parts: list[Part], offsets: np.ndarray, multi_part: bool
) -> None:
    """Every chunk must start inside the file, and the last one must end there."""
    start = file.tell()
    there = (offsets >= start) & (offsets < size)
    end = size
    if there.all() and offsets.size:
        last = int(np.argmax(offsets))
        owner = int(np.searchsorted(np.cumsum([part.chunks for part in parts]), last, side="right"))
        head = (4 if multi_part else 0) + (16 if "tile" in parts[owner].kind else 4)
        file.seek(int(offsets[last]) + head)
        length = file.read(4)
        end = file.tell() + struct.unpack("<i", length)[0] if len(length) == 4 else size + 1
    if not there.all() or end > size:
        missing = int(offsets.size - there.sum()) or "the last"
        raise SvgfError(
            f"{path}: the pixel data is cut off ({missing} of {offsets.size} chunks missing, file of {size} bytes). "
            "Is it still being rendered or copied, or was the disk full? Render or copy this frame again."
        )


def _read_parts(file: BinaryIO) -> tuple[list[Part], bool]:
    flags = struct.unpack("<I", _exactly(file, 4))[0]
    multi_part = bool(flags & _MULTI_PART)
    parts = []
    while True:
        attributes = _read_attributes(file)
        if not attributes and multi_part and parts:
            return parts, True
        parts.append(_part(attributes, flags))
        if not multi_part:
            return parts, False


def _read_attributes(file: BinaryIO) -> dict[str, bytes]:
    """One header's attributes by name, raw; those of no interest here (they can be megabytes) are skipped."""
    attributes = {}
    while name := _string(file):
        _string(file)
        size = struct.unpack("<i", _exactly(file, 4))[0]
        if size < 0:
            raise ValueError(f"attribute {name!r} of {size} bytes")
        if name in _ATTRIBUTES:
            attributes[name] = _exactly(file, size)
        else:
            file.seek(size, 1)
    return attributes


def _part(attributes: dict[str, bytes], flags: int) -> Part:
    kind = attributes.get("type", b"").rstrip(b"\0").decode() or _old_kind(flags)
    data_window = struct.unpack("<4i", attributes["dataWindow"])
    return Part(
        name=attributes.get("name", b"").rstrip(b"\0").decode("utf-8", "replace"),
        kind=kind,
        channels=_channels(attributes["channels"]),
        data_window=data_window,
        display_window=struct.unpack("<4i", attributes["displayWindow"]),
        chunks=_count_chunks(attributes, kind, data_window),
        compression=_COMPRESSIONS.get(attributes.get("compression", b"\xff")[0], ""),
    )


def _old_kind(flags: int) -> str:
    if flags & _DEEP:
        return "deepscanline"
    return "tiledimage" if flags & _SINGLE_TILE else "scanlineimage"


def _channels(raw: bytes) -> dict[str, Channel]:
    channels = {}
    at = 0
    while raw[at] != 0:
        end = raw.index(0, at)
        pixel_type, _, x, y = struct.unpack_from("<iiii", raw, end + 1)
        channels[raw[at:end].decode("utf-8", "replace")] = Channel(_PIXEL_TYPES[pixel_type], (x, y))
        at = end + 17
    return channels


def _count_chunks(attributes: dict[str, bytes], kind: str, window: Window) -> int:
    """How many chunks the part has; -1 where it does not say so simply (mipmaps, a compression this does not know)."""
    if "chunkCount" in attributes:
        count = struct.unpack("<i", attributes["chunkCount"])[0]
        if not 0 <= count <= 2**28:
            raise ValueError(f"{count} chunks")
        return count
    width, height = window[2] - window[0] + 1, window[3] - window[1] + 1
    if kind == "tiledimage":
        x, y, mode = struct.unpack("<IIB", attributes["tiles"])
        return -(-width // x) * -(-height // y) if x and y and mode & 15 == 0 else -1
    lines = _LINES_PER_CHUNK.get(attributes["compression"][0], 0)
    return max(0, -(-height // lines)) if lines and "deep" not in kind else -1


def _string(file: BinaryIO) -> str:
    """A zero-terminated name."""
    raw = bytearray()
    while (byte := _exactly(file, 1)) != b"\0":
        raw += byte
        if len(raw) > 255:
            raise ValueError("a name longer than 255 bytes")
    return raw.decode("utf-8", "replace")


def _exactly(file: BinaryIO, count: int) -> bytes:
    raw = file.read(count)
    if len(raw) != count:
        raise EOFError("the file ends here")
    return raw
