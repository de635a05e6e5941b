"""Cameras and moving objects from GAMES202's `matrix_<i>.mat`, one file a frame; the same `Cameras` as from a cameras.json.

A file holds an int32 n, then n + 2 row-major float32 4x4 matrices for column vectors, little-endian: object to world for the ids
0 to n - 1, world to camera (z forward), and world to screen in pixels (X / W, Y / W; y down, centres at + 0.5). With V, P and M:

    screen_{i-1} = P_{i-1} V_{i-1} M_{i-1} M_i^{-1} world_i,      P V the world to screen of the file
"""

import os

import numpy as np

from svgf_jax.cameras import Camera, Cameras
from svgf_jax.regular import require_regular
from svgf_jax.sequences import Sequence
from svgf_jax.types import SvgfError

LARGEST_COUNT = 1_000_000  # objects; more is a file that is something else


def load_matrices(sequence: Sequence) -> Cameras:
    """The cameras of a sequence of `.mat` files. Raises SvgfError that names the file and what is wrong with it."""
    frames = {number: _read(path) for number, path in sequence.files if path is not None}
    return Cameras(sequence.name, frames, None, sequence.files)


def _read(path: str) -> Camera:
    try:
        require_regular(path)
        size = os.path.getsize(path)
        with open(path, "rb") as file:
            head = file.read(4)
            count = int.from_bytes(head, "little", signed=True)
            if len(head) < 4 or not 0 <= count <= LARGEST_COUNT or size != 4 + 64 * (count + 2):
                raise SvgfError(
                    f"{path}: {size} bytes that begin with {count if len(head) == 4 else head!r}; wanted an int32 n, then n + 2 "
                    "matrices of 16 float32, 64 n + 132 bytes in all. Copy or export the file again."
                )
            matrices = np.frombuffer(file.read(), "<f4").reshape(count + 2, 4, 4).astype(np.float64)
    except (OSError, ValueError) as error:
        raise SvgfError(f"{path}: cannot be read ({error}).") from error
    names = [*(f"object {i} to world" for i in range(count)), "world to camera", "world to screen"]
    for name, matrix in zip(names, matrices, strict=True):
        _check(matrix, f"{path}: the matrix {name}")
    to_camera, to_screen = matrices[-2:]
    poses = dict(enumerate(matrices[:-2]))
    return Camera(to_camera, to_screen @ np.linalg.inv(to_camera), {}, poses)


def _check(matrix: np.ndarray, what: str) -> None:
    if not np.isfinite(matrix).all():
        raise SvgfError(f"{what} is not finite; wanted 4 x 4 numbers. Export the file again.")
    if what.endswith("screen"):  # its third row, the depth in the buffer, is not used
        good = np.linalg.matrix_rank(matrix[[0, 1, 3]]) == 3
    else:
        try:
            good = np.abs(np.linalg.inv(matrix) @ matrix - np.eye(4)).max() < 1e-3
        except np.linalg.LinAlgError:
            good = False
    if not good:
        raise SvgfError(f"{what} cannot be inverted: it leads nowhere, or only to a plane. Export the file again.")
