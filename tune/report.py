"""One self-contained HTML page about a fit: curves, numbers with their errors, scores, pictures. No script but the slider's."""

import base64
import html
import tempfile
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from svgf_jax import Config, Params, SvgfError
from svgf_jax.metrics import psnr
from svgf_jax.preview import to_8bit, write_png
from tune.evaluate import filtered
from tune.explore import Profile, Sensitivity
from tune.fitting import Fit
from tune.free import natural, to_free
from tune.telling import Comparison

_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:1000px;margin:2em auto;padding:0 1em;color:#222;background:#fff}
table{border-collapse:collapse;margin:1em 0}td,th{padding:.25em .8em;text-align:right;border-bottom:1px solid #ddd}
td:first-child,th:first-child{text-align:left}.bad{color:#b00020;font-weight:600}.good{color:#1b6e3c}
svg{background:#fafafa;border:1px solid #ddd;margin:.4em .4em .4em 0}svg text{font:11px system-ui,sans-serif;fill:#444}
.pair{position:relative;display:inline-block;line-height:0}.pair img{max-width:100%;image-rendering:auto}
.pair img+img{position:absolute;left:0;top:0;clip-path:inset(0 50% 0 0)}input[type=range]{width:100%}
figure{margin:1em 0}.maps figure{display:inline-block;margin:.3em}figcaption{font-size:13px;color:#555}
"""
_SLIDER = "this.parentNode.querySelector('img+img').style.clipPath='inset(0 '+(100-this.value)+'% 0 0)'"
_COLORS = ("#888", "#0b6bcb", "#c4480a", "#1b6e3c")


def write_report(
    path: Path,
    found: Fit,
    start: Params,
    config: Config,
    compared: Sequence[Comparison],
    curves: Sequence[Profile],
    maps: Sensitivity,
    failures: Sequence[str],
) -> None:
    """Write the page to `path`. Raises SvgfError where that is not possible."""
    sections = [
        f"<h1>svgf-tune</h1><p>{_text(found.result)}. Loss 1 &rarr; {found.loss:.4f}.</p>",
        *(f'<p class="bad">Validation got worse: {_text(failure)}</p>' for failure in failures),
        *(f"<p>{_text(note)}</p>" for note in found.notes),
        "<h2>Loss</h2>" + _loss_curve(found),
        "<h2>Parameters</h2>" + _parameters(found),
        _scores(compared) if compared else "",
        _frames(compared) if compared else "",
        _slider(compared[0], start, config, found) if compared else "",
        _profiles(curves) if curves else "",
        _maps(found, maps),
    ]
    page = f"<!doctype html><html lang=en><meta charset=utf-8><title>svgf-tune</title><style>{_STYLE}</style>"
    try:
        path.write_text(page + "<body>" + "\n".join(sections) + "</body></html>\n", encoding="utf-8")
    except OSError as error:
        raise SvgfError(f"{path}: can't write the report: {error.strerror or error}") from None


def plot(
    lines: Sequence[tuple[str, Sequence[float], Sequence[float]]], *, title: str, size: tuple[int, int] = (460, 220)
) -> str:
    """An SVG of lines (name, x, y) with their range on the axes; what is not finite is left out."""
    width, height, left, bottom, top = *size, 56, 24, 24
    points = [(x, y) for _, xs, ys in lines for x, y in zip(xs, ys, strict=True) if np.isfinite(y)]
    if not points:
        return ""
    xs, ys = np.array(points, float).T
    (x0, x1), (y0, y1) = (_range(xs), _range(ys))

    def at(x: float, y: float) -> str:
        column = left + (x - x0) / (x1 - x0) * (width - left - 12)
        return f"{column:.1f},{height - bottom - (y - y0) / (y1 - y0) * (height - bottom - top):.1f}"

    parts = [f'<svg width="{width}" height="{height}" role="img" aria-label="{_text(title)}">']
    parts.append(f'<text x="{left}" y="15">{_text(title)}</text>')
    parts += [f'<text x="4" y="{y}">{value:.4g}</text>' for y, value in ((top + 8, y1), (height - bottom, y0))]
    parts += [
        f'<text x="{x}" y="{height - 8}" text-anchor="{anchor}">{value:.4g}</text>'
        for x, value, anchor in ((left, x0, "start"), (width - 12, x1, "end"))
    ]
    for i, (name, line_x, line_y) in enumerate(lines):
        color = _COLORS[i % len(_COLORS)]
        dots = [at(x, y) for x, y in zip(line_x, line_y, strict=True) if np.isfinite(y)]
        parts.append(f'<polyline points="{" ".join(dots)}" fill="none" stroke="{color}" stroke-width="2"/>')
        parts += [f'<circle cx="{d.split(",")[0]}" cy="{d.split(",")[1]}" r="2.5" fill="{color}"/>' for d in dots]
        parts.append(
            f'<text x="{width - 14}" y="{15 + 13 * i}" text-anchor="end" style="fill:{color}">{_text(name)}</text>'
        )
    return "".join(parts) + "</svg>"


def _loss_curve(found: Fit) -> str:
    lines = []
    for start in sorted({i.start for i in found.iterations}):
        taken = [i for i in found.iterations if i.start == start and i.accepted]
        lines.append((f"start {start}", [i.number for i in taken], [i.loss for i in taken]))
    rejected = sum(not i.accepted for i in found.iterations)
    return (
        plot(lines, title="accepted trial points")
        + f"<p>{len(found.iterations)} trial points, {rejected} rejected.</p>"
    )


def _parameters(found: Fit) -> str:
    knowledge = found.knowledge
    assert knowledge is not None
    before = natural(to_free(found.coordinates.start, found.coordinates), found.coordinates)
    rows = []
    for i, (label, value) in enumerate(zip(found.coordinates.labels, natural(found.y, found.coordinates), strict=True)):
        error = knowledge.standard_errors[i]
        known = f"&plusmn; {error:.2g}" if np.isfinite(error) else '<span class="bad">undetermined</span>'
        rows.append((_text(label), f"{before[i]:.4g}", f"{value:.4g}", known, f"{knowledge.leverage[i]:.2g}"))
    pairs = "".join(f"<p>{_text(a)} and {_text(b)} make up for each other.</p>" for a, b in knowledge.entangled)
    return _table(("parameter", "before", "after", "standard error", "leverage"), rows) + pairs


def _scores(compared: Sequence[Comparison]) -> str:
    rows = []
    for c in compared:
        mark = "good" if c.after.mean.psnr >= c.before.mean.psnr else "bad"
        row = [f"{_text(c.before.name)} ({c.role})"]
        for name, form in (("psnr", ".2f"), ("relmse", ".4g"), ("temporal", ".5f"), ("flip", ".4f")):
            before, after = getattr(c.before.mean, name), getattr(c.after.mean, name)
            row.append("" if np.isnan(after) else f'{before:{form}} &rarr; <span class="{mark}">{after:{form}}</span>')
            mark = ""
        rows.append(row)
    return "<h2>Before and after</h2>" + _table(("sequence", "PSNR dB", "relMSE", "temporal error", "HDR-FLIP"), rows)


def _frames(compared: Sequence[Comparison]) -> str:
    plots = []
    for c in compared:
        for name, title in (("psnr", "PSNR dB"), ("temporal", "temporal error")):
            before, after = ([getattr(s, name) for s in m.frames] for m in (c.before, c.after))
            x = list(range(len(before)))
            plots.append(
                plot(
                    [("before", x, before), ("after", x, after)], title=f"{title}, {c.role}: {Path(c.before.name).name}"
                )
            )
    return "<h2>Frame by frame</h2>" + "".join(plots)


def _slider(compared: Comparison, start: Params, config: Config, found: Fit) -> str:
    """Before, after and the reference of the frame that gained most."""
    gains = [a.psnr - b.psnr for a, b in zip(compared.after.frames, compared.before.frames, strict=True)]
    best = int(np.nanargmax(gains))

    def image(params: Params, config: Config) -> tuple[np.ndarray, np.ndarray]:
        pictures = ((i, t) for i, t in filtered(compared.shot, params, config) if t is not None)
        picture, target = next(islice(pictures, best, None))
        assert target is not None
        return picture, target

    (before, target), (after, _) = image(start, config), image(found.params, found.config)
    one, other, wanted = (_png(to_8bit(picture)) for picture in (before, after, target))
    names = f"before ({psnr(before, target):.2f} dB, left) and after ({psnr(after, target):.2f} dB, right)"

    def pair(right: str, left: str, caption: str) -> str:
        return (
            f'<figure><div><div class="pair"><img src="{right}" alt="right"><img src="{left}" alt="left"></div>'
            f'<input type="range" value="50" aria-label="{caption}" oninput="{_SLIDER}"></div>'
            f"<figcaption>{caption}</figcaption></figure>"
        )

    return (
        f"<h2>Frame {best} of {_text(compared.before.name)}</h2>"
        + pair(other, one, names)
        + pair(wanted, other, "after (left) and reference (right)")
    )


def _profiles(curves: Sequence[Profile]) -> str:
    plots = [
        plot(
            [("", np.log10(c.values).tolist(), c.losses.tolist())], title=f"loss over log10 {c.label}", size=(310, 180)
        )
        for c in curves
    ]
    return "<h2>Profiles</h2><p>The loss along each parameter, the others held.</p>" + "".join(plots)


def _maps(found: Fit, maps: Sensitivity) -> str:
    figures = []
    scale = max(float(np.quantile(np.abs(maps.slopes), 0.995)), 1e-30)
    for label, plane in zip(found.coordinates.labels, maps.slopes, strict=True):
        x = np.clip(plane / scale, -1, 1)
        rgb = np.stack([1 - np.maximum(-x, 0), 1 - np.abs(x), 1 - np.maximum(x, 0)], axis=-1)
        picture = _png((rgb * 255 + 0.5).astype(np.uint8))
        name = _text(label)
        figures.append(
            f'<figure><img width="310" src="{picture}" alt="{name}"><figcaption>{name}</figcaption></figure>'
        )
    return (
        "<h2>Where each parameter matters</h2><p>Blue: a larger value would make this pixel better; red: worse.</p>"
        f'<div class="maps">{"".join(figures)}</div>'
    )


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{name}</th>" for name in heads)
    return (
        f"<table><tr>{head}</tr>"
        + "".join(f"<tr>{''.join(f'<td>{c}</td>' for c in row)}</tr>" for row in rows)
        + "</table>"
    )


def _png(picture: np.ndarray) -> str:
    """`[H, W, 3]` uint8 as a data URL."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        write_png(path, np.ascontiguousarray(picture))
        return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()


def _range(values: np.ndarray) -> tuple[float, float]:
    least, most = float(values.min()), float(values.max())
    return (least, most) if most > least else (least - 0.5, most + 0.5)


def _text(text: str) -> str:
    return html.escape(str(text))
