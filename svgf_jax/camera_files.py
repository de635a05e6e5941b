"""Cameras from elsewhere than a cameras.json: headers of the frames (pbrt-v4), and a C header (BMFR's data).

pbrt-v4 stores `worldToCamera` (x right, y up, z forward) and `worldToNDC`: X / W and Y / W of it are 0.5 + 0.5 s, where s goes
from -a to a along the longer side of the picture, a its aspect ratio, and from -1 to 1 along the shorter one, y up
(source: pbrt-v4's cameras.cpp and film.cpp). BMFR's `camera_matrices.h` has one matrix M a frame for row vectors,
(x, y, z, w) = P M, and u = (x / w + 1) / 2 of the width, likewise y downwards (source: bmfr.cl).
"""

import os
import re
from collections.abc import Iterable

import numpy as np

from svgf_jax import exr
from svgf_jax.cameras import Camera, Cameras, find_camera, load_cameras
from svgf_jax.exr_layout import PathName
from svgf_jax.matrices import load_matrices
from svgf_jax.regular import require_regular
from svgf_jax.sequences import Sequence, beside, companion
from svgf_jax.types import SvgfError

_FLIP = np.diag([1.0, -1.0, 1.0, 1.0])


def find_cameras(
    wanted: PathName | None, sequence: Sequence, header: exr.Header, first: str, *, elsewhere: str = ""
) -> Cameras | None:
    """The cameras of a sequence, if there are any.

    Args:
        wanted: a cameras.json or a pattern of `.mat` files; "auto" takes those beside the frames, None none.
        sequence: the frames.
        header, first: of the first frame, and its path.
        elsewhere: where the renderer has them: "header", or the name of a C header beside the frames.

    Raises SvgfError: unreadable, not of these frames, of another size.
    """
    if wanted is None:
        return None
    path = os.path.join(os.path.dirname(first), "cameras.json") if wanted == "auto" else os.fspath(wanted)
    if wanted == "auto" and not os.path.isfile(path):
        path = beside(sequence, "matrix", extension=".mat") or elsewhere
        if path == "header":
            return cameras_of_headers(sequence)
        path = path if path.endswith(".mat") else os.path.join(os.path.dirname(first), path)
        if not path.endswith(".mat") and not os.path.isfile(path):
            return None
    left, top, right, bottom = header.display_window
    size = (right - left + 1, bottom - top + 1)
    try:
        if path.endswith(".mat"):
            cameras = load_matrices(companion(sequence, path))
        elif path.endswith(".h"):
            cameras = cameras_of_c_header(path, [number for number, file in sequence.files if file is not None], size)
        else:
            cameras = load_cameras(path)
        for number, file in sequence.files:
            if file is not None:
                find_camera(cameras, number)
    except SvgfError as error:
        raise SvgfError(f"{error} To go on without it: --cameras none (cameras=None).") from error
    if cameras.size not in (None, size):
        raise SvgfError(
            f"{path}: cameras for pictures of {cameras.size}, but {first} shows {size}. "
            "Wanted the same size; to go on without it: --cameras none (cameras=None)."
        )
    return cameras


def cameras_of_headers(sequence: Sequence) -> Cameras | None:
    """The cameras in the headers of a sequence's files; None if the first has none. Raises SvgfError."""
    frames = {}
    for number, path in sequence.files:
        if path is None:
            continue
        header = exr.read_header(path)
        to_camera, to_ndc = (np.asarray(header.attributes.get(key, 0.0)) for key in ("worldToCamera", "worldToNDC"))
        if not to_camera.shape == to_ndc.shape == (4, 4):
            if not frames:
                return None
            raise SvgfError(f"{path}: no worldToCamera and worldToNDC in the header, as the frames before have.")
        left, top, right, bottom = header.display_window
        frames[number] = _of_pbrt(to_camera.astype(float), to_ndc.astype(float), right - left + 1, bottom - top + 1)
    return Cameras(sequence.name, frames, None, sequence.files) if frames else None


def _of_pbrt(to_camera: np.ndarray, to_ndc: np.ndarray, width: int, height: int) -> Camera:
    if not np.allclose(to_camera[3, :3], 0):  # written for row vectors
        to_camera, to_ndc = to_camera.T, to_ndc.T
    aspect = width / height
    half = np.array([max(aspect, 1.0), max(1 / aspect, 1.0)])
    to_screen = np.eye(4)  # NDC -> pixels: x = (2 (ndc - 0.5) / half + 1) / 2 * size, and y from the top
    for axis, (size, sign) in enumerate(((width, 1), (height, -1))):
        to_screen[axis, axis] = sign * size / half[axis]
        to_screen[axis, 3] = size * (0.5 - sign * 0.5 / half[axis])
    mine = _FLIP @ to_camera
    return Camera(mine, to_screen @ to_ndc @ np.linalg.inv(mine), {}, {})


def cameras_of_c_header(path: str, numbers: Iterable[int], size: tuple[int, int]) -> Cameras:
    """The cameras of a `camera_matrices.h`, the matrix at index i for frame i; pictures of `size` (width, height).

    Raises SvgfError: unreadable, no matrices, fewer than frames.
    """
    try:
        require_regular(path)
        with open(path, encoding="utf-8", errors="replace") as file:
            text = re.sub(r"//.*|/\*[\s\S]*?\*/", "", file.read())
    except OSError as error:
        raise SvgfError(f"{path}: cannot be read ({error.strerror or error}).") from error
    found = re.search(r"camera_matrices\s*(?:\[[^\]]*\]\s*)*=\s*([^;]*);", text)
    values = [float(one) for one in re.findall(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", found[1])] if found else []
    if not values or len(values) % 16:
        raise SvgfError(
            f"{path}: {len(values)} numbers for camera_matrices; wanted camera_matrices[n][4][4] = {{...}}, 16 numbers a frame."
        )
    matrices = np.array(values).reshape(-1, 4, 4)
    frames = {}
    for number in numbers:
        if not 0 <= number < len(matrices):
            raise SvgfError(f"{path}: no camera for frame {number}; it has frames 0 to {len(matrices) - 1}.")
        frames[number] = camera_of_projection(matrices[number].T, size)
    return Cameras(path, frames, None)


def camera_of_projection(clip: np.ndarray, size: tuple[int, int]) -> Camera:
    """The camera of a perspective matrix `[4, 4]` for column vectors, whose x / w and y / w are -1 to 1 of the picture, y down.

    w is taken to be z along the viewing axis, up to a factor. The eye is where x, y and w are 0.
    """
    rows = clip[[0, 1, 3]].astype(np.float64)
    rows = rows / np.linalg.norm(rows[2, :3])
    eye = np.linalg.solve(rows[:, :3], -rows[:, 3])
    forward = rows[2, :3]
    right = rows[0, :3] - (rows[0, :3] @ forward) * forward
    right /= np.linalg.norm(right)
    to_camera = np.eye(4)
    to_camera[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    to_camera[:3, 3] = -to_camera[:3, :3] @ eye
    pixels = np.array([[size[0] / 2, 0, size[0] / 2], [0, size[1] / 2, size[1] / 2], [0, 0, 1]]) @ rows
    return Camera(to_camera, np.insert(pixels, 2, [0, 0, 0, 1], axis=0) @ np.linalg.inv(to_camera), {}, {})
