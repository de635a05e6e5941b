"""Files of results that commands write: complete or not at all, and asked for before the work."""

import os
from collections.abc import Iterable
from pathlib import Path

from svgf_jax import atomic
from svgf_jax.types import SvgfError


def require_writable(paths: Iterable[Path | None], *, overwrite: bool) -> None:
    """Raise SvgfError where a file exists and may not be replaced, or could not be written; None is no file.

    Folders that are missing will be made: then the nearest one above must be writable.
    """
    for path in paths:
        if path is None:
            continue
        if os.path.exists(path) and not overwrite:
            raise SvgfError(f"{path} exists already; choose another name, or --overwrite.")
        folder = next(above for above in path.absolute().parents if os.path.exists(above))
        try:
            atomic.check_names(path)
            atomic.require_writable(path if os.path.exists(path.parent) else folder / path.name)
        except OSError as error:
            raise _not_written(path, error) from error


def save(path: Path, text: str) -> None:
    """Write a file, and the folders for it; or raise SvgfError and leave it as it was."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic.write_text(path, text)
    except OSError as error:
        raise _not_written(path, error) from error


def _not_written(path: Path, error: OSError) -> SvgfError:
    why = error.strerror or error
    return SvgfError(f"Could not write {path}: {why}. Choose a folder that is writable and a name that it takes.")
