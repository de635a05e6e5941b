"""What commands say on the terminal: plain text, in which nothing that comes from a file is taken for markup."""

import json
import math
import os
import re
import sys
import time
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from svgf_jax.spelling import visible
from svgf_jax.types import SvgfError

if TYPE_CHECKING:
    from svgf_jax.filing import FrameReport


REPAIRS = {
    "excess": "with more emission than the radiance that contains it: the rest taken as 0",
    "rest": "with more light than its parts: what is in none of them stays unfiltered",
    "changed": "with a picture that is not the sum of its parts: the sum taken",
    "guides": "hit, but without a usable depth or normal: taken as background",
    "normal": "with a normal not of unit length: brought to it",
    "radiance": "with non-finite radiance: set to 0",
    "negative": "with negative radiance: set to 0",
    "bright": "with radiance above 1e12: set to that",
    "emission": "with non-finite emission: set to 0",
    "surface": "with a non-finite normal, depth or albedo: taken as background",
    "motion": "with non-finite motion or previous depth: without history",
    "clipped": "brighter than 16-bit float holds: clamped (--float keeps them)",
    "not_finite": "not finite in the output",
}
"""What became of the pixels that a frame's report counts, by its reason."""


INTERRUPTED = (129, 130, 143)
"""Exit codes of a run that a signal ended."""


def tell(text: str) -> None:
    """One message on the standard error. Where nobody can read it any more, the work goes on all the same."""
    try:
        print(visible(text), file=sys.stderr, flush=True)
    except OSError:  # `2>&1 | head`, a log on a full disk, a terminal that was closed
        silence(sys.stderr)


def run_to_the_end(command: Callable[[], None]) -> None:
    """Run a command line as all that a process does.

    Where it was interrupted the interpreter is not tidied up: threads may still compile, and would find nothing there any more.
    """
    try:
        command()
    except SystemExit as end:
        if end.code in INTERRUPTED:
            for stream in (sys.stdout, sys.stderr):
                with suppress(OSError, ValueError, AttributeError):  # closed
                    stream.flush()
            os._exit(int(end.code))
        raise


def require_lines(arguments: Iterable[str]) -> None:
    """SvgfError for an argument of several lines: a file's or folder's name that would pass for lines of a message; for one
    that is not UTF-8, which outputs could not keep; and for an empty one: `-o ""` would be the current folder.
    """
    arguments = list(arguments)
    if arguments[:1] == ["__complete"]:  # a shell asks, in the midst of a word or before one
        return
    for number, argument in enumerate(arguments, 1):
        if "\n" in argument:
            raise SvgfError(
                f"Got {argument!r}: a line break in an argument. If it is in a name, rename the file or folder."
            )
        if any("\udc80" <= letter <= "\udcff" for letter in argument):
            raise SvgfError(f"Got {argument!r}: not UTF-8. If it is a name, rename the file or folder.")
        if not argument.strip() or re.fullmatch("--[a-z-]+=", argument):
            raise SvgfError(f"Got {argument!r} as argument {number}; wanted something there. Is a variable not set?")


def _forgiving(stream: Any) -> Any:
    """A stream, for rich to draw on, that may come to lead nowhere: as in `tell`."""

    def forgive(do: Callable[..., Any]) -> Callable[..., Any]:
        def done(*given: Any) -> Any:
            try:
                return do(*given)
            except OSError:
                silence(stream)

        return done

    kept = {name: getattr(stream, name) for name in ("isatty", "fileno", "encoding")}
    return SimpleNamespace(write=forgive(stream.write), flush=forgive(stream.flush), **kept)


def silence(stream: Any) -> None:
    """Send what is still to come on a standard stream nowhere."""
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), stream.fileno())


def open_streams() -> None:
    """Standard streams that a command was given closed (`2>&-`) lead nowhere; else its files would get their numbers."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    for name, number, mode in (("stdin", 0, "r"), ("stdout", 1, "w"), ("stderr", 2, "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115 (as the others)


def warn(texts: Iterable[str]) -> None:
    """Each text as a warning on the standard error."""
    for text in texts:
        tell(f"warning: {text}")


def repairs(counts: Mapping[str, int]) -> list[str]:
    """A phrase for each reason for which pixels were counted: `2 pixels with negative radiance: set to 0`."""
    return [f"{count} pixel{'s' * (count != 1)} {REPAIRS.get(reason, reason)}" for reason, count in counts.items()]


def count(number: int, noun: str) -> str:
    """`1 frame`, `2 frames`."""
    return f"{number} {noun}{'s' * (number != 1)}"


def size(amount: float) -> str:
    """Bytes for people: `5.2 MB`."""
    units = ("bytes", "kB", "MB", "GB", "TB")
    power = min(int(math.log10(max(amount, 1)) / 3), len(units) - 1)
    amount /= 1000**power
    return f"{amount:.0f} {units[power]}" if amount >= 100 else f"{amount:.3g} {units[power]}"


def duration(seconds: float) -> str:
    """A time for people: `40 s`, `3 min`, `2 h 5 min`."""
    if seconds < 90:
        return f"{max(seconds, 1):.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def print_json(value: Any) -> None:
    """`value` as JSON on the standard output; where nobody reads it any more, nowhere: it comes last, the work is done."""
    try:
        print(to_json(value), flush=True)
    except BrokenPipeError:
        silence(sys.stdout)


def to_json(value: Any) -> str:
    """JSON text; named tuples are objects, paths strings, and numbers that JSON does not have (nan, inf) null."""
    return json.dumps(_plain(value), indent=2, allow_nan=False)


@contextmanager
def progress(total: int) -> Generator[Callable[["FrameReport"], None]]:
    """A function to call with each frame's report: a bar with frames/s and time left; off a terminal a line a frame."""
    with bar(total) as advance:

        def on_frame(report: "FrameReport") -> None:
            advance(f"frame {report.number}")
            if not sys.stderr.isatty():
                where = "" if report.path is None else f" -> {report.path}"
                tell("; ".join([f"frame {report.number}: {report.status}{where}", *repairs(report.counts)]))

        yield on_frame


@contextmanager
def bar(total: int) -> Generator[Callable[[str], None]]:
    """A function to call after each of so many frames, with its name; it moves a bar, or does nothing off a terminal."""
    if not sys.stderr.isatty():
        yield lambda name: None
        return
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
    with Progress(*columns, console=Console(file=_forgiving(sys.stderr))) as shown:
        task = shown.add_task("reading, compiling", total=total, rate="")

        def advance(name: str) -> None:
            nonlocal done
            done += 1
            rate = done / max(time.monotonic() - began, 1e-9)
            shown.update(task, advance=1, description=name, rate=f"{rate:.2f} frames/s")

        yield advance


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
