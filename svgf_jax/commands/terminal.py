"""What commands say on the terminal: plain text, in which nothing that comes from a file is taken for markup."""

import json
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from svgf_jax.streaming import FrameReport


def tell(text: str) -> None:
    """One message on the standard error."""
    print(text, file=sys.stderr, flush=True)


def warn(texts: Iterable[str]) -> None:
    """Each text as a warning on the standard error."""
    for text in texts:
        tell(f"warning: {text}")


def print_json(value: Any) -> None:
    """`value` as JSON on the standard output."""
    print(to_json(value))


def to_json(value: Any) -> str:
    """JSON text; named tuples are objects, paths strings, and numbers that JSON does not have (nan, inf) null."""
    return json.dumps(_plain(value), indent=2, allow_nan=False)


@contextmanager
def progress(total: int) -> Iterator[Callable[["FrameReport"], None]]:
    """A function to call with each frame's report: a bar with frames/s and time left; off a terminal a line a frame."""
    with _bar(total) if sys.stderr.isatty() else _lines(total) as on_frame:
        yield on_frame


@contextmanager
def _lines(total: int) -> Iterator[Callable[["FrameReport"], None]]:
    last = time.monotonic()

    def on_frame(report: "FrameReport") -> None:
        nonlocal last
        now = time.monotonic()
        repaired = "".join(f", {count} {reason}" for reason, count in report.counts.items())
        where = "" if report.path is None else f" -> {report.path}"
        tell(f"frame {report.number}: {report.status} in {now - last:.2f} s{where}{repaired}")
        last = now

    yield on_frame


@contextmanager
def _bar(total: int) -> Iterator[Callable[["FrameReport"], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}", markup=False),
        TimeRemainingColumn(),
    )
    began, done = time.monotonic(), 0
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("reading, compiling", total=total, rate="")

        def on_frame(report: "FrameReport") -> None:
            nonlocal done
            done += 1
            rate = done / max(time.monotonic() - began, 1e-9)
            bar.update(task, advance=1, description=f"frame {report.number}", rate=f"{rate:.2f} frames/s")

        yield on_frame


def _plain(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        value = value._asdict()  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
