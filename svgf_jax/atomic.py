"""Files that are complete under their name or not there at all. The standard library only; failures stay `OSError`."""

import contextlib
import errno
import hashlib
import os
import uuid
from collections.abc import Generator
from pathlib import Path

_LONGEST = 128  # bytes, and 14 more around them


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str], *, unique: bool = True) -> Generator[Path]:
    """An empty file in the folder of `path` to write into; it is flushed to the disk and renamed to `path` at the end.

    Its name is `.NAME.*.tmp` (of a long NAME only a part: `short`); whatever is raised inside removes it and leaves `path`
    as it was. `unique=False` names it `.NAME.tmp`, so that what a killed process left is written over, where only one
    process writes at a time. A missing folder or permission, or too long a name, is an `OSError` before anything is written.
    """
    path = Path(path)
    temporary = _temporary(path) if unique else path.with_name(f".{short(path.name)}.tmp")
    try:
        check_names(path)  # its own is only given when all has been written
        if not unique:
            temporary.unlink(missing_ok=True)
        temporary.touch(exist_ok=False)  # follows no link that somebody put there
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
        _flush_folder(path.parent)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _flush_folder(folder: Path) -> None:
    """The new name to the disk too, where a system lets folders be flushed: after a power cut, what came first is there first."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write `text` as UTF-8, as `replacing` does."""
    with replacing(path) as temporary:
        temporary.write_bytes(text.encode())


def require_writable(path: str | os.PathLike[str]) -> None:
    """Raise `OSError` where `replacing(path)` could not work, so that a long job finds out before it starts."""
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    check_names(path)
    probe = _temporary(path)
    probe.touch(exist_ok=False)
    probe.unlink()


def short(name: str) -> str:
    """What stands for a file's name in that of a temporary one: itself, or of a long one the start and a hash.

    So whatever a file system takes as a name has a temporary one too. File systems take 255 bytes, some that encrypt 143.
    """
    raw = os.fsencode(name)
    if len(raw) <= _LONGEST:
        return name
    return f"{raw[: _LONGEST - 17].decode(errors='ignore')}~{hashlib.sha256(raw).hexdigest()[:16]}"


def _temporary(path: Path) -> Path:
    return path.with_name(f".{short(path.name)}.{uuid.uuid4().hex[:8]}.tmp")


def check_names(path: Path) -> None:
    """Raise `OSError` where there can't be such a name, or such folders above it as are still to be made."""
    path = path.absolute()
    there = next(above for above in path.parents if os.path.exists(above))
    for place in (path, *(there / name for name in path.relative_to(there).parts)):
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            os.lstat(place)
