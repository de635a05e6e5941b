"""Arrays from a file that may be damaged, or made to do harm: all of them, or one error."""

import math
import os
import zipfile
from pathlib import Path
from typing import BinaryIO

import numpy as np

from svgf_jax.regular import require_regular


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of what `np.savez` wrote: never executed, and never larger than the file.

    Raises FileNotFoundError; ValueError, whatever a damaged zip makes of itself (encrypted, a method nobody knows, ...).
    """
    try:
        require_regular(path)
        with path.open("rb") as file:
            _check_sizes(file)
            with np.load(file, allow_pickle=False) as stored:
                return {name: stored[name] for name in stored.files}
    except FileNotFoundError:
        raise
    except Exception as error:
        told = isinstance(error, ValueError | OSError | zipfile.BadZipFile) and str(error)
        raise ValueError(told or "not whole arrays in a zip file") from error


def _check_sizes(raw: BinaryIO) -> None:
    """ValueError where entries would take more memory than the file has bytes: they are never compressed."""
    with zipfile.ZipFile(raw) as archive:
        entries = archive.infolist()
        if sum(entry.file_size for entry in entries) > os.fstat(raw.fileno()).st_size:
            raise ValueError("its entries are larger than the file")
        for entry in entries:
            with archive.open(entry) as file:
                if np.lib.format.read_magic(file) != (1, 0):
                    raise ValueError(f"{entry.filename} is of another version of .npy")
                shape, _, dtype = np.lib.format.read_array_header_1_0(file)
                if math.prod(shape) * dtype.itemsize != entry.file_size - file.tell():
                    raise ValueError(f"{entry.filename} is {dtype} {shape}, and of {entry.file_size} bytes")
    raw.seek(0)
