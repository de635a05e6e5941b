"""What the headers of a sequence's files say, and what could not be read: all files, about a millisecond each. No pixels."""

import os
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from svgf_jax.exr import Header, read_header
from svgf_jax.frames import Source, check_windows
from svgf_jax.roles import check_channels
from svgf_jax.types import SvgfError


class Scan(NamedTuple):
    """The files of a sequence.

    Attributes:
        there, missing: frame numbers.
        checked: how many frames' headers were read.
        damaged: a sentence by frame number for what `read_frame` would not accept.
        stored: bytes of the files of all frames that are there.
        pixels: bytes that their pixels take uncompressed.
        compression: of the first frame's file.
        unused: channels of the first frame's file that play no role.
        types: by role, "half", "float" or "uint", of the first frame.
        attributes: of the first frame's file.
    """

    there: tuple[int, ...]
    missing: tuple[int, ...]
    checked: int
    damaged: dict[int, str]
    stored: int
    pixels: int
    compression: str
    unused: tuple[str, ...]
    types: dict[str, str]
    attributes: dict[str, Any]


def scan_files(source: Source, *, most: int | None = None) -> Scan:
    """Read the headers of all frames, or of at most so many, evenly spaced. Files that are damaged are listed, not raised."""
    numbered = [(index, number) for index, (number, path) in enumerate(source.sequence.files) if path is not None]
    some = (
        numbered
        if most is None or len(numbered) <= most
        else [numbered[i * len(numbered) // most] for i in range(most)]
    )
    damaged: dict[int, str] = {}
    first: dict[str, Header] = {}
    for index, number in some:
        try:
            headers = _check_file(source, index)
        except SvgfError as error:
            damaged[number] = str(error)
            continue
        first = first or headers
    main = next(iter(first), "")
    return Scan(
        tuple(number for _, number in numbered),
        tuple(number for number, path in source.sequence.files if path is None),
        len(some),
        damaged,
        sum(map(_size, _paths(source))),
        len(numbered) * sum(_raw_bytes(header) for header in first.values()),
        first[main].compression if first else "",
        tuple(name for name in first[main].channels if name not in _used(source)) if first else (),
        _types(source, first),
        first[main].attributes if first else {},
    )


def require_sound(scan: Scan) -> None:
    """Raise SvgfError that names the damaged files, if there are any."""
    if scan.damaged:
        more = len(scan.damaged) - 3
        raise SvgfError("\n".join([*scan.damaged.values()][:3]) + (f"\nand {more} more like this." if more > 0 else ""))


def samples_per_pixel(attributes: Mapping[str, Any], *, like: str = "") -> tuple[str, float] | None:
    """(attribute, samples) where a header says how many samples a pixel has: pbrt, Cycles, and whoever calls it so.

    Of several, such as Cycles has for its view layers, the first with `like` in its name is taken.
    """
    found = []
    for name, value in attributes.items():
        if re.search(r"(?i)(^|[^a-z])(spp|samples|samples_?per_?pixel|sample_?count|aa_?samples)$", name):
            try:
                number = float(value)
            except (TypeError, ValueError):
                continue
            if 0 < number < 1e9:
                found.append((name, number))
    return next((one for one in found if like in one[0]), found[0] if found else None)


def _check_file(source: Source, index: int) -> dict[str, Header]:
    """The headers of a frame's files by path. Raises SvgfError for what `read_frame` would not accept."""
    path = source.sequence.files[index][1]
    headers: dict[str, Header] = {}
    for role, layer in source.roles.layers.items():
        where = str(source.files[role].files[index][1]) if layer.own_file else str(path)
        if where not in headers:
            headers[where] = read_header(where, most=source.most)
            check_windows(headers[where], where, source)
        check_channels(layer, headers[where].channels, where=where, role=role)
    return headers


def _paths(source: Source) -> set[str]:
    """Every file of the frames, each once."""
    own = [source.files[role] for role, layer in source.roles.layers.items() if layer.own_file]
    return {str(path) for sequence in (source.sequence, *own) for _, path in sequence.files if path is not None}


def _used(source: Source) -> set[str]:
    return {name for layer in source.roles.layers.values() if not layer.own_file for name in layer.channels}


def _size(path: str) -> int:
    try:
        return os.path.getsize(path)
    except OSError:
        return 0


def _raw_bytes(header: Header) -> int:
    left, top, right, bottom = header.data_window
    return (right - left + 1) * (bottom - top + 1) * sum(kind.itemsize for kind in header.channels.values())


def _types(source: Source, headers: Mapping[str, Header]) -> dict[str, str]:
    names = {np.dtype(np.float16): "half", np.dtype(np.float32): "float", np.dtype(np.uint32): "uint"}
    known = {name: kind for header in headers.values() for name, kind in header.channels.items()}
    found: dict[str, str] = {}
    for role, layer in source.roles.layers.items():
        kinds = {names[known[name]] for name in layer.channels if name in known}
        found[role] = "half" if role in source.half else " ".join(sorted(kinds))
    return found
