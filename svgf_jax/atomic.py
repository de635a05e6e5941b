"""Files that are complete under their name or not there at all. The standard library only; failures stay `OSError`."""

import contextlib
import errno
import os
import uuid
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str], *, unique: bool = True) -> Iterator[Path]:
    """An empty file in the folder of `path` to write into; it is flushed to the disk and renamed to `path` at the end.

    Its name is `.NAME.*.tmp`; whatever is raised inside removes it and leaves `path` as it was. `unique=False` names it
    `.NAME.tmp`, so that what a killed process left is written over, where only one process writes at a time. A missing
    folder or permission is an `OSError` before anything is written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp" if unique else f".{path.name}.tmp")
    try:
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
    probe = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    probe.touch(exist_ok=False)
    probe.unlink()
