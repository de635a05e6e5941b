"""Ordinary files only: opening a named pipe waits for ever. The standard library only; failures stay `OSError`."""

import errno
import os
import stat

_KINDS = {stat.S_IFIFO: "a named pipe", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device"}


def require_regular(path: str | os.PathLike[str]) -> None:
    """Raise `OSError` where `path` is no file, or one that cannot be read from its beginning to its end: a pipe, a device."""
    mode = os.stat(path).st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), "no file")
        raise OSError(errno.EINVAL, f"it is {kind}; wanted a regular file: write it to one first", str(path))
