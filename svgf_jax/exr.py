"""EXR files in and out: the official OpenEXR bindings, wrapped once so that their traps cannot be stepped into.

What is guarded against: arrays that are not C-contiguous (written wrong, silently), pixel data that is cut off or
corrupt (no exception), dictionaries replaced or emptied behind the caller's back, `Path` taken for a stream, layers
merged, deep and subsampled data, sizes that no memory holds, warnings printed to the standard output, half-written output.
Data and display window are kept apart and written back.

Reading and writing may be called from several threads at once.
"""

import os
import re
import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from functools import cache
from os import fspath
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from svgf_jax import atomic, prints
from svgf_jax.exr_chunks import check_chunks, check_size, check_tiles
from svgf_jax.exr_layout import Layout, Part, PathName, Window, read_layout
from svgf_jax.limits import Limits, limits
from svgf_jax.regular import require_regular
from svgf_jax.types import SvgfError

OLDEST_OPENEXR = (3, 5, 3)
"""The first that mends every flaw known when this was written: https://github.com/AcademySoftwareFoundation/openexr/releases."""
MOST_CHANNELS = 10_000
"""Of a file: the library's own time grows with their square, to a second for so many."""
COMPRESSIONS = ("none", "rle", "zips", "zip", "piz", "pxr24", "dwaa", "dwab")

_STRUCTURAL = {
    *("channels", "chunkCount", "compression", "dataWindow", "displayWindow", "lineOrder", "name", "preview"),
    *("maxSamplesPerPixel", "tiles", "type", "version", "zipCompressionLevel", "dwaCompressionLevel"),
}
_PIXEL_TYPES = ("float16", "float32", "uint32")


class Image(NamedTuple):
    """An EXR's pixels and what must be kept to write it back.

    Attributes:
        channels: array `[H, W]` by full channel name; float16, float32 or uint32 as in the file. The parts of a
            multi-part file are merged; a name that several parts use becomes "part.channel".
        data_window: xmin, ymin, xmax, ymax (inclusive) of the pixels: W = xmax - xmin + 1, H = ymax - ymin + 1.
        display_window: the whole picture's, of which the data window may be a crop.
        attributes: the other header attributes (strings, numbers, NumPy vectors and matrices, ...), free to change.
    """

    channels: dict[str, np.ndarray]
    data_window: Window
    display_window: Window
    attributes: dict[str, Any]


class Header(NamedTuple):
    """What `read_header` tells of a file without decoding it: as `Image`, with pixel types in place of pixels.

    `compression` is that of the first part, "" if it has no name here.
    """

    channels: dict[str, np.dtype]
    data_window: Window
    display_window: Window
    attributes: dict[str, Any]
    parts: tuple[str, ...]
    compression: str


def new_image(
    channels: dict[str, np.ndarray], *, like: Image | None = None, attributes: dict[str, Any] | None = None
) -> Image:
    """An image of these channels `[H, W]`, with the windows and attributes of `like` and then `attributes` on top."""
    if like is not None:
        return like._replace(channels=channels, attributes=like.attributes | (attributes or {}))
    height, width = next(iter(channels.values())).shape
    window = (0, 0, width - 1, height - 1)
    return Image(channels, window, window, dict(attributes or {}))


def read_header(path: PathName, *, most: Limits | None = None) -> Header:
    """Names, types, windows and attributes of a file, in about a millisecond. Raises SvgfError as `read` does."""
    path = fspath(path)
    with _opened(path, most) as (file, layout):
        opened = _open(path, file, header_only=True)
    parts = layout.parts
    types = {full: parts[i].channels[name].dtype for (i, name), full in _merged_names(parts).items()}
    first = parts[0]
    names = tuple(part.name for part in parts)
    return Header(types, first.data_window, first.display_window, _attributes(opened), names, first.compression)


def read(path: PathName, *, most: Limits | None = None) -> Image:
    """All channels of a file, tiled or scanline, one part or several; of mip and rip maps the picture itself.

    Raises SvgfError: missing, empty, not an EXR, cut off or corrupt, deep, subsampled, parts of different size, more
    pixels than `most` allows, or more than so small a file holds (None: what `svgf_jax.limits` has). All of this is checked
    before anything is allocated.
    """
    path = fspath(path)
    with _opened(path, most) as (file, layout):
        check_chunks(file, path, layout)
        with prints.kept() as printed:
            opened = _open(path, file, header_only=False)
    parts = layout.parts
    if len(opened.parts) != len(parts):  # the library drops a part that it cannot decode, and prints a warning
        told = re.sub(r".* - |Error reading pixel data from image file \S+ ", "", "".join(printed)).strip()[:200]
        why = told or f"{len(opened.parts)} of {len(parts)} parts decoded"
        raise SvgfError(f"{path}: the pixel data is corrupt ({why}). Render or copy this frame again.")
    shape = parts[0].size[::-1]
    channels = {}
    for (i, name), full in _merged_names(parts).items():
        channel = opened.channels(i).get(name)
        pixels = np.empty(0) if channel is None else channel.pixels
        if pixels.shape != shape or pixels.dtype != parts[i].channels[name].dtype:
            raise SvgfError(f"{path}: channel {name!r} came as {pixels.dtype} {pixels.shape}; wanted {shape}.")
        channels[full] = pixels
    return Image(channels, parts[0].data_window, parts[0].display_window, _attributes(opened))


def write(path: PathName, image: Image, *, compression: str = "zip") -> tuple[str, ...]:
    """Write a single-part scanline file: complete under its name, or not there at all.

    It is written under a temporary name starting with a dot in the same folder, flushed to the disk and renamed.
    Attributes that EXR or the bindings cannot hold are left out; their names are returned. Raises SvgfError: arrays
    of another shape than the data window or another type than float16, float32, uint32; no permission; disk full.
    """
    path = Path(fspath(path))
    if compression not in COMPRESSIONS:
        raise SvgfError(f"compression {compression!r} is not known; choose one of {', '.join(COMPRESSIONS)}.")
    channels = _checked_channels(path, image)
    header, dropped = _header(image.attributes)
    bindings = _bindings()
    name = "NO" if compression == "none" else compression.upper()
    header["compression"] = getattr(bindings, f"{name}_COMPRESSION")
    header["type"] = bindings.scanlineimage
    for key, (left, top, right, bottom) in (("dataWindow", image.data_window), ("displayWindow", image.display_window)):
        header[key] = (np.array([left, top], np.int32), np.array([right, bottom], np.int32))
    try:
        with atomic.replacing(path) as temporary:
            bindings.File(header, channels).write(str(temporary))
            own = Limits(image.channels[next(iter(channels))].size, sys.maxsize)
            with _opened(str(temporary), own):  # a full disk need not have raised
                pass
    except (OSError, RuntimeError, ValueError, TypeError, SvgfError) as error:
        reason = _write_failure(path, error)
        raise SvgfError(f"{path}: cannot be written ({reason}). Is the disk full or the folder read-only?") from error
    return dropped


def _write_failure(path: Path, error: Exception) -> str:
    if not path.parent.is_dir():
        return f"there is no folder {path.parent}"
    return getattr(error, "strerror", None) or str(error)


@cache
def _bindings() -> ModuleType:
    """The OpenEXR module, imported when first needed, of a version that can be trusted."""
    try:
        import OpenEXR
    except ImportError as error:
        raise SvgfError(
            f"the OpenEXR bindings cannot be imported ({error}); try: pip install 'OpenEXR>={_text(OLDEST_OPENEXR)}'"
        ) from error
    _check_version(OpenEXR.__version__)
    # Version 3.5 decodes and encodes on one thread unless told otherwise; a host program's own choice is left alone.
    if hasattr(OpenEXR, "set_global_thread_count") and OpenEXR.global_thread_count() == 0:
        OpenEXR.set_global_thread_count(min(os.cpu_count() or 1, 16))
    return OpenEXR


def _check_version(version: str) -> None:
    numbers = tuple(int(digits) for digits in re.findall(r"\d+", version)[:3])
    if numbers < OLDEST_OPENEXR:
        raise SvgfError(
            f"OpenEXR {version} is installed; wanted {_text(OLDEST_OPENEXR)} or later, which mends known ways to attack a "
            "program through a picture. Try: pip install -U OpenEXR"
        )


def _text(version: tuple[int, ...]) -> str:
    return ".".join(map(str, version))


@contextmanager
def _opened(path: str, most: Limits | None) -> Generator[tuple[BinaryIO, Layout]]:
    """A file that may be read, by its header, and its layout. Raises SvgfError."""
    try:
        if os.path.isdir(path):
            raise SvgfError(f"{path}: this is a folder; wanted one EXR file.")
        require_regular(path)
        with open(path, "rb") as file:
            layout = read_layout(file, path, os.fstat(file.fileno()).st_size)
            most = limits() if most is None else most
            _check_parts(path, layout.parts, most.pixels)
            check_tiles(path, layout)
            check_size(path, layout, most.ratio)
            yield file, layout
    except OSError as error:
        raise SvgfError(f"{path}: cannot be read ({error.strerror or error}).") from error


def _open(path: str, file: BinaryIO, *, header_only: bool) -> Any:
    """An OpenEXR.File, never in a `with` block: leaving one empties the dictionaries of headers and channels.

    It is opened by its descriptor, where that has a name: it is then the file that was checked, whatever has been put in its
    place since, and what the library may print holds no name that somebody else chose.
    """
    name = f"/proc/self/fd/{file.fileno()}"
    name = name if os.path.exists(name) else path
    try:
        return _bindings().File(name, separate_channels=True, header_only=header_only)
    except (RuntimeError, ValueError, TypeError, MemoryError, UnicodeError) as error:
        why = str(error).replace(name, path)[:300]
        raise SvgfError(f"{path}: OpenEXR cannot read this file ({why}). Render or copy it again.") from error


def _check_parts(path: str, parts: Sequence[Part], max_pixels: int) -> None:
    windows = {part.data_window for part in parts}
    if len(windows) > 1:
        raise SvgfError(
            f"{path}: its parts have different data windows {sorted(windows)}; wanted one. Write a file per part."
        )
    if (count := sum(len(part.channels) for part in parts)) > MOST_CHANNELS:
        raise SvgfError(f"{path}: {count} channels; wanted at most {MOST_CHANNELS}. Write them into several files.")
    width, height = parts[0].size
    if width * height > max_pixels:
        raise SvgfError(
            f"{path}: {width} x {height} pixels; wanted at most {max_pixels}. Crop or split it, or raise max_pixels "
            "(--max-pixels)."
        )
    for part in parts:
        if "deep" in part.kind:
            raise SvgfError(f"{path}: deep pixel data ({part.kind}) cannot be read; flatten it to a plain EXR first.")
        for name, channel in part.channels.items():
            if channel.sampling != (1, 1):
                x, y = channel.sampling
                raise SvgfError(
                    f"{path}: channel {name!r} is subsampled by {x} x {y}; wanted a sample for every pixel. "
                    "If this is luminance-chroma, write plain R, G, B instead."
                )


def _merged_names(parts: Sequence[Part]) -> dict[tuple[int, str], str]:
    """Full name by (part, channel name): the channel's own, with the part's in front where several parts use it."""
    uses: dict[str, int] = {}
    for part in parts:
        for name in part.channels:
            uses[name] = uses.get(name, 0) + 1
    named = {}
    for i, part in enumerate(parts):
        for name in part.channels:
            named[i, name] = name if uses[name] == 1 else f"{part.name or i}.{name}"
    return named


def _attributes(file: Any) -> dict[str, Any]:
    """The attributes of all parts that say nothing about how the pixels are stored; the first part's win. Copies."""
    merged = {}
    for i in range(len(file.parts)):
        for key, value in file.header(i).items():
            if key not in _STRUCTURAL and key not in merged:
                merged[key] = value.copy() if isinstance(value, np.ndarray) else value
    return merged


def _checked_channels(path: Path, image: Image) -> dict[str, np.ndarray]:
    """A new dictionary (the bindings replace its values) of C-contiguous arrays of the data window's shape."""
    left, top, right, bottom = image.data_window
    shape = (bottom - top + 1, right - left + 1)
    if not image.channels:
        raise SvgfError(f"{path}: no channels to write.")
    channels = {}
    for name, pixels in image.channels.items():
        pixels = np.asarray(pixels)
        if pixels.shape != shape:
            raise SvgfError(
                f"{path}: channel {name!r} has shape {pixels.shape}; the data window {image.data_window} wants {shape}."
            )
        if pixels.dtype.name not in _PIXEL_TYPES:
            raise SvgfError(
                f"{path}: channel {name!r} is {pixels.dtype}; EXR holds {', '.join(_PIXEL_TYPES)}: convert it first."
            )
        channels[name] = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("="))
    return channels


def _header(attributes: dict[str, Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The attributes that can be written, in types that the bindings take, and the names of those that cannot."""
    header, dropped = {}, []
    for key, value in attributes.items():
        if key in _STRUCTURAL:
            continue
        if isinstance(value, np.generic) and not isinstance(value, np.bytes_):
            value = value.item()
        if isinstance(value, bool):
            value = int(value)
        if isinstance(value, np.ndarray):
            value = np.ascontiguousarray(value)
        if _fits(value):
            header[key] = value
        else:
            dropped.append(key)
    return header, tuple(dropped)


def _fits(value: Any) -> bool:
    if isinstance(value, int):
        return -(2**31) <= value < 2**31  # larger ones would be stored as 0
    if isinstance(value, float):
        return not np.isfinite(value) or abs(value) < 3.4e38
    if isinstance(value, np.ndarray):
        return value.dtype.name in ("int32", "float32", "float64") and value.shape in ((2,), (3,), (3, 3), (4, 4))
    if isinstance(value, list | tuple):
        kinds = {type(item) for item in value}
        return _window(value) or kinds == {float} or kinds == {str}
    return isinstance(value, str) or type(value).__name__ in ("TimeCode", "KeyCode", "Envmap")


def _window(value: list[Any] | tuple[Any, ...]) -> bool:
    return len(value) == 2 and all(isinstance(corner, np.ndarray) and corner.shape == (2,) for corner in value)
