"""What JAX compiled is kept from one command to the next, so that the next begins filtering in half the time.

JAX itself keeps and finds it (its persistent compilation cache), by what is computed, with which versions, on which processor. Here
commands tell it where, before they import it: where the user's caches are. JAX_COMPILATION_CACHE_DIR names another folder, and
JAX_ENABLE_COMPILATION_CACHE=false keeps nothing. `import svgf_jax` alone leaves all this to the program that it is in.
"""

import os
import stat
import warnings
from contextlib import suppress
from pathlib import Path
from typing import TextIO

import platformdirs

VARIABLE = "JAX_COMPILATION_CACHE_DIR"
LIMIT = 2**28
"""Bytes beyond which all is given up, to be compiled again: some five hundred programs."""


def keep() -> None:
    """For a program, at its start: keep what JAX compiles, unless the environment says where or the folder is another's."""
    # Else XLA takes what its compiler prefers with AVX-512 for an instruction that the processor lacks, and tells a page of it each
    # time that a program is found. What really fails is raised.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    folder = platformdirs.user_cache_path("svgf_jax", appauthor=False) / "compiled"
    if VARIABLE in os.environ or not folder.is_absolute() or not _ours(folder):  # without a home it is relative
        return
    if sum(_sizes(folder)) > LIMIT:
        empty(folder)
    os.environ[VARIABLE] = str(folder)
    show = warnings.showwarning

    def showwarning(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if "persistent compilation cache" in str(message):  # cut off by a full disk, or may not be written
            empty(folder)
        else:
            show(message, category, filename, lineno, file, line)

    warnings.showwarning = showwarning


def empty(folder: Path) -> None:
    """Remove what is kept there, as far as may be."""
    for entry in folder.glob("*-cache"):
        with suppress(OSError):
            entry.unlink()


def _ours(folder: Path) -> bool:
    """Whether it is the user's own, for what is found is run; closed, and emptied, where others could have put something there."""
    for place in (folder.parent, folder):
        try:
            found = place.stat()
            if not hasattr(os, "geteuid"):
                continue
            if found.st_uid != os.geteuid():
                return False
            if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):  # JAX made it under a umask that is so
                place.chmod(stat.S_IRWXU)
                empty(folder)
        except FileNotFoundError:  # JAX makes it
            continue
        except OSError:
            return False
    return True


def _sizes(folder: Path) -> list[int]:
    sizes: list[int] = []
    for entry in folder.glob("*"):
        with suppress(OSError):  # another command removed it
            sizes.append(entry.stat().st_size)
    return sizes
