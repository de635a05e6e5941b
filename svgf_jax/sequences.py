"""Which files are the frames: folders, patterns and ranges as people write them, and what is missing.

A pattern names the frame number's place: `frame_####.exr` (one digit for each #, also `@` or `?`), `frame_%04d.exr`,
`frame_$F4.exr`; `#`, `%d` or `$F` is a number without padding. A range is `1-100`, `1-100x2` (every second) or
`1,3,5-9`. Frames are always taken in ascending order.
"""

import difflib
import os
import re
from collections.abc import Iterable
from typing import Literal, NamedTuple, get_args

from fileseq.constants import PAD_STYLE_HASH1
from fileseq.exceptions import FileSeqException
from fileseq.filesequence import FileSequence
from fileseq.frameset import FrameSet

from svgf_jax.exr_layout import PathName
from svgf_jax.types import SvgfError

Missing = Literal["error", "hold", "reset"]

_PLACE = re.compile(r"[#@?]+|%(?:0?\d+)?d|\$F\d*")


class Sequence(NamedTuple):
    """The frames of a sequence, found on the disk before any is read.

    Attributes:
        files: frame number and path of each frame, ascending; the path is None where the file is missing.
        name: the pattern, for people: `shot/frame_####.exr`, or the path of a single file.
        padding: least number of digits of the frame number; 0 for a file without a number.
        missing: what a missing frame means: "hold" keeps the history for the next frame, "reset" starts anew after it.
        warmup: how many of the first files lie before the frames that are wanted, to fill the history; None: the frames are
            not a part of a larger run.
    """

    files: tuple[tuple[int, str | None], ...]
    name: str
    padding: int
    missing: Missing
    warmup: int | None = None


def find_sequence(
    pattern: PathName,
    *,
    frames: str | None = None,
    missing: Missing = "error",
    warmup: int | None = None,
    prefer: tuple[str, ...] = ("frame", "beauty"),
) -> Sequence:
    """The sequence that a pattern, a folder or a single file stands for.

    In a folder that holds several sequences the first that is called as in `prefer` is taken (`frame_0001.exr` is
    called frame); a folder without EXR files stands for the folder `input` in it. Without `frames` every frame between
    the first and the last on the disk is wanted. `warmup`: also up to so many frames before them, at their distance, as far
    as the first on the disk; a file with a number is then one frame of its sequence. Raises SvgfError: nothing there, an
    unclear folder, a range that cannot be read, missing frames under "error".
    """
    if missing not in get_args(Missing):
        raise SvgfError(f"missing={missing!r} is not known; choose one of {', '.join(get_args(Missing))}.")
    text = os.fspath(pattern)
    wanted = None if frames is None else parse_range(frames)
    if warmup is not None and warmup < 0:
        raise SvgfError(f"warmup = {warmup}; wanted a number of frames, 0 or more.")
    if os.path.isdir(text):
        inside = os.path.join(text, "input")
        text = _pick(text if _patterns(text) or not _patterns(inside) else inside, prefer)
    if os.path.isfile(text):
        number = re.search(r"(\d+)(?!.*\d)", os.path.basename(text))
        if number is None or (wanted is None and not warmup):
            return _single(text, number, wanted, missing)._replace(warmup=None if warmup is None else 0)
        wanted = wanted or [int(number[0])]
        start = len(text) - len(os.path.basename(text))
        text = text[: start + number.start()] + "#" * len(number[0]) + text[start + number.end() :]
    found, padding = _match(text)
    if not found:
        raise SvgfError(f"{text}: no such {'frames' if padding else 'file or folder'}. {_near(text)}")
    if wanted is None:
        wanted = list(range(min(found), max(found) + 1))
    earlier = _earlier(wanted, found, warmup or 0)
    wanted = [*earlier, *wanted]
    gaps = [number for number in wanted if number not in found]
    if gaps and (missing == "error" or len(gaps) == len(wanted)):
        there = format_range(found)
        raise SvgfError(
            f"{text}: {len(gaps)} of {len(wanted)} frames are missing: {format_range(gaps)}; on the disk are {there}. "
            f"Render them, or take a range that is there (--frames {there})"
            + (", or go on without them (--missing hold|reset)." if len(gaps) < len(wanted) else ".")
        )
    files = tuple((number, found.get(number)) for number in wanted)
    return Sequence(files, text, padding, missing, None if warmup is None else len(earlier))


def beside(sequence: Sequence, name: str, *, extension: str = ".exr") -> str | None:
    """The pattern of the files called `name` where those of `sequence` are called beauty (or color), if there are any.

    `shot/beauty_####.exr`, `depth` -> `shot/depth_####.exr`, if a file of that pattern is there.
    """
    folder, own = os.path.split(sequence.name)
    called = re.match(r"(?i)(beauty|colou?r)(?![a-z])", own)
    if called is None:
        return None
    other = os.path.join(folder, name + os.path.splitext(own[called.end() :])[0] + extension)
    return other if os.path.isfile(other) or _match(other)[0] else None


def companion(
    sequence: Sequence, pattern: PathName, *, partial: bool = False, prefer: tuple[str, ...] = ("frame",)
) -> Sequence:
    """The files of another pattern (or one file for all frames) with the frame numbers of `sequence`.

    A relative pattern may also be meant beside the sequence's own files. Raises SvgfError where a frame that the
    sequence has is missing here, unless `partial`.
    """
    text = os.fspath(pattern)
    near = os.path.join(os.path.dirname(sequence.name), text)
    missing = text if os.path.dirname(text) else near
    text = next((place for place in (text, near) if os.path.exists(place) or _match(place)[0]), missing)
    if os.path.isfile(text):
        return sequence._replace(files=tuple((number, text) for number, _ in sequence.files), name=text, padding=0)
    other = find_sequence(text, missing="hold", prefer=prefer)
    paths = dict(other.files)
    files = tuple((number, paths.get(number)) for number, _ in sequence.files)
    gaps = [number for (number, path), (_, own) in zip(files, sequence.files, strict=True) if own and not path]
    if gaps and not partial:
        there = format_range(number for number, path in other.files if path)
        raise SvgfError(
            f"{other.name}: frames {format_range(gaps)} of {sequence.name} are missing here; on the disk are {there}. "
            f"Render them, or take a range that both have (--frames)."
        )
    return sequence._replace(files=files, name=other.name, padding=other.padding)


def parse_range(text: str) -> list[int]:
    """Frame numbers of `1-100`, `1-100x2`, `1,3,5-9`, ascending and each once. Raises SvgfError."""
    try:
        numbers = sorted({int(str(number)) for number in FrameSet(text)})
    except (FileSeqException, ValueError, TypeError):
        numbers = []
    if not numbers:
        raise SvgfError(f"frame range {text!r} cannot be read; wanted something like 1-100, 1-100x2 or 1,3,5-9.")
    return numbers


def format_range(numbers: Iterable[int]) -> str:
    """`1-5,7`: the shortest way to write frame numbers."""
    return FrameSet.framesToFrameRange(numbers, sort=True)


def _earlier(wanted: list[int], found: Iterable[int], count: int) -> list[int]:
    """The numbers of up to so many frames before those that are wanted, from one on that is on the disk."""
    step = wanted[1] - wanted[0] if len(wanted) > 1 else 1
    numbers = [wanted[0] - step * i for i in range(count, 0, -1)]
    first = next((i for i, number in enumerate(numbers) if number in set(found)), count)
    return numbers[first:]


def _single(path: str, number: re.Match[str] | None, wanted: list[int] | None, missing: Missing) -> Sequence:
    if wanted is not None and len(wanted) != 1:
        raise SvgfError(
            f"{path}: one file without a frame number, but {len(wanted)} frames are asked for; try a pattern."
        )
    frame = wanted[0] if wanted else int(number[0]) if number else 0
    return Sequence(((frame, path),), path, len(number[0]) if number else 0, missing)


def _match(pattern: str) -> tuple[dict[int, str], int]:
    """Path by frame number of the files that match, and the padding (0: the pattern has no place for a number)."""
    folder, name = os.path.split(pattern)
    places = list(_PLACE.finditer(name))
    if len(places) > 1 or (_PLACE.search(folder) and not os.path.isdir(folder)):
        raise SvgfError(
            f"{pattern}: wanted one place for the frame number, in the file's name; for example frame_####.exr."
        )
    if not places:
        return {}, 0
    place = places[0]
    padding = max(1, FileSequence.getPaddingNum(place[0].replace("?", "#"), pad_style=PAD_STYLE_HASH1))
    form = re.compile(re.escape(name[: place.start()]) + r"(-?\d+)" + re.escape(name[place.end() :]))
    found = {}
    for entry in _list(folder):
        hit = form.fullmatch(entry)
        if hit and hit[1] == str(int(hit[1])).zfill(padding):
            found[int(hit[1])] = os.path.join(folder, entry)
    return found, padding


def _pick(folder: str, prefer: tuple[str, ...]) -> str:
    """The one EXR sequence (or file) of a folder that is meant."""
    names = _patterns(folder)
    called = {re.split(r"[#]", name)[0].rstrip("._- ").lower(): name for name in names if "#" in name}
    for name in prefer:
        if name in called:
            return os.path.join(folder, called[name])
    choice = list(called.values()) if len(called) == 1 else names
    if len(choice) == 1:
        return os.path.join(folder, choice[0])
    if not choice:
        held = _near(os.path.join(folder, "x")).removeprefix(f"The folder {folder} ")
        raise SvgfError(f"{folder}: wanted a folder of EXR files; this one {held}")
    raise SvgfError(
        f"{folder}: several sequences are here: {', '.join(names)}. Say which: {os.path.join(folder, names[0])}"
    )


def _patterns(folder: str) -> list[str]:
    """The EXR sequences of a folder as patterns, single files as themselves."""
    files = [name for name in _list(folder) if name.lower().endswith(".exr")]
    found = FileSequence.findSequencesInList(files, pad_style=PAD_STYLE_HASH1)
    return sorted(f"{item.basename()}{item.padding()}{item.extension()}" for item in found)


def patterns(folder: str) -> dict[str, str]:
    """The EXR sequences and files of a folder: pattern by its name, in which one # stands for the whole frame number."""
    return {re.sub("#+", "#", name): os.path.join(folder, name) for name in _patterns(folder)}


def _near(pattern: str) -> str:
    """What is there instead, for an error message."""
    folder, name = os.path.split(pattern)
    if not os.path.isdir(folder or "."):
        while folder and not os.path.isdir(os.path.dirname(folder) or "."):
            folder = os.path.dirname(folder)
        parent, missing = os.path.split(folder)
        close = difflib.get_close_matches(missing, _list(parent), n=3, cutoff=0.5)
        return f"There is no folder {folder}" + (f"; did you mean {' or '.join(close)}?" if close else ".")
    names = _patterns(folder)
    if not names:
        others = [entry for entry in _list(folder) if not entry.startswith(".")][:5]
        return f"The folder {folder or '.'} holds " + (
            f"no EXR files, but {', '.join(others)}." if others else "nothing."
        )
    close = difflib.get_close_matches(name, names, n=5, cutoff=0.0)
    return f"In {folder or '.'} there is {', '.join(close)}" + (" ..." if len(names) > len(close) else ".")


def _list(folder: str) -> list[str]:
    """The names in a folder, hidden ones (unfinished output) left out; none if it cannot be read.

    Raises SvgfError: an EXR file whose name could steer a terminal, or pass for lines of a message, or is not UTF-8.
    """
    try:
        names = sorted(name for name in os.listdir(folder or ".") if not name.startswith("."))
    except OSError:
        return []
    odd = {
        name for name in names if re.search(r"[\x00-\x1f\x7f-\x9f\udc80-\udcff]", name)
    }  # or bytes that are no UTF-8
    if files := sorted(name for name in odd if name.lower().endswith(".exr")):
        what = "bytes that are not UTF-8" if re.search(r"[\udc80-\udcff]", files[0]) else "control characters"
        raise SvgfError(f"{folder or '.'}: {what} in the name {files[0]!r}; rename it.")
    return [name for name in names if name not in odd]
