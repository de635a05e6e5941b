"""What a run will write, checked before it starts: output names, collisions, and where a resumed run begins. No JAX."""

import contextlib
import errno
import os
import re
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from svgf_jax import checkpoint
from svgf_jax.atomic import check_names, short
from svgf_jax.checkpoint import Checkpoint, Identity
from svgf_jax.types import SvgfError

Files = Sequence[tuple[int, str | None]]


class Plan(NamedTuple):
    """The files of a run.

    Attributes:
        out: the output folder.
        files: (frame number, input file or None if missing), in order.
        outputs: for each the EXR to write, under the input's name; None for a missing frame that is not held, and for those
            that only warm up.
        png: whether each EXR has a PNG beside it.
        video: the video to write, if any.
        identity: what the run computes, to recognise it by when it is resumed.
        hold: whether the history is kept across a missing frame.
        warmup: how many of the first frames are filtered for the sake of the history only.
        state: where the run's state is kept (see `svgf_jax.checkpoint`).
        others: further files of the same frames.
    """

    out: Path
    files: Files
    outputs: tuple[Path | None, ...]
    png: bool
    video: Path | None
    identity: Identity
    hold: bool
    warmup: int
    state: Path
    others: tuple[Files, ...] = ()


def make_plan(
    files: Files,
    out: Path,
    *,
    hold: bool,
    png: bool,
    video: bool,
    identity: Identity,
    others: Sequence[Files] = (),
    warmup: int | None = None,
) -> Plan:
    """Name the outputs. `hold`: missing frames get one too. `others`: further files of the same frames.

    `warmup`: so many of the first files get no output, and the run is a part of a larger one; None: it is the whole.
    `identity` is all of what the run computes but its input frames, which are added here.

    Raises SvgfError: `out` is a file or names one, an output would be an input or has too long a name, nothing there to hold.
    """
    if out.suffix.lower() == ".exr" or re.search(r"[#%*?@]", out.name) or os.path.isfile(out):
        raise SvgfError(
            f"Got {out} as the output; wanted a folder, for example {out.parent / 'denoised'}. "
            "The files in it get the names of the inputs."
        )
    before, part = warmup or 0, part_name(files, warmup)
    if hold and files and files[before][1] is None:
        raise SvgfError(
            f"Frame {files[before][0]} is missing, and there is none before it whose output could be held. "
            "Begin with a frame that is there (--frames), or use --missing reset."
        )
    planned = output_paths(files, out, hold=hold, warmup=before)
    inputs = {os.path.realpath(path) for _, path in files if path is not None}
    for path in planned:
        if path is not None and os.path.realpath(path) in inputs:
            raise SvgfError(f"The output {path} would replace an input. Choose another output folder.")
    stem = _stem(next((path.name for path in planned if path), ""))
    film = out / f"{stem}{f'.{part}' if part else ''}.mp4" if video else None
    state = checkpoint.state_folder(out, part)
    _check_names([*planned, film])
    plan = Plan(out, files, planned, png, film, dict(identity), hold, before, state, tuple(others))
    plan.identity["frames"] = [stamp_frame(plan, index) for index in range(len(files))]
    return plan


def output_paths(files: Files, out: Path, *, hold: bool, warmup: int = 0) -> tuple[Path | None, ...]:
    """The file that each frame of a run is written to; None for a missing one that is not held, and for the first `warmup`."""
    names = [None] * warmup + _output_names(files, hold=hold)[warmup:]
    return tuple(None if name is None else out / name for name in names)


def part_name(files: Files, warmup: int | None) -> str:
    """`101-200`: what the part of a sequence is called of which the first `warmup` files only warm up; "" for None, the whole."""
    return "" if warmup is None else f"{files[warmup][0]}-{files[-1][0]}"


@contextlib.contextmanager
def locked(plan: Plan) -> Generator[Callable[[], None]]:
    """Hold the output folder, made if need be; gives what `checkpoint.lock` gives.

    Where the run fails before its first output, leave no trace of it: of the folders, those that it made. Where the folder was
    removed meanwhile, whatever is there is another's; it is left alone, and said in place of other errors.
    """
    new_state = not is_there(plan.state)
    made = _make(plan.out)
    with checkpoint.lock(plan.state) as still:
        try:
            yield still
        except BaseException as error:
            try:
                still()
            except SvgfError as gone:
                if isinstance(error, SvgfError):
                    raise gone from error
                raise error from error.__cause__
            if new_state and not (is_there(plan.state / "run.json") and any(map(is_there, written(plan)))):
                checkpoint.remove_state(plan.state)
            with contextlib.suppress(OSError):  # not empty
                if made is not None and os.path.samestat(made, plan.out.stat()):
                    plan.out.rmdir()
            raise


def begin(plan: Plan, *, resume: bool, overwrite: bool) -> Checkpoint | None:
    """`find_start`, and the folder made ready: to be called with the output folder locked.

    Records the run in the folder and removes temporary files that a killed one left.
    """
    start = find_start(plan, resume=resume, overwrite=overwrite)
    if start is not None:
        try:
            if start.next_index == 0:
                checkpoint.remove_checkpoint(plan.state)
                checkpoint.remove_figures(plan.state)
            _remove_temporary(plan)
        except OSError as error:
            raise checkpoint.unwritable(plan.out, error) from error
        checkpoint.save_run(plan.state, plan.identity, complete=False)
    return start


def check_there(plan: Plan, frames: int | None = None, *, ending: bool = False) -> None:
    """Raise SvgfError where outputs of the first `frames` frames (all: None) have vanished, of a run to resume or to end."""
    if gone := [path for path in written(plan, frames) if not is_there(path)]:
        raise SvgfError(
            f"Cannot {'end' if ending else 'resume'} the run in {plan.out}: {_list(gone)}, written before, "
            f"{'is' if len(gone) == 1 else 'are'} gone. Start again with --overwrite."
        )


def find_start(plan: Plan, *, resume: bool, overwrite: bool) -> Checkpoint | None:
    """Where to start, None if the run is complete already. Writes nothing.

    Raises SvgfError: outputs exist and neither option is given, the run to resume computed something else or has lost its
    outputs.
    """
    if resume and overwrite:
        raise SvgfError("Got both resume and overwrite: one continues a run, the other starts it again. Choose one.")
    if folders := [path for path in written(plan) if os.path.isdir(path)]:
        raise SvgfError(
            f"{_list(folders)} in {plan.out}: a folder in the place of an output; remove it, or choose another."
        )
    return _resume(plan) if resume else _start(plan, overwrite=overwrite)


def check_writable(out: Path) -> None:
    """Raise SvgfError where the folder `out` could not be made or written into. Writes nothing."""
    there = next(path for path in (out, *out.absolute().parents) if is_there(path) or os.path.islink(path))
    if not (os.path.isdir(there) and os.access(there, os.W_OK | os.X_OK)):
        reason = "not writable" if os.path.isdir(there) else "not a folder"
        raise SvgfError(
            f"Cannot write into the output folder {out}: {there} is {reason}. "
            "Wanted a folder that is writable or can be created; try another one."
        )


def written(plan: Plan, frames: int | None = None) -> Iterator[Path]:
    """The files that the first `frames` frames produce (all: None), previews included, the video last."""
    for path in plan.outputs[:frames]:
        if path is not None:
            yield path
            if plan.png:
                yield path.with_suffix(".png")
    if frames is None and plan.video is not None:
        yield plan.video


def is_there(path: Path) -> bool:
    """Whether there is such a file; what may not be looked at counts as there."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:
        return True
    return True


def stamp(path: str | None) -> list[str | int] | None:
    """What tells that an input is still the same file: name, size, time of change. Raises SvgfError."""
    if path is None:
        return None
    try:
        status = os.stat(path)
    except OSError as error:
        raise SvgfError(
            f"{path}: {error.strerror}, though it was there when the sequence was listed. Put it back, then go on with --resume."
        ) from error
    return [Path(path).name, status.st_size, status.st_mtime_ns]


def stamp_frame(plan: Plan, index: int) -> list[Any]:
    """What tells that the inputs of one frame are still the same files: its number, and the stamp of each."""
    return [plan.files[index][0], *(stamp(files[index][1]) for files in (plan.files, *plan.others))]


def _check_names(paths: Iterable[Path | None]) -> None:
    """SvgfError where an output has a longer name than the file system takes, its folder's included."""
    for path in filter(None, paths):
        try:
            check_names(path)
        except OSError as error:
            if error.errno == errno.ENAMETOOLONG:
                name, whole = (len(os.fsencode(text)) for text in (path.name, path.absolute()))
                raise SvgfError(
                    f"{path}: this output's name has {name} bytes, {whole} with its folders; the file system takes no longer "
                    "ones (255, and 4096 with the folders, on most). Choose another output folder, or shorten the inputs' names."
                ) from error


def _make(folder: Path) -> os.stat_result | None:
    """Which folder this made; None where there was one, or none can be: to be told by who writes there."""
    try:
        folder.mkdir(parents=True)
        return folder.stat()
    except OSError:
        return None


def _start(plan: Plan, *, overwrite: bool) -> Checkpoint:
    there = [path for path in written(plan) if is_there(path)]
    if there and not overwrite:
        record = checkpoint.load_run(plan.state)
        hint = "--resume continues the unfinished run, " if record is not None and not record[1] else ""
        raise SvgfError(
            f"{_list(there)} in {plan.out} exist{'s' if len(there) == 1 else ''} already, and nothing is overwritten "
            f"unasked. Choose another output folder, or: {hint}--overwrite replaces them."
        )
    return Checkpoint(0, None)


def _resume(plan: Plan) -> Checkpoint | None:
    record = checkpoint.load_run(plan.state)
    if record is None:  # never begun: a farm's script may always say resume
        return _start(plan, overwrite=False)
    saved, complete = record
    if complete:
        checkpoint.check_same(plan.state, saved, plan.identity, used=len(saved["frames"]))
        if len(saved["frames"]) != len(plan.files):
            raise SvgfError(
                f"The run in {plan.out} is complete with {len(saved['frames'])} frames; the input has now "
                f"{len(plan.files)}. Use --overwrite, or another output folder, to denoise them all."
            )
        check_there(plan)
        return None
    start = checkpoint.load_checkpoint(plan.state, plan.identity)
    checkpoint.check_same(plan.state, saved, plan.identity, used=0)
    if start is None:
        return Checkpoint(0, None)
    check_there(plan, start.next_index)
    return start


def _remove_temporary(plan: Plan) -> None:
    """Remove what a killed run was writing: `.NAME.*.tmp` for the names of this plan, and nothing else."""
    names = {short(path.name) for path in written(plan)}
    for path in plan.out.glob(".*.tmp"):
        if path.name[1:].rsplit(".", 2)[0] in names:
            path.unlink(missing_ok=True)


def _output_names(files: Files, *, hold: bool) -> list[str | None]:
    """The inputs' own names; for a missing frame the name before it with its number put in."""
    names: list[str | None] = []
    latest, latest_number = "", 0
    for number, path in files:
        if path is not None:
            latest, latest_number = Path(path).stem + ".exr", number
            names.append(latest)
        elif hold:
            digits = [digits for digits in re.findall(r"\d+", latest) if int(digits) == abs(latest_number)][-1]
            head, tail = latest.rsplit(digits, 1)
            names.append(f"{head}{number:0{len(digits)}d}{tail}")
        else:
            names.append(None)
    return names


def _stem(name: str) -> str:
    """`shot.0001.exr` -> `shot`; `denoised` for a name that is nothing but a number."""
    return re.sub(r"[._-]*-?\d+$", "", Path(name).stem) or "denoised"


def _list(paths: list[Path]) -> str:
    """At most three names."""
    names = ", ".join(path.name for path in paths[:3])
    return names if len(paths) <= 3 else f"{names} and {len(paths) - 3} more"
