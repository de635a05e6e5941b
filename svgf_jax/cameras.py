"""Cameras and moving objects of a sequence: where each surface point was one frame ago, exactly.

`cameras.json` holds, for each frame, row-major 4x4 matrices for column vectors:

    {"width": 480, "height": 270,
     "per_frame": [{"frame": 0,
                    "world_to_camera": [[...] * 4] * 4,     x right, y down, z forward
                    "camera_to_screen": ...,                pixel = (X / W, Y / W), y down, centres at + 0.5
                    "object_motion": {"7": ...}}, ...]}     by object id, world at this frame -> at the one before

Also understood: `world_to_screen` in place of `camera_to_screen`, and `object_to_world` by id in place of
`object_motion`. Objects that are not listed stand still. Arithmetic is in float64.
"""

import json
import os
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from svgf_jax.exr_layout import PathName
from svgf_jax.regular import require_regular
from svgf_jax.types import SvgfError

BEHIND = -1e4
"""Previous pixel coordinate given to points that were behind the previous camera: far outside any image."""


APART = 0.1
"""Pixels by which a camera may show a position beside its pixel's centre without being told of."""


class Camera(NamedTuple):
    """One frame's camera and objects; matrices `[4, 4]` float64, objects by id."""

    world_to_camera: np.ndarray
    camera_to_screen: np.ndarray
    object_motion: dict[int, np.ndarray]
    object_to_world: dict[int, np.ndarray]


class Cameras(NamedTuple):
    """A sequence's cameras by frame number.

    Attributes:
        path: the file, or the pattern of the files.
        frames: camera by frame number.
        size: (width, height) of the picture, if the file says it.
        files: frame number and file of each frame, where each has its own; None where it is missing.
    """

    path: str
    frames: dict[int, Camera]
    size: tuple[int, int] | None
    files: tuple[tuple[int, str | None], ...] = ()


def load_cameras(path: PathName) -> Cameras:
    """Read a cameras.json. Raises SvgfError that names the file and the entry that is wrong."""
    name = os.fspath(path)
    try:
        require_regular(name)
        with open(name, encoding="utf-8") as file:
            data = json.load(file)
    except OSError as error:
        raise SvgfError(f"{name}: cannot be read ({error.strerror or error}).") from error
    except (ValueError, RecursionError) as error:
        raise SvgfError(f"{name}: not valid JSON ({error}).") from error
    entries = data.get("per_frame") if isinstance(data, dict) else None
    if not isinstance(entries, list) or not entries:
        raise SvgfError(f'{name}: no list "per_frame" of cameras; wanted {{"per_frame": [{{"frame": 0, ...}}, ...]}}.')
    frames = {}
    for at, entry in enumerate(entries):
        number = entry.get("frame") if isinstance(entry, dict) else None
        if not isinstance(number, int) or number in frames:
            raise SvgfError(f'{name}: per_frame[{at}] has "frame": {number!r}; wanted a frame number, each only once.')
        frames[number] = parse_camera(entry, f"{name}: frame {number}")
    width, height = data.get("width"), data.get("height")
    return Cameras(name, frames, (width, height) if isinstance(width, int) and isinstance(height, int) else None)


def parse_camera(entry: Mapping[str, Any], where: str) -> Camera:
    """The camera of one entry of `per_frame` above, matrices as lists or arrays. Raises SvgfError that begins with `where`."""
    to_camera = _matrix(entry.get("world_to_camera"), f'{where}: "world_to_camera"')
    if "camera_to_screen" in entry:
        to_screen = _matrix(entry["camera_to_screen"], f'{where}: "camera_to_screen"')
    else:
        whole = _matrix(entry.get("world_to_screen"), f'{where}: "camera_to_screen" (or "world_to_screen")')
        to_screen = whole @ np.linalg.inv(to_camera)
    return Camera(to_camera, to_screen, *(_by_id(entry, key, where) for key in ("object_motion", "object_to_world")))


def find_camera(cameras: Cameras, number: int) -> Camera:
    """The camera of a frame. Raises SvgfError where the file has none."""
    if number not in cameras.frames:
        there = sorted(cameras.frames)
        raise SvgfError(
            f"{cameras.path}: no camera for frame {number}; it has frames {there[0]} to {there[-1]} ({len(there)}). "
            "Add the frame."
        )
    return cameras.frames[number]


def pixel_centres(shape: tuple[int, ...], origin: tuple[int, int] = (0, 0)) -> np.ndarray:
    """`[H, W, 2]` screen coordinates of pixel centres; `origin` is the first pixel's place on the screen (a crop)."""
    return np.stack(np.broadcast_arrays(*_pixel_centres(shape, origin)), -1)


def position_from_depth(camera: Camera, depth: np.ndarray, *, origin: tuple[int, int] = (0, 0)) -> np.ndarray:
    """World position `[H, W, 3]` of what is seen at view-space z `depth` `[H, W]` through each pixel's centre."""
    return from_camera(camera, _seen_at(camera, depth, origin), 1.0)


def from_camera(camera: Camera, vector: np.ndarray, w: float) -> np.ndarray:
    """`[..., 3]` in camera space to world space; w = 1 for points, 0 for directions."""
    to_world = np.linalg.inv(camera.world_to_camera)
    return vector @ to_world[:3, :3].T + w * to_world[:3, 3]


def eye_ray_lengths(camera: Camera, shape: tuple[int, ...], origin: tuple[int, int] = (0, 0)) -> np.ndarray:
    """`[H, W]`: how far one goes along the ray through a pixel's centre for each unit of z."""
    ones = np.ones(shape[:2])
    along = _seen_at(camera, ones, origin) - _seen_at(camera, 0 * ones, origin)
    return np.sqrt((along * along).sum(-1))


def previous_position(
    cameras: Cameras, position: np.ndarray, object_id: np.ndarray, *, number: int, previous: int
) -> np.ndarray:
    """World position `[H, W, 3]` that the surface points of frame `number` had at frame `previous`."""
    moved = position.astype(np.float64)
    for key, matrix in object_motion(cameras, number, previous).items():
        here = object_id == key
        if here.any():
            moved[here] = moved[here] @ matrix[:3, :3].T + matrix[:3, 3]
    return moved


def reproject(
    cameras: Cameras,
    depth: np.ndarray,
    object_id: np.ndarray,
    *,
    number: int,
    previous: int,
    position: np.ndarray | None = None,
    before: np.ndarray | None = None,
    origin: tuple[int, int] = (0, 0),
) -> tuple[np.ndarray, np.ndarray]:
    """Where the points of frame `number` were at frame `previous`.

    With positions, motion is from where this frame's camera shows them, not from the pixels' centres: samples that were jittered
    within their pixels do not shake the history.

    Args:
        cameras: of both frames.
        depth: `[H, W]` view-space z.
        object_id: `[H, W]`, -1 = no surface: such pixels move as directions at infinity do.
        number, previous: frame numbers.
        position: `[H, W, 3]` world positions, if the renderer wrote them; else taken from depth and camera.
        before: `[H, W, 3]` where these points were, if the renderer says so; else taken from the objects' motion.
        origin: the first pixel's place on the screen.

    Returns:
        prev_depth `[H, W]` and motion `[H, W, 2]`, float32. Points behind the previous camera get the previous pixel
        (-1e4, -1e4); prev_depth is 0 where there is no surface.
    """
    camera, earlier = find_camera(cameras, number), find_camera(cameras, previous)
    surface = object_id != -1
    with np.errstate(all="ignore"):
        if before is None:
            before = _before(cameras, depth, object_id, number, previous, position, origin)
        point = before @ earlier.world_to_camera[:3, :3].T + earlier.world_to_camera[:3, 3]
        prev_depth = np.where(surface, point[..., 2], 0.0).astype(np.float32)
        if not surface.all():
            away = _seen_at(camera, np.ones_like(depth), origin) - _seen_at(camera, np.zeros_like(depth), origin)
            away = from_camera(camera, away, 0.0) @ earlier.world_to_camera[:3, :3].T
            point = np.where(surface[..., None], point, away)
        rows = earlier.camera_to_screen
        width = _dot(point, rows[3]) + rows[3, 3] * surface
        ahead = width > 0
        here = _pixel_centres(depth.shape, origin)
        if position is not None:
            seen = surface & np.isfinite(position).all(-1)
            shown = np.moveaxis(_shown(camera, position), -1, 0)
            here = tuple(np.where(seen, one, centre) for one, centre in zip(shown, here, strict=True))
        motion = np.empty((*depth.shape, 2), np.float32)
        for axis, one in enumerate(here):
            screen = (_dot(point, rows[axis]) + rows[axis, 3] * surface) / np.where(ahead, width, 1.0)
            motion[..., axis] = np.where(ahead, screen, BEHIND) - one
    return prev_depth, motion


def previous_depth(
    cameras: Cameras,
    depth: np.ndarray,
    object_id: np.ndarray,
    *,
    number: int,
    previous: int,
    position: np.ndarray | None = None,
    origin: tuple[int, int] = (0, 0),
) -> np.ndarray:
    """The first result of `reproject` alone, for frames that bring their motion with them."""
    with np.errstate(all="ignore"):
        point = _before(cameras, depth, object_id, number, previous, position, origin)
        forward = find_camera(cameras, previous).world_to_camera[2]
        return np.where(object_id != -1, _dot(point, forward) + forward[3], 0.0).astype(np.float32)


def position_residual(camera: Camera, position: np.ndarray, *, origin: tuple[int, int] = (0, 0)) -> np.ndarray:
    """`[H, W]` pixels between the centre of each pixel and where the camera shows its `position` `[H, W, 3]`.

    About 0 where cameras, positions and pixel grid belong together; meaningless where there is no surface.
    """
    with np.errstate(all="ignore"):
        apart = _shown(camera, position) - pixel_centres(position.shape[:2], origin)
        return np.hypot(apart[..., 0], apart[..., 1])


def mismatch(
    camera: Camera,
    position: np.ndarray,
    depth: np.ndarray | None,
    where: np.ndarray,
    *,
    origin: tuple[int, int] = (0, 0),
) -> tuple[str, str] | None:
    """What is wrong if positions `[H, W, 3]`, depths `[H, W]` and camera are not of one scene, and how much; None if they are.

    Judged by the pixels `where` `[H, W]`, of which 1 % may be odd. Positions that are spread around their pixels' centres by
    less than a pixel are jittered, and well.
    """
    if not where.any():
        return None
    with np.errstate(all="ignore"):
        off = (_shown(camera, position) - pixel_centres(position.shape[:2], origin))[where]
        beside = np.hypot(off[:, 0], off[:, 1])
    share = (beside > APART).mean()
    jittered = (beside < 1).mean() > 0.99 and np.abs(np.median(off, axis=0)).max() < APART
    if share > 0.01 and not jittered:
        most = beside[np.isfinite(beside)].max(initial=0.0)
        return (
            f"positions are shown more than {APART} pixels beside the centres of their pixels: motion and previous depths will be "
            "wrong. Wanted cameras of the same frames, and pixels counted from the top left.",
            f"{100 * share:.3g} % of the pixels with a surface, at most {most:.3g} pixels beside.",
        )
    forward = camera.world_to_camera[2]
    z = position[where].astype(np.float64) @ forward[:3] + forward[3]
    if depth is not None and (share := (np.abs(z - depth[where]) > 0.01 * np.abs(z)).mean()) > 0.01:
        return (
            "depth is not the camera's z of the positions: history will be rejected. Wanted the distance along the viewing axis, "
            "positive in front of the camera.",
            f"{100 * share:.3g} % of the pixels with a surface are more than 1 % off.",
        )
    return None


def _shown(camera: Camera, position: np.ndarray) -> np.ndarray:
    """`[H, W, 2]`: where on the screen the camera shows world positions `[H, W, 3]`."""
    there = position.astype(np.float64) @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    screen = there @ camera.camera_to_screen[:, :3].T + camera.camera_to_screen[:, 3]
    return screen[..., :2] / screen[..., 3:]


def _pixel_centres(shape: tuple[int, ...], origin: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """x `[1, W]` and y `[H, 1]` of the pixel centres."""
    return np.arange(shape[1])[None, :] + origin[0] + 0.5, np.arange(shape[0])[:, None] + origin[1] + 0.5


def _dot(point: np.ndarray, row: np.ndarray) -> np.ndarray:
    """`[H, W]`: the first three numbers of a row with points `[H, W, 3]`."""
    return point @ row[:3]


def _before(
    cameras: Cameras,
    depth: np.ndarray,
    object_id: np.ndarray,
    number: int,
    previous: int,
    position: np.ndarray | None,
    origin: tuple[int, int],
) -> np.ndarray:
    """`previous_position` of what is seen. What is not finite in the file stays so: the filter counts it."""
    if position is None:
        depth = np.where(object_id != -1, depth, 1.0)
        position = position_from_depth(find_camera(cameras, number), depth, origin=origin)
    return previous_position(cameras, position, object_id, number=number, previous=previous)


def _seen_at(camera: Camera, depth: np.ndarray, origin: tuple[int, int]) -> np.ndarray:
    """Camera-space point `[H, W, 3]` at z = depth that lands on each pixel's centre.

    With rows r of camera_to_screen, X - px W = 0 and Y - py W = 0 are two linear equations in x and y.
    """
    rows = camera.camera_to_screen
    px, py = _pixel_centres(depth.shape, origin)
    to_x = [rows[0, k] - px * rows[3, k] for k in range(4)]  # each [1, W]
    to_y = [rows[1, k] - py * rows[3, k] for k in range(4)]  # each [H, 1]
    right_x = -(to_x[2] * depth + to_x[3])
    right_y = -(to_y[2] * depth + to_y[3])
    determinant = to_x[0] * to_y[1] - to_x[1] * to_y[0]
    x = (right_x * to_y[1] - to_x[1] * right_y) / determinant
    y = (to_x[0] * right_y - right_x * to_y[0]) / determinant
    return np.stack([x, y, depth], -1)


def object_motion(cameras: Cameras, number: int, previous: int) -> dict[int, np.ndarray]:
    """World -> world from one frame to another by object id, for the objects that move."""
    here, there = find_camera(cameras, number), find_camera(cameras, previous)
    if not here.object_motion and not there.object_motion:
        pairs = {
            key: (there.object_to_world[key], pose)
            for key, pose in here.object_to_world.items()
            if key in there.object_to_world
        }
        return {key: past @ np.linalg.inv(now) for key, (past, now) in pairs.items() if not np.array_equal(past, now)}
    motion: dict[int, np.ndarray] = {}
    for step in range(number, previous, -1):  # frame by frame: object_motion reaches back by one
        for key, matrix in find_camera(cameras, step).object_motion.items():
            motion[key] = matrix @ motion.get(key, np.eye(4))
    return motion


def _by_id(entry: Mapping[str, Any], key: str, where: str) -> dict[int, np.ndarray]:
    objects = entry.get(key) or {}
    if not isinstance(objects, Mapping) or not all(re.fullmatch("-?[0-9]{1,19}", str(name)) for name in objects):
        raise SvgfError(f'{where}: "{key}" wants matrices by object id, such as {{"7": [[1, 0, 0, 0], ...]}}.')
    return {int(name): _matrix(value, f'{where}: "{key}" of object {name}') for name, value in objects.items()}


def _matrix(value: Any, what: str) -> np.ndarray:
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise SvgfError(f"{what} is {'missing' if value is None else 'wrong'}; wanted 4 x 4 finite numbers.")
    if "screen" not in what and abs(np.linalg.det(matrix)) < 1e-300:
        raise SvgfError(f"{what} cannot be inverted; wanted a camera or object transform.")
    return matrix
