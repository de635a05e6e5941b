"""EXR files by hand: written and read with struct and zlib alone, so that tests know what a file holds without the library.

Format: https://openexr.com/en/latest/OpenEXRFileLayout.html. Compressions none, rle, zips, zip; scanlines and tiles, mip
and rip maps, several parts, subsampled channels. Never imports svgf_jax or OpenEXR.
"""

import itertools
import struct
import zlib
from typing import Any, NamedTuple

import numpy as np

COMPRESSIONS = ("none", "rle", "zips", "zip")
LINES = {"none": 1, "rle": 1, "zips": 1, "zip": 16}
DTYPES = {"uint": np.dtype("<u4"), "half": np.dtype("<f2"), "float": np.dtype("<f4")}
KINDS = tuple(DTYPES)


class Part(NamedTuple):
    """What one part is made of; `pixels` by channel name, `[H, W]` of the data window (every sample of subsampled ones)."""

    pixels: dict[str, np.ndarray]
    window: tuple[int, int, int, int]
    display: tuple[int, int, int, int]
    compression: str = "none"
    name: str = ""
    tile: tuple[int, int] | None = None
    levels: str = "one"  # one, mip, rip
    round_up: bool = False
    line_order: int = 0
    sampling: tuple[int, int] = (1, 1)
    attributes: tuple[tuple[str, str, bytes], ...] = ()


class Anatomy(NamedTuple):
    """Where things lie, for each part: attributes (place and size of the value), table (place, count), chunks (place, bytes
    before the pixels, bytes of pixels)."""

    attributes: list[dict[str, tuple[int, int]]]
    tables: list[tuple[int, int]]
    chunks: list[list[tuple[int, int, int]]]
    multi_part: bool


def attribute(name: str, kind: str, value: bytes) -> bytes:
    return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value


def compress(raw: bytes, how: str) -> bytes:
    if how == "none" or not raw:
        return raw
    data = np.frombuffer(raw, np.uint8)
    mixed = np.concatenate([data[::2], data[1::2]]).astype(np.int32)
    mixed[1:] = mixed[1:] - mixed[:-1] + 128
    mixed = (mixed & 255).astype(np.uint8).tobytes()
    packed = run_lengths(mixed) if how == "rle" else zlib.compress(mixed)
    return packed if len(packed) < len(raw) else raw


def run_lengths(raw: bytes) -> bytes:
    out, at = bytearray(), 0
    while at < len(raw):
        run = 1
        while run < 128 and at + run < len(raw) and raw[at + run] == raw[at]:
            run += 1
        if run >= 3:
            out += bytes([run - 1, raw[at]])
            at += run
        else:
            out += bytes([255, raw[at]])  # one byte as it is: -1
            at += 1
    return bytes(out)


def uncompress(packed: bytes, how: str, size: int) -> bytes:
    """Raises ValueError, zlib.error where the data are not what they should be."""
    if how == "none" or len(packed) == size:
        if len(packed) != size:
            raise ValueError("size")
        return packed
    if how == "rle":
        out, at = bytearray(), 0
        while at < len(packed):
            count = packed[at] - 256 if packed[at] > 127 else packed[at]
            if count < 0:
                out += packed[at + 1 : at + 1 - count]
                at += 1 - count
            else:
                out += packed[at + 1 : at + 2] * (count + 1)
                at += 2
        mixed = bytes(out)
    else:
        mixed = zlib.decompressobj().decompress(packed, size + 1)
    if len(mixed) != size:
        raise ValueError("size")
    data = np.frombuffer(mixed, np.uint8).astype(np.int64)
    data[1:] -= 128
    data = (np.cumsum(data) & 255).astype(np.uint8)
    plain = np.empty(size, np.uint8)
    plain[::2], plain[1::2] = data[: (size + 1) // 2], data[(size + 1) // 2 :]
    return plain.tobytes()


def level_sizes(length: int, round_up: bool) -> list[int]:
    sizes = [length]
    while sizes[-1] > 1:
        sizes.append((sizes[-1] + round_up) // 2)
    return sizes


def rectangles(part: Part) -> list[tuple[tuple[int, ...], int, int, int, int, bool]]:
    """(numbers in the chunk's head, left, top, right, bottom, of the picture itself?) of each chunk, in the table's order."""
    left, top, right, bottom = part.window
    width, height = right - left + 1, bottom - top + 1
    if part.tile is None:
        lines = LINES[part.compression]
        return [((y,), left, y, right, min(y + lines - 1, bottom), True) for y in range(top, bottom + 1, lines)]
    across, down = level_sizes(width, part.round_up), level_sizes(height, part.round_up)
    if part.levels == "one":
        levels = [(0, 0)]
    elif part.levels == "mip":
        levels = [(i, i) for i in range(max(len(across), len(down)))]
    else:
        levels = [(x, y) for y in range(len(down)) for x in range(len(across))]
    found = []
    for lx, ly in levels:
        w, h = across[min(lx, len(across) - 1)], down[min(ly, len(down) - 1)]
        for y, x in itertools.product(range(-(-h // part.tile[1])), range(-(-w // part.tile[0]))):
            x0, y0 = x * part.tile[0], y * part.tile[1]
            x1, y1 = min(x0 + part.tile[0], w) - 1, min(y0 + part.tile[1], h) - 1
            found.append(((x, y, lx, ly), left + x0, top + y0, left + x1, top + y1, lx == ly == 0))
    return found


def write(parts: list[Part]) -> bytes:
    """The bytes of a file of these parts."""
    multi = len(parts) > 1
    flags = 2 | (0x200 if parts[0].tile and not multi else 0) | (0x1000 if multi else 0)
    names = [name for part in parts for name in (*part.pixels, *(one[0] for one in part.attributes))]
    flags |= 0x400 if any(len(name) > 31 for name in names) else 0
    out = bytearray(b"\x76\x2f\x31\x01" + struct.pack("<I", flags))
    chunks = [[(head, _payload(part, where, own)) for head, *where, own in rectangles(part)] for part in parts]
    for part, own in zip(parts, chunks, strict=True):
        out += _header(part, len(own), multi)
    out += b"\0" if multi else b""
    at = len(out) + 8 * sum(map(len, chunks))
    tables: list[list[int]] = [[0] * len(own) for own in chunks]
    body = bytearray()
    for p, own in enumerate(chunks):
        order = range(len(own))
        for i in reversed(order) if parts[p].line_order == 1 else order:
            head, packed = own[i]
            tables[p][i] = at + len(body)
            numbers = (*((p,) if multi else ()), *head, len(packed))
            body += struct.pack(f"<{len(numbers)}i", *numbers) + packed
    for table in tables:
        out += struct.pack(f"<{len(table)}Q", *table)
    return bytes(out + body)


def _header(part: Part, count: int, multi: bool) -> bytes:
    channels = b"".join(
        name.encode() + b"\0" + struct.pack("<i4B2i", _kind(pixels), 0, 0, 0, 0, *part.sampling)
        for name, pixels in sorted(part.pixels.items())
    )
    compressions = {"none": 0, "rle": 1, "zips": 2, "zip": 3}
    out = attribute("channels", "chlist", channels + b"\0")
    out += attribute("compression", "compression", bytes([compressions[part.compression]]))
    out += attribute("dataWindow", "box2i", struct.pack("<4i", *part.window))
    out += attribute("displayWindow", "box2i", struct.pack("<4i", *part.display))
    out += attribute("lineOrder", "lineOrder", bytes([part.line_order]))
    out += attribute("pixelAspectRatio", "float", struct.pack("<f", 1.0))
    out += attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0))
    out += attribute("screenWindowWidth", "float", struct.pack("<f", 1.0))
    if part.tile:
        mode = ("one", "mip", "rip").index(part.levels) | (16 if part.round_up else 0)
        out += attribute("tiles", "tiledesc", struct.pack("<IIB", *part.tile, mode))
    if multi:
        out += attribute("name", "string", part.name.encode())
        out += attribute("type", "string", b"tiledimage" if part.tile else b"scanlineimage")
        out += attribute("chunkCount", "int", struct.pack("<i", count))
    for name, kind, value in part.attributes:
        out += attribute(name, kind, value)
    return out + b"\0"


def _kind(pixels: np.ndarray) -> int:
    return KINDS.index(next(kind for kind, dtype in DTYPES.items() if dtype == pixels.dtype))


def _payload(part: Part, where: list[int], own: bool) -> bytes:
    left, top, right, bottom = where
    raw = bytearray()
    for y in range(top, bottom + 1):
        for _, pixels in sorted(part.pixels.items()):
            x_step, y_step = part.sampling
            if y % y_step:
                continue
            xs = [x for x in range(left, right + 1) if x % x_step == 0]
            if own:
                raw += pixels[y - part.window[1]][[x - part.window[0] for x in xs]].tobytes()
            else:  # of smaller levels nobody reads anything
                raw += bytes(len(xs) * pixels.dtype.itemsize)
    return compress(bytes(raw), part.compression)


def dissect(raw: bytes) -> Anatomy:
    """Where things lie. Raises struct.error, LookupError, ValueError where the file does not hold together."""
    flags = struct.unpack_from("<I", raw, 4)[0]
    multi, at = bool(flags & 0x1000), 8
    attributes: list[dict[str, tuple[int, int]]] = []
    while True:
        found: dict[str, tuple[int, int]] = {}
        while raw[at]:
            end = raw.index(0, at)
            name = raw[at:end].decode("latin-1")
            end = raw.index(0, end + 1)
            size = struct.unpack_from("<i", raw, end + 1)[0]
            if size < 0 or end + 5 + size >= len(raw):
                raise ValueError(name)
            found[name] = (end + 5, size)
            at = end + 5 + size
        at += 1
        if found:
            attributes.append(found)
        if not multi or not found:
            break
    tables, chunks = [], []
    for number, found in enumerate(attributes):
        if "chunkCount" in found:
            count = struct.unpack_from("<i", raw, found["chunkCount"][0])[0]
        elif multi:
            raise NotImplementedError("parts that do not say how many chunks they have")
        else:
            count = _until_the_first_chunk(raw, at)
        if not 0 <= count <= len(raw) // 8:
            raise ValueError(f"{count} chunks in part {number}")
        tables.append((at, count))
        at += 8 * count
    for found, (start, count) in zip(attributes, tables, strict=True):
        tiled = "tiles" in found
        head = 4 * (multi + (4 if tiled else 1) + 1)
        own = []
        for offset in struct.unpack_from(f"<{count}Q", raw, start):
            inside = offset + head <= len(raw)
            own.append((offset, head, struct.unpack_from("<i", raw, offset + head - 4)[0] if inside else -1))
        chunks.append(own)
    return Anatomy(attributes, tables, chunks, multi)


def _until_the_first_chunk(raw: bytes, at: int) -> int:
    """How many entries a table has that does not say so: it ends where the first chunk begins."""
    first, count = len(raw), 0
    while at + 8 * count < first:
        entry = struct.unpack_from("<Q", raw, at + 8 * count)[0]
        first = min(first, entry) if entry > at else first
        count += 1
    return count


def value(raw: bytes, where: tuple[int, int]) -> bytes:
    return raw[where[0] : where[0] + where[1]]


def read(raw: bytes) -> list[dict[str, np.ndarray]] | None:
    """Pixels by channel of each part, the plain way; None where this reader does not know the file's kind.

    Raises struct.error, LookupError, ValueError, zlib.error where the data are not what they should be, NotImplementedError
    where parts do not count their chunks.
    """
    anatomy, found = dissect(raw), []
    for attributes, chunks in zip(anatomy.attributes, anatomy.chunks, strict=True):
        compression = value(raw, attributes["compression"])[0]
        kind = value(raw, attributes["type"]).rstrip(b"\0") if "type" in attributes else b""
        if compression > 3 or b"deep" in kind:
            return None
        channels = _channel_list(value(raw, attributes["channels"]))
        if any(sampling != (1, 1) for _, _, sampling in channels):
            return None
        window = struct.unpack("<4i", value(raw, attributes["dataWindow"]))
        shape: Any = (window[3] - window[1] + 1, window[2] - window[0] + 1)
        if shape[0] * shape[1] > 2**20:
            return None
        tile, mode = None, 0
        if "tiles" in attributes:
            *tile, mode = struct.unpack("<IIB", value(raw, attributes["tiles"])[:9])
        blank = {name: np.zeros(shape, DTYPES[KINDS[pixel_type]]) for name, pixel_type, _ in channels}
        part = Part(
            blank,
            window,
            window,
            COMPRESSIONS[compression],
            tile=tile and tuple(tile),
            levels=("one", "mip", "rip")[mode & 15],
            round_up=mode >> 4 == 1,
        )
        wanted = rectangles(part)
        if len(wanted) > len(chunks):  # more may follow, that the header does not speak of
            raise ValueError("chunks")
        for (head, left, top, right, bottom, own), (offset, head_size, size) in zip(wanted, chunks, strict=False):
            if raw[offset + head_size - 4 - 4 * len(head) : offset + head_size - 4] != struct.pack(
                f"<{len(head)}i", *head
            ):
                raise ValueError("place")
            if not own:
                continue
            packed = raw[offset + head_size : offset + head_size + size]
            width = right - left + 1
            per_line = width * sum(pixels.dtype.itemsize for pixels in blank.values())
            plain = uncompress(packed, part.compression, per_line * (bottom - top + 1))
            at = 0
            for y in range(top - window[1], bottom - window[1] + 1):
                for name, _, _ in channels:
                    row = np.frombuffer(plain, blank[name].dtype, width, at)
                    blank[name][y, left - window[0] : right - window[0] + 1] = row
                    at += row.nbytes
        found.append(blank)
    return found


def _channel_list(raw: bytes) -> list[tuple[str, int, tuple[int, int]]]:
    channels, at = [], 0
    while raw[at]:
        end = raw.index(0, at)
        pixel_type, _, x, y = struct.unpack_from("<i4s2i", raw, end + 1)
        channels.append((raw[at:end].decode("utf-8", "replace"), pixel_type, (x, y)))
        at = end + 17
    return channels
