"""What a frame's guides are, judged by themselves: the space of normals, the kind of depth, how long history will hold. No JAX."""

from typing import Any, NamedTuple

import numpy as np

from svgf_jax.cameras import Camera
from svgf_jax.noise import shifted, uniform
from svgf_jax.types import Frame, Params

CAMERA_AXES = {
    "camera space (x right, y down, z forward)": (1, 1, 1),
    "camera space (x right, y up, z backward)": (1, -1, -1),
    "camera space (x right, y up, z forward)": (1, -1, 1),
}
"""Signs that take the camera space of `Camera`, the first of these, to those of others."""

SPACES: dict[str, str] = dict(zip(("camera y-down", "camera z-back", "camera"), CAMERA_AXES, strict=True))
"""Those spaces by the words for them in tables (`svgf_jax.renderers`)."""
WORLD = "world space"

VIEW_Z, RAY_DISTANCE, Z_BUFFER = "view z", "ray distance", "z buffer"
Z_AFTER_ALL = "view z, not ray distance"
LEAST = 64  # pixels to judge by


class Fit(NamedTuple):
    """How well each of several readings explains what is in the files.

    Attributes:
        misfit: by reading, the less the better; in degrees for normals, relative for depths.
        best: the readings that explain it. One: that is it. Several: they are not told apart here. None: none does.
    """

    misfit: dict[str, float]
    best: tuple[str, ...]


class Continuity(NamedTuple):
    """Whether the previous frame has what each surface pixel shows.

    Attributes:
        share: share of the surface pixels with history.
        still: share of the surface pixels that move by less than 0.01 pixels.
    """

    share: float
    still: float


def normal_space(
    frame: Frame, position: np.ndarray, camera: Camera | None, *, normals: np.ndarray | None = None
) -> Fit | None:
    """Degrees between the normals and those of the surfaces that `position` `[H, W, 3]` (world space) draws, medians.

    `normals` `[H, W, 3]`: those to judge, as the files have them, of any length; the frame's if None. Which way a normal faces
    does not count: only products of normals enter the filter. None where there is too little to judge by.
    """
    normals = np.asarray(frame.normal if normals is None else normals)
    where = uniform(frame) & np.isfinite(position).all(-1) & np.isfinite(normals).all(-1) & (normals != 0).any(-1)
    with np.errstate(all="ignore"):
        across, down = (_central(position.astype(np.float64), axis) for axis in (1, 0))
        facing = np.cross(across, down)
        length = np.linalg.norm(facing, axis=-1)
        where &= np.isfinite(length) & (length > 0)
        if where.sum() < LEAST:
            return None
        facing, normal = facing[where] / length[where, None], normals[where].astype(np.float64)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        spaces = {WORLD: facing}
        if camera is not None:
            turned = facing @ camera.world_to_camera[:3, :3].T
            spaces |= {name: turned * signs for name, signs in CAMERA_AXES.items()}
        misfit = {
            name: float(np.degrees(np.median(np.arccos(np.abs((normal * there).sum(-1)).clip(0, 1)))))
            for name, there in spaces.items()
        }
    return Fit(misfit, _best(misfit, most=15.0, slack=1.0))


def depth_by_position(depth: np.ndarray, position: np.ndarray, camera: Camera, where: np.ndarray) -> Fit | None:
    """Relative difference between `depth` `[H, W]` and what the camera sees of `position`, medians over `where`."""
    where = where & np.isfinite(position).all(-1) & np.isfinite(depth) & (depth > 0)
    if where.sum() < LEAST:
        return None
    point = position[where].astype(np.float64) @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    given = depth[where].astype(np.float64)
    truth = {VIEW_Z: point[:, 2], RAY_DISTANCE: np.linalg.norm(point, axis=-1)}
    misfit = {
        name: float(np.median(np.abs(given / np.where(value == 0, np.nan, value) - 1))) for name, value in truth.items()
    }
    return Fit(misfit, _best(misfit, most=0.01, slack=1e-4))


def depth_by_planes(
    depth: np.ndarray, frame: Frame, *, camera: Camera | None, origin: tuple[int, int] = (0, 0), most: int = 20_000
) -> Fit | None:
    """How far from straight each kind of depth makes the flat surfaces, by about `most` lines along rows and columns.

    In units of how much the depths differ over all of them.

    On a plane 1 / z is linear in the pixel, and so is what a z buffer holds; a ray's length is z sqrt(1 + tan^2), with
    the camera's angles or, without a camera, with the focal length that fits best (in the middle of the picture).
    None where too little of the picture is flat.
    """
    step = max(2, min(depth.shape) // 12)
    y, x = np.concatenate(
        [_flat(frame, step, axis) for axis in (0, 1)], -1
    )  # each [3, N]: first, middle, last of a line
    if x.shape[1] < LEAST:
        return None
    some = slice(None, None, max(1, x.shape[1] // most))
    y, x = y[:, some], x[:, some]
    known = depth[y, x].astype(np.float64)

    def bend(values: np.ndarray) -> float:
        spread = max(
            np.subtract(*np.nanpercentile(values, [75, 25])), 0.01 * abs(np.nanmedian(values))
        )  # a frontal wall
        apart = np.abs((values[0] + values[2]) / 2 - values[1])
        return float(np.median(np.nan_to_num(apart / spread, nan=1.0, posinf=1.0)))

    with np.errstate(all="ignore"):
        slants = _slants(x, y, depth.shape, camera, origin)
        misfit = {VIEW_Z: bend(1 / known), RAY_DISTANCE: min(bend(slant / known) for slant in slants)}
        if (known <= 1).all():
            misfit[Z_BUFFER] = bend(known)
    # Rounding bends lines as well: a kind is told apart only where it is much straighter.
    best = _best(misfit, most=0.003, slack=0.0, ratio=3.0)
    if (
        Z_BUFFER in best and np.median(known) > 0.9
    ):  # its inverse is nearly as straight, and nobody's scene is all at 0.9 to 1
        best = (Z_BUFFER,)
    elif (
        camera is None and misfit[VIEW_Z] <= misfit[RAY_DISTANCE] and VIEW_Z in best
    ):  # long focal lengths bend z little
        best = tuple(name for name in best if name != RAY_DISTANCE)
    return Fit(misfit, best)


def continuity(previous: Frame, current: Frame, *, params: Params = Params(), most: int = 200_000) -> Continuity:
    """Apply the filter's tests of reprojection (whether the previous pixel shows the same surface) to about `most` pixels."""
    surface = current.object_id != -1
    y, x = np.nonzero(surface)
    if not len(x):
        return Continuity(0.0, 1.0)
    some = slice(None, None, max(1, len(x) // most))
    y, x = y[some], x[some]
    here = (y, x)
    with np.errstate(all="ignore"):
        moved = np.nan_to_num(current.motion[here].astype(np.float64), nan=1e9).clip(-1e9, 1e9)
        still = float((np.hypot(*moved.T) < 0.01).mean())
        to_x, to_y = x + moved[:, 0], y + moved[:, 1]
        found = np.zeros(len(x), bool)
        for at_x, at_y, reach in (
            (np.floor(to_x), np.floor(to_y), (0, 1)),
            (np.floor(to_x + 0.5), np.floor(to_y + 0.5), (-1, 0, 1)),
        ):
            for dy in reach:
                for dx in reach:
                    weight = 1.0 if len(reach) == 3 else (1 - np.abs(to_x - at_x - dx)) * (1 - np.abs(to_y - at_y - dy))
                    found |= (weight >= 0.01) & _consistent(previous, current, here, at_x + dx, at_y + dy, params)
    return Continuity(float(found.mean()), still)


def lost_by(previous: Frame, current: Frame, *, params: Params = Params()) -> str:
    """The one of those tests ("id", "depth" or "normal") without which most of the lost history would be found; "" if none."""
    one_object = [f._replace(object_id=np.where(np.asarray(f.object_id) == -1, -1, 0)) for f in (previous, current)]
    without = {
        "id": continuity(*one_object, params=params).share,
        "depth": continuity(previous, current, params=params._replace(reproject_depth=np.inf)).share,
        "normal": continuity(previous, current, params=params._replace(reproject_normal=-2.0)).share,
    }
    found = continuity(previous, current, params=params).share
    best = max(without, key=lambda name: without[name])
    return best if 1 - without[best] < 0.5 * (1 - found) else ""


def expected_length(share: float, *, frames: int, most: float) -> float:
    """Mean history length over a sequence of so many `frames` in which a pixel keeps its history with probability `share`."""
    total = length = 1.0
    for _ in range(frames - 1):
        length = min(1 + share * length, most)
        total += length
    return total / max(frames, 1)


def _consistent(
    previous: Frame, current: Frame, here: tuple[Any, ...], x: np.ndarray, y: np.ndarray, params: Params
) -> np.ndarray:
    height, width = previous.object_id.shape
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    there = np.where(inside, y, 0).astype(np.int64), np.where(inside, x, 0).astype(np.int64)
    expected = current.prev_depth[here]
    near = np.abs(previous.depth[there] - expected) <= params.reproject_depth * np.maximum(expected, 1e-6)
    turned = (previous.normal[there] * current.normal[here]).sum(-1) >= params.reproject_normal
    return inside & (previous.object_id[there] == current.object_id[here]) & near & turned


def _best(misfit: dict[str, float], *, most: float, slack: float, ratio: float = 2.0) -> tuple[str, ...]:
    """The readings within `slack` or `ratio` of the best one, if that is no worse than `most`."""
    least = min(misfit.values())
    if not least <= most:
        return ()
    return tuple(name for name, value in misfit.items() if value <= max(least + slack, ratio * least))


def _central(values: np.ndarray, axis: int) -> np.ndarray:
    """Central differences; meaningless at the border."""
    return np.roll(values, -1, axis) - np.roll(values, 1, axis)


def _flat(frame: Frame, step: int, axis: int) -> np.ndarray:
    """Rows and columns `[2, 3, N]` of triples `step` pixels apart along an axis on one flat piece of one object."""
    dx, dy = (0, step) if axis == 0 else (step, 0)
    ids, normal = np.asarray(frame.object_id), np.asarray(frame.normal)
    same = ids != -1
    for sign in (-1, 1):
        same &= shifted(ids, sign * dx, sign * dy, -1) == ids
        cosine = sum(normal[..., c] * shifted(normal[..., c], sign * dx, sign * dy, 0) for c in range(3))
        same &= cosine > 1 - 1e-5
    y, x = np.nonzero(same)
    ends = np.array([[-1], [0], [1]])
    return np.stack([y + ends * dy, x + ends * dx])


def _slants(
    x: np.ndarray, y: np.ndarray, shape: tuple[int, ...], camera: Camera | None, origin: tuple[int, int]
) -> list[np.ndarray]:
    """Ray length over z at pixels: the camera's, or one for each of several focal lengths."""
    if camera is not None:
        rows, px, py = camera.camera_to_screen, x + origin[0] + 0.5, y + origin[1] + 0.5
        return [
            np.sqrt(
                1
                + ((px * rows[3, 2] - rows[0, 2]) / rows[0, 0]) ** 2
                + ((py * rows[3, 2] - rows[1, 2]) / rows[1, 1]) ** 2
            )
        ]
    squared = (x - (shape[1] - 1) / 2) ** 2 + (y - (shape[0] - 1) / 2) ** 2
    return [np.sqrt(1 + squared / (focal * shape[1]) ** 2) for focal in np.geomspace(0.25, 4.0, 33)]
