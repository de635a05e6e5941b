"""Self-contained HTML pages: tables, plots, heat maps, and a viewer of frames. NumPy and Pillow only.

A page loads nothing: pictures are data URLs, plots inline SVG, style and script stand in it. Every text that is handed in
is escaped here, so that no name out of a file becomes markup.
"""

import base64
import hashlib
import html
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from svgf_jax.spelling import visible

WIDTH = 640  # pixels: pictures are never wider
# Dark to bright in even steps of lightness, by eye; black to white in grey print too.
_HEAT = (
    (0, 0, 4),
    (40, 17, 89),
    (101, 26, 128),
    (162, 48, 126),
    (222, 73, 104),
    (252, 135, 97),
    (254, 198, 138),
    (252, 253, 216),
)
HEAT = f"linear-gradient(90deg,{','.join(f'rgb{rgb}' for rgb in _HEAT)})"
"""The colours of `heat` as CSS."""
GREY = "linear-gradient(90deg,#000,#fff)"
SIGNED = "linear-gradient(90deg,#00f,#fff,#f00)"


class Line(NamedTuple):
    """A line of a plot: its name, and its points; where y is not finite there is none."""

    name: str
    x: Sequence[float]
    y: Sequence[float]


class Raw(NamedTuple):
    """A cell of a table that is HTML already."""

    html: str


class Shown(NamedTuple):
    """A frame in the viewer.

    Attributes:
        number: of the frame.
        pictures: data URLs by name; any two can be compared.
        maps: for a picture by name, data URLs of maps that belong to it.
        psnr: for a picture by name, in dB.
    """

    number: int
    pictures: Mapping[str, str]
    maps: Mapping[str, Mapping[str, str]] = {}
    psnr: Mapping[str, float] = {}


class Legend(NamedTuple):
    """What a map's colours mean: the CSS of its scale, what its least and what its most stand for."""

    palette: str
    least: str
    most: str


def escape(text: object) -> str:
    """Text for HTML, attributes included; control characters, and bytes of file names that are no text, are spelt out."""
    return html.escape(visible(str(text)))


def document(title: str, sections: Iterable[str]) -> str:
    """The whole page from its sections, which are HTML."""
    style, script = (Path(__file__).with_name(f"page.{kind}").read_text(encoding="utf-8") for kind in ("css", "js"))
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    icon = '<link rel="icon" href="data:,">'  # otherwise a browser asks the server for one
    # Should a text ever slip in unescaped: only this script runs, and nothing is loaded.
    digest = base64.b64encode(hashlib.sha256(f"\n{script}".encode()).digest()).decode()
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    head += f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
    body = "\n".join(section for section in sections if section)
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}<title>{escape(title)}</title>{icon}\n<style>\n{style}</style></head>\n'
        f"<body>\n{body}\n<script>\n{script}</script>\n</body></html>\n"
    )


def table(heads: Sequence[str], rows: Iterable[Sequence[object]], *, words: bool = False) -> str:
    """A table; a cell is text, (class, text) or `Raw`. Numbers stand to the right, `words` to the left."""

    def cell(content: object) -> str:
        if isinstance(content, Raw):
            return f"<td>{content.html}</td>"
        name, text = content if isinstance(content, tuple) else ("", content)
        return f'<td class="{name}">{escape(text)}</td>' if name else f"<td>{escape(text)}</td>"

    head = f"<tr>{''.join(f'<th>{escape(name)}</th>' for name in heads)}</tr>" if any(heads) else ""
    body = "".join(f"<tr>{''.join(map(cell, row))}</tr>" for row in rows)
    return f'<div class="wide"><table{" class=words" if words else ""}>{head}{body}</table></div>'


def listed(texts: Iterable[str], *, style: str = "") -> str:
    """Sentences, one below the other; "" for none."""
    items = "".join(f"<li>{escape(text)}</li>" for text in texts)
    return f'<ul class="{style}">{items}</ul>' if items else ""


def plot(
    lines: Sequence[Line],
    *,
    title: str,
    frames: Sequence[int] = (),
    marked: bool = True,
    follow: bool = False,
    log: bool = False,
    named: bool = False,
) -> str:
    """A figure with an SVG of lines; "" where no point is finite. Several lines have a legend, and one alone where `named`.

    The first of several is grey, for what the others are compared with; one alone has the colour of a result.

    `frames`: x is the number of one of these frames, and where `marked` a line shows which one the viewer shows. `follow`:
    only the lines of the two pictures that it compares are there. `log`: y is shown as its logarithm, and what is not
    above 0 is left out.
    """
    width, height, left, right, top, bottom = 440, 200, 52, 12, 10, 24
    drawn = [
        (
            name,
            [
                (x, math.log10(y) if log else y)
                for x, y in zip(xs, ys, strict=True)
                if math.isfinite(y) and (y > 0 or not log)
            ],
        )
        for name, xs, ys in lines
    ]
    points = [point for _, own in drawn for point in own]
    if not points:
        return ""
    xs, ys = zip(*points, strict=True)
    (x0, x1), (y0, y1) = _range(frames or xs), _range(ys)

    def across(x: float) -> float:
        return left + (x - x0) / (x1 - x0) * (width - left - right)

    def down(y: float) -> float:
        return height - bottom - (y - y0) / (y1 - y0) * (height - bottom - top)

    data = (
        f' data-x0="{x0:.9g}" data-x1="{x1:.9g}" data-from="{left}" data-to="{width - right}"'
        if frames and marked
        else ""
    )
    parts = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(title)}"{data}>']
    for y in _ticks(y0, y1):
        parts.append(f'<line class="grid" x1="{left}" x2="{width - right}" y1="{down(y):.1f}" y2="{down(y):.1f}"/>')
        shown = f"{10**y if log else y:.4g}"
        parts.append(f'<text x="{left - 5}" y="{down(y) + 4:.1f}" text-anchor="end">{shown}</text>')
    for x in _ticks(x0, x1, whole=bool(frames)):
        parts.append(f'<text x="{across(x):.1f}" y="{height - 7}" text-anchor="middle">{x:.6g}</text>')
    if frames and marked:
        parts.append(f'<line class="now" x1="{left}" x2="{left}" y1="{top}" y2="{height - bottom}"/>')
    first = int(len(drawn) == 1)
    for i, (name, own) in enumerate(drawn):
        at = [(f"{across(x):.1f}", f"{down(y):.1f}", f"{name} {x:.6g}: {10**y if log else y:.5g}") for x, y in own]
        path = " ".join(f"{x},{y}" for x, y, _ in at)
        dots = "".join(f'<circle cx="{x}" cy="{y}" r="2.2"><title>{escape(text)}</title></circle>' for x, y, text in at)
        style = "" if follow else f' class="k{(i + first) % 4}"'
        parts.append(
            f'<g data-name="{escape(name)}"{style}><polyline points="{path}"/>{dots if len(own) <= 200 else ""}</g>'
        )
    told = [] if follow or (len(drawn) < 2 and not named) else [name for name, _ in drawn]
    keys = "".join(f'<span class="key k{(i + first) % 4}">{escape(name)}</span>' for i, name in enumerate(told))
    style = ' class="follow"' if follow else ""
    return f"<figure{style}><figcaption>{escape(title)}{keys}</figcaption>{''.join(parts)}</svg></figure>"


def heat(plane: np.ndarray) -> np.ndarray:
    """A plane `[H, W]` in [0, 1] as colours `[H, W, 3]` uint8, dark to bright; nan is blue-green, which is no heat."""
    known = np.isfinite(plane)
    place = np.clip(np.where(known, plane, 0), 0, 1) * (len(_HEAT) - 1)
    colors = np.asarray(_HEAT, np.float32)
    rgb = [np.interp(place, range(len(_HEAT)), colors[:, c]) for c in range(3)]
    return np.where(known[..., None], np.stack(rgb, -1) + 0.5, (0, 90, 90)).astype(np.uint8)


def grey(plane: np.ndarray) -> np.ndarray:
    """A plane `[H, W]` in [0, 1] as grey `[H, W, 3]` uint8."""
    return np.repeat((np.clip(np.nan_to_num(plane), 0, 1) * 255 + 0.5).astype(np.uint8)[..., None], 3, axis=-1)


def signed(plane: np.ndarray) -> np.ndarray:
    """A plane `[H, W]` in [-1, 1] as colours `[H, W, 3]` uint8: blue below 0, white, red above."""
    x = np.clip(np.nan_to_num(plane), -1, 1)
    rgb = np.stack([1 - np.maximum(-x, 0), 1 - np.abs(x), 1 - np.maximum(x, 0)], axis=-1)
    return (rgb * 255 + 0.5).astype(np.uint8)


def picture(image: np.ndarray, *, most: int = 400_000, width: int = WIDTH) -> str:
    """8-bit `[H, W, 3]` as a data URL of at most about `most` bytes and `width` pixels: PNG if that fits, else JPEG.

    The JPEG's quality falls from 92 to 40 until it fits, then its size.
    """
    shown = Image.fromarray(np.ascontiguousarray(image))
    if shown.width > width:
        shown = shown.resize((width, max(1, round(shown.height * width / shown.width))), Image.Resampling.BOX)
    if shown.width * shown.height <= most:  # a PNG of a picture is seldom below a byte a pixel
        kind, data = "png", _encoded(shown, "PNG")
        if len(data) <= 0.75 * most:
            return f"data:image/png;base64,{base64.b64encode(data).decode()}"
    kind = "jpeg"
    while True:
        for quality in (92, 85, 75, 60, 40):
            data = _encoded(shown, "JPEG", quality=quality, subsampling=0 if quality > 80 else 2)
            if len(data) <= 0.75 * most or (quality == 40 and max(shown.size) <= 64):
                return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
        shown = shown.resize((max(1, shown.width * 3 // 4), max(1, shown.height * 3 // 4)), Image.Resampling.BOX)


def viewer(frames: Sequence[Shown], *, left: str, right: str, legends: Mapping[str, Legend]) -> str:
    """A scrubber over frames, a line between any two pictures of a frame, and the maps below; "" without frames."""
    frames, left, right = [_spelt(frame) for frame in frames], visible(left), visible(right)
    names = list(dict.fromkeys(name for frame in frames for name in frame.pictures))
    if not names:
        return ""

    def choice(label: str, selected: str) -> str:
        options = "".join(
            f'<option value="{escape(name)}"{" selected" if name == selected else ""}>{escape(name)}</option>'
            for name in names
        )
        return f'<label>{label} <select id="{label}">{options}</select></label>'

    told = [{name: f"{value:.2f} dB" for name, value in frame.psnr.items()} for frame in frames]
    shown = [frame._replace(psnr={})._asdict() | {"notes": notes} for frame, notes in zip(frames, told, strict=True)]
    data = json.dumps({"frames": shown, "legends": legends}).replace("<", "\\u003c")
    last = len(frames) - 1
    maps = {name for frame in frames for own in frame.maps.values() for name in own}
    lack = (
        '<p class="soft">No FLIP maps: they need the extra flip.</p>'
        if "difference" in maps and "FLIP" not in maps
        else ""
    )
    return f"""
<div class="row">{choice("left", left)}{choice("right", right)}</div>
<div class="view">
  <div class="stage" id="stage"><img alt="" draggable="false"><img class="over" alt="" draggable="false">
    <div class="line"></div><span class="is-left"></span><span class="is-right"></span></div>
  <input type="range" id="wipe" min="0" max="100" step="0.5" value="50" aria-label="line between left and right">
</div>
<div class="row">
  <button id="back" aria-label="frame before">&#9664;</button><button id="next" aria-label="next frame">&#9654;</button>
  <button id="play">play</button>
  <input class="grow" type="range" id="scrub" min="0" max="{last}" value="{(last + 1) // 2}" aria-label="frame">
  <output id="number"></output>
</div>
<p class="soft">Drag in the picture, or use the arrow keys on either slider; <kbd>,</kbd> and <kbd>.</kbd> step through the
frames anywhere.</p>
<h2 id="maps-of"></h2><div class="maps" id="maps"></div>{lack}
<script type="application/json" id="frames">{data}</script>
"""


def _spelt(frame: Shown) -> Shown:
    """The frame with its pictures' names as they are shown, by which the script finds them."""
    return Shown(
        frame.number,
        {visible(name): url for name, url in frame.pictures.items()},
        {visible(name): maps for name, maps in frame.maps.items()},
        {visible(name): value for name, value in frame.psnr.items()},
    )


def evenly(numbers: Sequence[int], most: int) -> tuple[int, ...]:
    """At most `most` of them, evenly spread, the first and the last among them."""
    if len(numbers) <= most:
        return tuple(numbers)
    return tuple(numbers[i] for i in np.linspace(0, len(numbers) - 1, most).round().astype(int))


def _encoded(image: Image.Image, kind: str, **options: int) -> bytes:
    data = io.BytesIO()
    image.save(data, kind, optimize=kind == "PNG", **options)  # optimised JPEGs fail on noise
    return data.getvalue()


def _range(values: Sequence[float]) -> tuple[float, float]:
    least, most = min(values), max(values)
    return (least, most) if most > least else (least - 0.5, most + 0.5) if least else (0.0, 1.0)


def _ticks(least: float, most: float, *, whole: bool = False) -> list[float]:
    """Two to five round numbers in a range."""
    rough = (most - least) / 4
    unit = 10 ** math.floor(math.log10(rough))
    step = next(factor * unit for factor in (1, 2, 5, 10) if factor * unit >= rough)
    step = max(step, 1) if whole else step
    first = math.ceil(least / step - 1e-9)
    return [i * step for i in range(first, math.floor(most / step + 1e-9) + 1)]
