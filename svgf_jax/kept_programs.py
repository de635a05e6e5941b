"""What JAX compiled is kept from one command to the next, so that the next begins filtering in half the time.

JAX itself keeps and finds it (its persistent compilation cache), by what is computed, with which versions, on which processor. Here
commands tell it where, before they import it: where the user's caches are. JAX_COMPILATION_CACHE_DIR names another folder, and
JAX_ENABLE_COMPILATION_CACHE=false keeps nothing. `import svgf_jax` alone leaves all this to the program that it is in.
"""

import os
import re
import shutil
import stat
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

import platformdirs

VARIABLE = "JAX_COMPILATION_CACHE_DIR"
LIMIT = 2**28
"""Bytes beyond which all is given up, to be compiled again: some five hundred programs."""


def keep() -> None:
    """For a program, at its start: keep what JAX compiles, unless the environment says where or the folder is not safe."""
    place = platformdirs.user_cache_path("svgf_jax", appauthor=False)
    if VARIABLE in os.environ or not place.is_absolute() or not _closed(place):  # without a home it is relative
        return
    if sum(_sizes(place)) > LIMIT:
        with suppress(OSError):  # another command does the same
            _empty(place)
    folder = place / f"for-{_cores()}-cores"  # by which XLA divides the work; JAX does not look at it
    os.environ[VARIABLE] = str(folder)
    # XLA takes what its compiler prefers on some processors for instructions that they lack, and says so at length of each program
    # that it finds (openxla/xla#44565), and uses it.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    _mend(folder)


def _mend(folder: Path) -> None:
    """Where JAX warns that a program cannot be read or written, remove what it leaves, and say nothing: it compiles."""
    told = r"Error (?:reading|writing) persistent compilation cache entry"
    show: Any = warnings.showwarning

    def showwarning(message: Warning | str, *about: Any) -> None:
        if not re.match(told, str(message)):
            show(message, *about)
            return
        name = re.search(r"'([\w.-]+)'", str(message))
        for entry in folder.glob(f"{name[1] if name else '*'}-*-cache"):
            with suppress(OSError):
                entry.unlink()

    warnings.showwarning = showwarning
    warnings.filterwarnings("always", message=told)


def _closed(place: Path) -> bool:
    """Make the folder, if need be, and close it to others: what is found there is run. False where that cannot be had.

    Where others could write to it, it is emptied too.
    """
    try:
        place.mkdir(mode=stat.S_IRWXU, parents=True, exist_ok=True)
        found = place.stat()
        if hasattr(os, "geteuid"):
            if found.st_uid != os.geteuid():
                return False
            if found.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
                place.chmod(stat.S_IRWXU)
            if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
                _empty(place)
                return not any(place.iterdir())
    except OSError:
        return False
    return True


def _empty(place: Path) -> None:
    for entry in place.iterdir():
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry, ignore_errors=True)
        else:
            entry.unlink()


def _sizes(place: Path) -> list[int]:
    sizes: list[int] = []
    for entry in place.rglob("*"):
        with suppress(OSError):  # another command removed it
            sizes.append(entry.lstat().st_size if entry.is_file() else 0)
    return sizes


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
