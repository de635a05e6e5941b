"""What a run keeps in its output folder so that it can be resumed: a lock, its identity, the history. No JAX.

All of it lies in the *state folder* `OUT/.svgf-jax/`: `lock` (held by the operating system for as long as the process
lives), `run.json` (what is being computed: parameters, inputs, options), `checkpoint.npz` (the history after so many
frames) and `frames.jsonl` (a line for each frame that was done: its time, repairs, mean history length). The two in the
middle are replaced atomically, the last grows. They carry data only; nothing in them is ever executed.

Several parts of one sequence may be written into one folder at a time: each has a state folder of its own in that one,
`OUT/.svgf-jax/101-200/`.
"""

import contextlib
import errno
import json
import math
import os
import socket
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TextIO

import numpy as np

from svgf_jax import atomic
from svgf_jax.npz import read_arrays
from svgf_jax.regular import require_regular
from svgf_jax.types import History, SvgfError, TaaHistory

FOLDER = ".svgf-jax"
FORMAT = 1  # of the files in FOLDER
_ALWAYS = set(History._fields) - {"effective_history", "taa"}
_MOST_TEXT = 2**28  # bytes; a million frames have less

Identity = dict[str, Any]
"""JSON: whatever two runs must share to be the same run; its "frames" lists the inputs in order."""


class Busy(SvgfError):
    """Another run holds the folder."""


class Checkpoint(NamedTuple):
    """The state between two frames: the next frame's index, and the history (None = no past) as NumPy arrays."""

    next_index: int
    history: History | None


def state_folder(out: Path, part: str = "") -> Path:
    """Where the state of a run into `out` is kept, or that of one part of it, called `101-200`."""
    return out / FOLDER / part


@contextmanager
def lock(state: Path) -> Generator[Callable[[], None]]:
    """Hold a state folder, creating it, so that no second run writes there; `SvgfError` if one does.

    Parts keep a run of the whole out, and it them, but not each other. The lock dies with its process, however that ends.
    Where the file system has no locks, it is silently no protection. Gives a function that raises `SvgfError` once the
    folder was removed: another run may have it since.
    """
    with _held(state.parent, shared=True) if state.name != FOLDER else contextlib.nullcontext(), _held(state) as still:
        yield still


def is_held(state: Path) -> bool:
    """Whether a run holds a state folder now. Makes no file."""
    try:
        require_regular(state / "lock")
        file = open(state / "lock")  # noqa: SIM115 (closed below)
    except OSError:
        return False
    with file:
        return not _try_lock(file, shared=True)


def holder(state: Path) -> str:
    """`process 12 on node3`: who holds a state folder, or held it last; "" if nobody ever did."""
    try:
        return _text(state / "lock").strip()
    except (OSError, ValueError):
        return ""


@contextmanager
def _held(state: Path, *, shared: bool = False) -> Generator[Callable[[], None]]:
    path = state / "lock"
    try:
        file = _locked(path, shared=shared)
    except OSError as error:
        raise unwritable(_folder(state), error) from error
    with file:
        known = _is(file, path)

        def still() -> None:
            if known and not _is(file, path):
                raise SvgfError(
                    f"{path} is gone: the output folder was removed while this run wrote into it, and another run may be "
                    "writing there now. Start this one again, with --resume or into another folder."
                )

        if not shared:
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
            file.flush()
        yield still


def _locked(path: Path, *, shared: bool) -> TextIO:
    """The lock file, open and locked, its folder made. A run that failed may remove it in between: then again."""
    for kept in (path.parent, path, path.parent / "frames.jsonl"):
        if kept.is_symlink():
            raise SvgfError(f"{kept} is a symbolic link; nothing is written through it. Remove it.")
    for _ in range(10):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            require_regular(path)
        file = open(path, "a+")  # noqa: SIM115 (open for as long as the lock is held)
        if not _try_lock(file, shared=shared):
            with file:
                file.seek(0)
                other = file.read().strip() or "parts of the sequence"
            raise Busy(
                f"Another run is writing into {_folder(path.parent)} ({other}). "
                "Wait for it to end, or choose another output folder."
            )
        if _is(file, path):
            return file
        file.close()
    raise OSError(errno.ESTALE, f"{path} does not stay what it is")


def _is(file: TextIO, path: Path) -> bool:
    """Whether an open file is still the one of that name."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    except FileNotFoundError:
        return False
    except OSError:  # not to be told; what comes next says more
        return True


def unwritable(folder: str | Path, error: OSError) -> SvgfError:
    """What is said where an output folder cannot be written into."""
    return SvgfError(
        f"Cannot write into the output folder {folder}: {error.strerror or error}. "
        "Wanted a folder that is writable or can be created; try another one."
    )


def _folder(state: Path) -> str:
    """The output folder of a state folder, for people."""
    return str(state.parent) if state.name == FOLDER else f"{state.parent.parent} (frames {state.name})"


def save_run(state: Path, identity: Identity, *, complete: bool) -> None:
    """Record what is being computed, and whether it is all there."""
    text = json.dumps({"format": FORMAT, "complete": complete, "identity": identity}, indent=1)
    _replace(state / "run.json", lambda file: file.write(text.encode()))


def load_run(state: Path) -> tuple[Identity, bool] | None:
    """(identity, complete) of the run recorded in `state`; None if there is no record."""
    path = state / "run.json"
    try:
        record = json.loads(_text(path))
        if not isinstance(record, dict) or record["format"] != FORMAT:
            raise ValueError(f"wanted a record of format {FORMAT}")
        if not isinstance(record["identity"]["frames"], list) or not isinstance(record["complete"], bool):
            raise ValueError("incomplete")
        return record["identity"], record["complete"]
    except FileNotFoundError:
        return None
    except Exception as error:  # a damaged file may raise anything
        raise _unusable(path, error) from error


def save_checkpoint(state: Path, identity: Identity, checkpoint: Checkpoint) -> None:
    """Replace the checkpoint. Only to be called when every output before `next_index` is on disk."""
    arrays = {} if checkpoint.history is None else _flat(checkpoint.history)
    entries: dict[str, Any] = {
        **{name: np.asarray(array) for name, array in arrays.items()},
        "format": np.asarray(FORMAT),
        "next_index": np.asarray(checkpoint.next_index),
        "identity": np.frombuffer(json.dumps(identity).encode(), np.uint8),
    }
    _replace(state / "checkpoint.npz", lambda file: np.savez(file, **entries))


def load_checkpoint(state: Path, identity: Identity) -> Checkpoint | None:
    """The checkpoint, None if there is none; `SvgfError` if it is damaged or belongs to another computation.

    The inputs still to come may differ from what they were (a frame repaired, frames added); those used may not.
    """
    path = state / "checkpoint.npz"
    try:
        entries = read_arrays(path)
        if (found := _whole(entries, "format")) != FORMAT:
            raise ValueError(f"format {found}, wanted {FORMAT}")
        next_index = _whole(entries, "next_index")
        saved = json.loads(entries["identity"].tobytes().decode())
        history = _unflat(entries)
        if not isinstance(saved["frames"], list) or not 0 <= next_index <= len(saved["frames"]):
            raise ValueError("incomplete")
    except FileNotFoundError:
        return None
    except Exception as error:  # a damaged file may raise anything
        raise _unusable(path, error) from error
    check_same(state, saved, identity, used=next_index)
    return Checkpoint(next_index, history)


def _flat(history: History) -> dict[str, Any]:
    """The history's arrays by name, those of anti-aliasing as `taa.NAME`; what is None has none."""
    taa = {} if history.taa is None else history.taa._asdict()
    named = history._asdict() | {"taa": None} | {f"taa.{name}": array for name, array in taa.items()}
    return {name: array for name, array in named.items() if array is not None}


def _unflat(entries: dict[str, Any]) -> History | None:
    """The inverse of `_flat`, None where there is no history; ValueError where it is no history that a filter leaves."""
    taa = {name: entries[f"taa.{name}"] for name in TaaHistory._fields if f"taa.{name}" in entries}
    arrays = {name: entries[name] for name in History._fields if name in entries and name != "taa"}
    if len(entries) != len(arrays) + len(taa) + 3 or (taa and not arrays):
        raise ValueError(f"it has {', '.join(sorted(entries))}")
    if (arrays and not arrays.keys() >= _ALWAYS) or len(taa) not in (0, len(TaaHistory._fields)):
        raise ValueError("incomplete")
    if not arrays:
        return None
    history = History(**arrays, taa=TaaHistory(**taa) if taa else None)
    _check_arrays(history)
    return history


def _check_arrays(history: History) -> None:
    """ValueError unless all are of one frame, of one dtype, and finite."""
    if history.illumination.ndim != 4 or 0 in history.illumination.shape:
        raise ValueError(f"illumination is {history.illumination.shape}")
    signals, height, width, _ = history.illumination.shape
    shapes = {
        "illumination": (signals, height, width, 3),
        "moments": (signals, height, width, 2),
        "normal": (height, width, 3),
        "effective_history": (signals, height, width),
        "taa.color": (height, width, 3),
        "taa.frames": (),
    }
    real = history.illumination.dtype
    for name, array in _flat(history).items():
        wanted, shape = np.dtype(np.int32) if name == "object_id" else real, shapes.get(name, (height, width))
        if real.type not in (np.float32, np.float64) or array.dtype != wanted or array.shape != shape:
            raise ValueError(f"{name} is {array.dtype} {array.shape}")
        if not np.isfinite(array).all():
            raise ValueError(f"{name} is not finite")
    counts = ("history_length", "effective_history", "taa.frames")
    if any(np.any(array < 0) for name, array in _flat(history).items() if name in counts):
        raise ValueError("a history of fewer than 0 frames")


def _whole(entries: dict[str, Any], name: str) -> int:
    number = entries[name]
    if number.shape != () or number.dtype.kind not in "iu":
        raise ValueError(f"{name} is {number.dtype} {number.shape}")
    return int(number)


def check_same(state: Path, saved: Identity, identity: Identity, *, used: int) -> None:
    """Raise `SvgfError` naming the first difference between two identities, over the first `used` frames."""
    head = f"Cannot resume the run in {_folder(state)}: "
    tail = " Run it as it was begun, or start again with --overwrite (or into another folder)."
    for index in range(used):
        then, now = saved["frames"][index], (identity["frames"][index : index + 1] or [None])[0]
        if then != now:
            raise SvgfError(f"{head}its input frame {index + 1} was {then}, and is {now} now.{tail}")
    for key, then, now in _differences(saved, identity):
        raise SvgfError(f"{head}{key} was {then}, and is {now} now.{tail}")


def append_figures(state: Path, figures: Mapping[str, Any]) -> None:
    """Note what is known of one frame that is done; its "number" says which. Raises SvgfError."""
    path = state / "frames.jsonl"
    try:
        if path.exists():
            require_regular(path)
        with path.open("ab+") as file:
            file.seek(max(file.tell() - 1, 0))
            cut_off = file.read() not in (b"", b"\n")  # by a full disk, or with its process
            file.write(b"\n" * cut_off + json.dumps(dict(figures), default=str).encode() + b"\n")
    except OSError as error:
        raise _not_written(path, error) from error


def load_figures(state: Path) -> dict[int, dict[str, Any]]:
    """What is known of the frames by number, the latest of each; a line that is cut off or damaged counts for nothing."""
    found: dict[int, dict[str, Any]] = {}
    with contextlib.suppress(OSError, ValueError):
        for line in _text(state / "frames.jsonl").splitlines():
            with contextlib.suppress(ValueError, KeyError, RecursionError):
                figures = json.loads(line)
                if _are_figures(figures):
                    found[figures["number"]] = figures
    return found


def _are_figures(line: Any) -> bool:
    """Whether a line is one that a run writes, as far as anybody relies on it."""
    kinds = {
        "number": int,
        "status": str,
        "path": str | None,
        "counts": dict,
        "seconds": float,
        "history": float | None,
    }
    if not isinstance(line, dict) or not all(
        isinstance(line[name], kinds[name]) for name in kinds.keys() & line.keys()
    ):
        return False
    counts = line.get("counts", {}).values()
    numbers = [line[name] for name in ("seconds", "history") if line.get(name) is not None]
    return all(type(count) is int and abs(count) < 2**63 for count in counts) and all(map(math.isfinite, numbers))


def _text(path: Path) -> str:
    """A text file of a state folder, whatever lies there by now. Raises OSError, ValueError."""
    require_regular(path)
    if (size := path.stat().st_size) > _MOST_TEXT:
        raise ValueError(f"{size} bytes")
    return path.read_text(encoding="utf-8")


def remove_figures(state: Path) -> None:
    """Forget them: another run begins."""
    (state / "frames.jsonl").unlink(missing_ok=True)


def remove_checkpoint(state: Path) -> None:
    """Forget the history; the record in run.json stays."""
    (state / "checkpoint.npz").unlink(missing_ok=True)


def remove_state(state: Path) -> None:
    """Remove the state folder of a run that came to nothing. Only for who holds its lock, which goes last."""
    with contextlib.suppress(OSError):
        for path in sorted(state.iterdir(), key=lambda path: path.name == "lock"):
            path.unlink()
        state.rmdir()


def _differences(saved: Any, now: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    """(dotted name, then, now) of every leaf in which two JSON trees differ, frames left out."""
    if isinstance(saved, dict) and isinstance(now, dict):
        for key in sorted(saved.keys() | now.keys()):
            if (name, key) != ("", "frames"):
                yield from _differences(saved.get(key), now.get(key), f"{name}.{key}" if name else key)
    elif saved != now:
        yield name, saved, now


def _unusable(path: Path, error: Exception) -> SvgfError:
    why = f" ({error})" if isinstance(error, ValueError | OSError) else ""  # others speak of Python
    return SvgfError(
        f"Cannot resume from {path}: it is damaged or of another version{why}. "
        "Start again with --overwrite, or into another folder."
    )


def _replace(path: Path, write: Callable[[BinaryIO], Any]) -> None:
    """Write a file under a temporary name and rename it. One name: the folder is locked to other runs."""
    try:
        with atomic.replacing(path, unique=False) as temporary, temporary.open("wb") as file:
            write(file)
    except OSError as error:
        raise _not_written(path, error) from error


def _not_written(path: Path, error: OSError) -> SvgfError:
    return SvgfError(
        f"Could not write {path}: {error.strerror or error}. Is the disk full, or the folder gone or read-only?"
    )


def _try_lock(file: Any, *, shared: bool) -> bool:
    """Take a lock on an open file without waiting: whether it was free. Shared ones go together."""
    try:
        import fcntl
    except ImportError:  # Windows: its file locks would also keep others from reading who holds it
        return True
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True
