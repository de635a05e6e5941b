"""Memory: shared with JAX rather than copied, and given back where the C library can be told to (Linux with glibc).

Of an array that does not begin at a multiple of 64 bytes JAX on CPUs makes a copy, and keeps both for as long as it needs one.
NumPy's large arrays never do.

Frames are freed by other threads than those that made them; unless told, glibc keeps what they took, up to 32 MB a block, for the
thread that had it: at 1920x1080 a gigabyte of nothing.
"""

import ctypes
import math
from collections.abc import Iterable
from typing import Any

import numpy as np

_ALIGNMENT = 64
_LARGE = 2**20
_M_MMAP_THRESHOLD = -3  # malloc.h


def zeros(shape: Iterable[int], dtype: Any = np.float32) -> np.ndarray:
    """As `np.zeros`, where JAX on CPUs takes it as it is. Pages that nobody writes to take no memory."""
    shape, dtype = tuple(shape), np.dtype(dtype)
    size = math.prod(shape) * dtype.itemsize
    room = np.zeros(size + _ALIGNMENT, np.uint8)
    start = -room.ctypes.data % _ALIGNMENT
    return room[start : start + size].view(dtype).reshape(shape)


def aligned(arrays: list[Any]) -> list[Any]:
    """The same arrays (or None) where JAX on CPUs takes them as they are. Empties the list: one is there twice at a time."""
    return [_aligned(arrays.pop(0)) for _ in range(len(arrays))]


def _aligned(array: Any) -> Any:
    if array is None or (array.ctypes.data % _ALIGNMENT == 0 and array.flags.c_contiguous):
        return array
    moved = zeros(array.shape, array.dtype)
    moved[...] = array
    return moved


def give_back_large() -> None:
    """From now on, in this process, blocks of a megabyte and more go back to the system when they are freed."""
    _call("mallopt", _M_MMAP_THRESHOLD, _LARGE)


def give_back() -> None:
    """Return to the system what is free now: after compiling, some hundred megabytes."""
    _call("malloc_trim", 0)


def _call(name: str, *arguments: int) -> None:
    try:
        function: Any = getattr(ctypes.CDLL(None), name)
    except (AttributeError, OSError, TypeError):  # another C library, another system
        return
    function(*arguments)
