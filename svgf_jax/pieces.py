"""What the pages of `report` are made of: headings, curves of scores, tables of parameters and versions. No JAX."""

import importlib.metadata
import math
import platform
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from svgf_jax import __version__, metrics, page
from svgf_jax.page import Line, Shown
from svgf_jax.sequences import format_range


def curves(
    x: Sequence[int],
    scores: Sequence[metrics.Scores | None],
    name: str,
    others: Mapping[str, Mapping[int, metrics.Scores]],
) -> list[str]:
    """PSNR and temporal error, where there are references; `others`: the scores of what it is compared with, by frame number."""
    if not any(score is not None for score in scores):
        return []
    return [
        page.plot(lines(x, scores, name, field, others), title=text, frames=x, named=True)
        for field, text in (("psnr", "PSNR, dB"), ("temporal", "temporal error"))
    ]


def lines(
    x: Sequence[int],
    scores: Sequence[metrics.Scores | None],
    name: str,
    field: str,
    others: Mapping[str, Mapping[int, metrics.Scores]],
) -> list[Line]:
    """What it is compared with first; lines without a finite value are left out."""
    drawn = [Line(other, list(of), _values(list(of.values()), field)) for other, of in others.items()]
    drawn.append(Line(name, x, _values(scores, field)))
    return [line for line in drawn if any(map(math.isfinite, line.y))]


def _values(scores: Sequence[metrics.Scores | None], field: str) -> list[float]:
    return [math.nan if score is None else float(getattr(score, field)) for score in scores]


def title(text: str, below: str) -> str:
    """The head of a page."""
    return f"<h1>{page.escape(text)}</h1><p>{page.escape(below)}</p>"


def plots(drawn: Iterable[str]) -> str:
    """Curves under one heading; "" without any."""
    text = "".join(drawn)
    return f'<h2>Frame by frame</h2><div class="plots">{text}</div>' if text else ""


def folded(summary: str, content: str) -> str:
    """What is there when its summary is clicked."""
    return f"<details><summary>{page.escape(summary)}</summary>{content}</details>"


def pictures_of(shown: Collection[Shown], count: int) -> str:
    """Which of so many frames have pictures, in words."""
    if len(shown) == count:
        return f"of all {count} frames"
    return f"of {len(shown)} of {count} frames, evenly spread: {format_range([frame.number for frame in shown])}"


def parameters(values: Mapping[str, Any]) -> str:
    """Numbers and choices, as `outputs.numbers` gives them."""

    def short(value: Any) -> str:
        if isinstance(value, list):
            return ", ".join(map(short, value))
        return f"{value:.6g}" if isinstance(value, float) else str(value).lower()

    both = {**values.get("parameters", {}), **values.get("config", {})}
    rows = [(name, short(value)) for name, value in both.items()]
    return f"<h2>Parameters</h2>{page.table(('parameter', 'value'), rows, words=True)}" if rows else ""


def versions(told: Sequence[tuple[str, object]]) -> str:
    """Facts, and with which versions they came about: those of packages that are installed."""
    known = [("svgf_jax", __version__), ("Python", platform.python_version()), ("system", platform.platform())]
    for name in ("jax", "numpy", "OpenEXR"):
        try:
            known.append((name, importlib.metadata.version(name)))
        except importlib.metadata.PackageNotFoundError:
            continue
    return f"<h2>Run and versions</h2>{page.table(('', ''), [*told, *known], words=True)}"
