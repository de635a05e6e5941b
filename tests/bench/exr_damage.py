"""Ways to damage an EXR file, for fuzz_exr.py: each changes `raw` in place; `base` says where things lay before."""

import struct
from typing import NamedTuple

import exr_files
import numpy as np

ODD = (0, 1, 2, 3, 7, 31, 127, 255, 256, 4095, 65535, 65536, 2**24, 2**30, 2**31 - 1, 2**31, 2**32 - 1, 2**32 - 2)


class Base(NamedTuple):
    """A whole file: its bytes, and the hashes of its channels once it has been read; None = the reader refuses it."""

    name: str
    raw: bytes
    anatomy: exr_files.Anatomy
    pixels: tuple[str, ...] | None = None


def damage(base: Base, other: Base, rng: np.random.Generator) -> tuple[bytes, str]:
    raw, told = bytearray(base.raw), []
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        name = list(DAMAGES)[rng.integers(len(DAMAGES))]
        told.append(name)
        DAMAGES[name](raw, base, other, rng)
    return bytes(raw), "+".join(told)


def _header_end(base: Base) -> int:
    return base.anatomy.tables[0][0]


def _chunk(base: Base, rng: np.random.Generator) -> tuple[int, int, int]:
    chunks = base.anatomy.chunks[rng.integers(len(base.anatomy.chunks))]
    return chunks[rng.integers(len(chunks))] if chunks else (_header_end(base), 8, 0)


def _put(raw: bytearray, at: int, value: bytes) -> None:
    if at < len(raw):
        raw[at : at + len(value)] = value[: len(raw) - at]


def _somewhere(raw: bytes | bytearray, rng: np.random.Generator) -> int:
    return int(rng.integers(max(len(raw), 1)))


def _odd(rng: np.random.Generator) -> int:
    value = int(rng.choice(ODD)) if rng.random() < 0.8 else int(rng.integers(0, 2**32))
    return (-value if rng.random() < 0.3 else value) & 0xFFFFFFFF


def _bits(start: float, end: float, raw: bytearray, rng: np.random.Generator) -> None:
    for _ in range(int(rng.integers(1, 9))):
        at = int(rng.integers(start, max(end, start + 1)))
        if at < len(raw):
            raw[at] = raw[at] ^ (1 << int(rng.integers(8))) if rng.random() < 0.7 else int(rng.integers(256))


def flip_anywhere(raw, base, other, rng):
    _bits(0, max(len(raw), 1), raw, rng)


def flip_header(raw, base, other, rng):
    _bits(4, _header_end(base), raw, rng)


def flip_table(raw, base, other, rng):
    start, count = base.anatomy.tables[rng.integers(len(base.anatomy.tables))]
    _bits(start, start + 8 * count, raw, rng)


def flip_pixels(raw, base, other, rng):
    offset, head, size = _chunk(base, rng)
    _bits(offset + head, offset + head + size, raw, rng)


def cut(raw, base, other, rng):
    del raw[_somewhere(raw, rng) if rng.random() < 0.7 else -int(rng.integers(1, 40)) :]


def insert(raw, base, other, rng):
    at = _somewhere(raw, rng)
    raw[at:at] = rng.bytes(int(rng.integers(1, 40)))


def delete(raw, base, other, rng):
    at = _somewhere(raw, rng)
    del raw[at : at + int(rng.integers(1, 40))]


def blank(raw, base, other, rng):
    at = _somewhere(raw, rng)
    size = min(int(rng.integers(1, 4096)), len(raw) - at)
    raw[at : at + size] = bytes([int(rng.choice([0, 255]))]) * size


def append(raw, base, other, rng):
    raw += rng.bytes(int(rng.integers(1, 4000)))


def splice(raw, base, other, rng):
    start, at = _somewhere(other.raw, rng), _somewhere(raw, rng)
    piece = other.raw[start : start + int(rng.integers(1, 2000))]
    _put(raw, at, piece)


def header_number(raw, base, other, rng):
    attributes = base.anatomy.attributes[rng.integers(len(base.anatomy.attributes))]
    at, size = attributes[list(attributes)[rng.integers(len(attributes))]]
    if size >= 4:
        _put(raw, at + 4 * int(rng.integers(size // 4)), struct.pack("<I", _odd(rng)))
    elif size:
        _put(raw, at, rng.bytes(1))


def attribute_size(raw, base, other, rng):
    attributes = base.anatomy.attributes[rng.integers(len(base.anatomy.attributes))]
    at, size = attributes[list(attributes)[rng.integers(len(attributes))]]
    _put(raw, at - 4, struct.pack("<I", _odd(rng) if rng.random() < 0.5 else max(size + int(rng.integers(-9, 9)), 0)))


def huge_window(raw, base, other, rng):
    for attributes in base.anatomy.attributes:
        width, height = (int(2 ** rng.uniform(4, 31)) for _ in range(2))
        left, top = (int(rng.choice([0, -5, -(2**30)])) for _ in range(2))
        right, bottom = min(left + width, 2**31 - 1), min(top + height, 2**31 - 1)
        _put(raw, attributes["dataWindow"][0], struct.pack("<4i", left, top, right, bottom))


def tile_size(raw, base, other, rng):
    for attributes in base.anatomy.attributes:
        if "tiles" in attributes:
            sizes = (int(rng.choice([1, 2, 2**31 - 1, 2**32 - 1, int(2 ** rng.uniform(0, 32))])) for _ in range(2))
            _put(raw, attributes["tiles"][0], struct.pack("<IIB", *sizes, int(rng.choice([0, 1, 2, 16, 17, 18, 255]))))


def compression(raw, base, other, rng):
    attributes = base.anatomy.attributes[rng.integers(len(base.anatomy.attributes))]
    _put(raw, attributes["compression"][0], bytes([int(rng.integers(0, 15))]))


def pixel_type(raw, base, other, rng):
    attributes = base.anatomy.attributes[rng.integers(len(base.anatomy.attributes))]
    at, size = attributes["channels"]
    place = raw.find(b"\0", at, at + size) + 1
    field = int(rng.integers(4))
    _put(raw, place + 4 * field, struct.pack("<I", int(rng.choice([0, 1, 2, 3])) if rng.random() < 0.7 else _odd(rng)))


def flags(raw, base, other, rng):
    word = struct.unpack_from("<I", raw, 4)[0] if len(raw) >= 8 else 2
    _put(raw, 4, struct.pack("<I", word ^ (1 << int(rng.choice([0, 1, 8, 9, 10, 11, 12, 13, 31])))))


def table_entry(raw, base, other, rng):
    start, count = base.anatomy.tables[rng.integers(len(base.anatomy.tables))]
    if count == 0:
        return
    at = start + 8 * int(rng.integers(count))
    other_at = start + 8 * int(rng.integers(count))
    values = [0, 1, start, len(raw), len(raw) - 8, 2**63, 2**64 - 1, int(rng.integers(0, len(raw) + 9))]
    choice = int(rng.integers(len(values) + 2))
    if choice < len(values):
        _put(raw, at, struct.pack("<Q", values[choice] & (2**64 - 1)))
    elif choice == len(values):
        _put(raw, at, bytes(raw[other_at : other_at + 8]))
    else:
        old, new = bytes(raw[at : at + 8]), bytes(raw[other_at : other_at + 8])
        _put(raw, at, new)
        _put(raw, other_at, old)


def chunk_head(raw, base, other, rng):
    offset, head, size = _chunk(base, rng)
    field = int(rng.integers(head // 4))
    near = size + int(rng.integers(-9, 9)) if field == head // 4 - 1 else int(rng.integers(-2, 50))
    _put(raw, offset + 4 * field, struct.pack("<I", (near if rng.random() < 0.5 else _odd(rng)) & 0xFFFFFFFF))


def chunk_count(raw, base, other, rng):
    for attributes in base.anatomy.attributes:
        if "chunkCount" in attributes:
            _put(raw, attributes["chunkCount"][0], struct.pack("<I", _odd(rng)))


DAMAGES = {
    one.__name__: one
    for one in (
        flip_anywhere, flip_header, flip_table, flip_pixels, cut, insert, delete, blank, append, splice, header_number,
        attribute_size, huge_window, tile_size, compression, pixel_type, flags, table_entry, chunk_head, chunk_count,
    )
}  # fmt: skip
