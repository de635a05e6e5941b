"""Where a reflection was one frame ago: virtual motion by hit distance. NumPy only.

What a flat mirror shows doesn't move with the mirror's surface but with the *virtual point*: the reflected thing, seen straight on
through the surface, at the hit distance behind it along the view ray. So for point x seen from eye e, v = x + f hit (x - e) /
|x - e|, and the reflection's previous pixel is where the previous camera sees v. Exact for flat mirrors of still things.

A curved mirror turns the ray by more: its image is elsewhere, and at slanting incidence in two places at once (astigmatism). With d
the view direction, the previous eye lies D along d before x, and t across it; by how much, s across d, has the image moved on the
surface? From x + s the reflected thing lies s / (f hit) beside the view ray's continuation, as with the flat mirror, and the
normal is another by dn(s), which turns the ray by 2 ((d . dn) n + cos dn), cos = -d . n. The ray that arrives must be the one to
the previous eye, (t - s) / D. So

    (t - s) / D = s / (f hit) + 2 ((d . dn) n + cos dn),    dn(s) linear in s:

two linear equations, of first order in t; for dn = 0 exactly the virtual point. dn comes from the differences of normals and
positions between neighbouring pixels of the same object, of the two along an axis the smaller one: flat facets stay flat.

What moves carries its picture along: if a thing was m elsewhere, as seen from the mirror, its image was m - 2 (m . n) n elsewhere.
Which thing it is, the frame itself tells where it shows the reflected point too, at that point's depth; what is seen in the mirror
alone is taken to stand still. Mirrors that move are exact too, unless they turn.

f says how far a rough surface's image lies behind it, 1 for a mirror, 0 for a matt surface, which looks the same from all sides:
the factor of the dominant direction of the GGX lobe, f = (1 - r) (sqrt(1 - r) + r) with roughness r (Lagarde & de Rousiers,
Moving Frostbite to Physically Based Rendering, 2014). In between the image is neither here nor there: its history, which lies
about its place by d = (1 - f) |virtual - surface| pixels a frame, is kept until it has drifted by one pixel, 1 + 1 / d frames.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from svgf_jax.cameras import (
    BEHIND,
    Camera,
    Cameras,
    find_camera,
    object_motion,
    pixel_centres,
    position_from_depth,
    previous_position,
)

LONGEST = 1e6
"""Frames of history where nothing shortens it."""
_SAME = 0.02  # relative difference of depths up to which a pixel shows the reflected point
_BENT = 1e-10  # squared difference of neighbouring normals above which a mirror isn't flat: 1e-5 radians


class Reflections(NamedTuple):
    """The fields of the same names of `Frame`, for one signal: `[H, W, 2]`, `[H, W]` and `[H, W]`, float32."""

    reflected_motion: np.ndarray
    reflected_prev_depth: np.ndarray
    longest_history: np.ndarray


def trace_reflections(
    cameras: Cameras,
    depth: np.ndarray,
    normal: np.ndarray,
    object_id: np.ndarray,
    hit_distance: np.ndarray,
    *,
    roughness: np.ndarray | float = 0.0,
    number: int,
    previous: int,
    position: np.ndarray | None = None,
    origin: tuple[int, int] = (0, 0),
) -> Reflections:
    """The past of what surfaces reflect.

    Args:
        cameras: of both frames.
        depth, normal, object_id: `[H, W]`, `[H, W, 3]`, `[H, W]`; view-space z, world space, -1 = no surface.
        hit_distance: `[H, W]`, world units from the surface to what it reflects; 0 = moves with the surface; infinite = far away.
        roughness: `[H, W]` or one number in [0, 1], perceptual (0 = mirror, 1 = matt).
        number, previous: frame numbers.
        position: `[H, W, 3]` world positions, if the renderer wrote them; else taken from depth and camera.
        origin: the first pixel's place on the screen.

    Returns:
        The reflections' motion; the depth that the reflecting surface, taken as flat, has at that previous pixel; and the frames of
        history worth keeping. NaN motion where there is no surface or the hit distance is not a number.
    """
    camera, before = find_camera(cameras, number), find_camera(cameras, previous)
    surface = object_id != -1
    with np.errstate(all="ignore"):
        shown = pixel_centres(depth.shape, origin)
        if position is None:
            position = position_from_depth(camera, np.where(surface, depth, 1.0), origin=origin)
        else:
            shown = _screen(camera, position.astype(np.float64))  # samples may be jittered within their pixels
        position = position.astype(np.float64)
        away = position - _eye(camera)
        away /= np.linalg.norm(away, axis=-1, keepdims=True)
        r = np.clip(np.asarray(roughness, np.float64), 0.0, 1.0)
        share = np.broadcast_to((1.0 - r) * (np.sqrt(1.0 - r) + r), depth.shape)
        behind = np.minimum(
            share * np.maximum(hit_distance, 0.0), 1e6 * np.abs(depth)
        )  # so far behind, it moves as at infinity
        was = previous_position(cameras, position, object_id, number=number, previous=previous)
        carried = _carried(
            cameras, position, was, away, normal, hit_distance, depth, object_id, number, previous, origin
        )
        image = was + _moved(
            camera, _eye(before), was, away, behind, share[..., None] * carried, position, normal, object_id
        )
        motion = _screen(before, image) - shown
        on_surface = _screen(before, was) - shown
        drift = (1.0 - share) * np.hypot(*np.moveaxis(motion - on_surface, -1, 0))  # the motion itself has the factor f
        longest = np.minimum(1.0 + 1.0 / np.maximum(drift, 1e-9), LONGEST)
        there = _depth_along(before, was, image, normal)
    motion = np.where((surface & ~np.isnan(hit_distance))[..., None], motion, np.nan)
    return Reflections(motion.astype(np.float32), there.astype(np.float32), longest.astype(np.float32))


def signals_reflected(
    cameras: Cameras | None,
    signals: Sequence[str],
    planes: Mapping[str, np.ndarray],
    depth: np.ndarray,
    normal: np.ndarray,
    object_id: np.ndarray,
    *,
    number: int,
    previous: int | None,
    origin: tuple[int, int],
) -> tuple[np.ndarray, ...]:
    """`Reflections` of all signals, `[S, ...]`, of which those called glossy or specular reflect; `planes` are a file's, by role.

    () where no hit distances and cameras tell it. In the first frame of all, everything stays on its surface.
    """
    reflect = [name.startswith(("glossy", "specular")) for name in signals]
    if not any(reflect) or "hit_distance" not in planes or cameras is None:
        return ()
    still = moved = Reflections(
        np.full((*depth.shape, 2), np.nan, np.float32),
        np.zeros(depth.shape, np.float32),
        np.full(depth.shape, LONGEST, np.float32),
    )
    if previous is not None:
        moved = trace_reflections(
            cameras,
            depth,
            normal,
            object_id,
            planes["hit_distance"][..., 0],
            roughness=planes["roughness"][..., 0] if "roughness" in planes else 0.0,
            number=number,
            previous=previous,
            position=planes.get("position"),
            origin=origin,
        )
    return tuple(np.stack(fields) for fields in zip(*(moved if r else still for r in reflect), strict=True))


def _carried(
    cameras: Cameras,
    position: np.ndarray,
    was: np.ndarray,
    away: np.ndarray,
    normal: np.ndarray,
    hit_distance: np.ndarray,
    depth: np.ndarray,
    object_id: np.ndarray,
    number: int,
    previous: int,
    origin: tuple[int, int],
) -> np.ndarray:
    """m - 2 (m . n) n of the module's docstring, `[H, W, 3]`; all 0 where nothing moves."""
    if not object_motion(cameras, number, previous):
        return np.zeros(position.shape)
    camera = find_camera(cameras, number)
    turned = away - 2.0 * _dot(away, normal)[..., None] * normal
    reflected = position + hit_distance[..., None] * turned
    column, row = (
        np.clip(np.floor(at - first), -1, size).astype(int)
        for at, first, size in zip(
            np.moveaxis(_screen(camera, reflected), -1, 0), origin, depth.shape[::-1], strict=True
        )
    )
    inside = (row >= 0) & (row < depth.shape[0]) & (column >= 0) & (column < depth.shape[1])
    there = np.where(inside, row, 0), np.where(inside, column, 0)
    far = reflected @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    seen = inside & (np.abs(depth[there] - far) <= _SAME * far)
    ids = np.where(seen, object_id[there], -1)
    thing = np.where(
        seen[..., None], previous_position(cameras, reflected, ids, number=number, previous=previous) - reflected, 0
    )
    moved = thing - (was - position)
    return moved - 2.0 * _dot(moved, normal)[..., None] * normal


def _moved(
    camera: Camera,
    eye: np.ndarray,
    was: np.ndarray,
    away: np.ndarray,
    behind: np.ndarray,
    carried: np.ndarray,
    position: np.ndarray,
    normal: np.ndarray,
    object_id: np.ndarray,
) -> np.ndarray:
    """s of the module's docstring, `[H, W, 3]`, for points that were at `was`; NaN where a hollow mirror shows nothing clear."""
    distance = _dot(was - eye, away)
    across = eye - was + distance[..., None] * away
    further = _dot(carried, away)
    behind = np.maximum(behind + further, 0.0)
    ratio = behind / distance
    wanted = ratio[..., None] * across + (carried - further[..., None] * away)
    moved = wanted / (1.0 + ratio)[..., None]
    sides = [_nearer(normal, object_id, axis) for axis in (1, 0)]
    bent = np.maximum(*(turn for _, turn in sides)) > _BENT
    here = np.nonzero(bent & (behind > 0))
    if not here[0].size:
        return moved
    d, n, ratio, behind = (a[here] for a in (away, normal.astype(np.float64), ratio[..., None], behind[..., None]))
    steps, columns = [], []
    for (side, _), axis in zip(sides, (1, 0), strict=True):
        offset = side[here]
        there = tuple(at + offset * (k == axis) for k, at in enumerate(here))
        step = np.where(offset[:, None] == 0, camera.world_to_camera[1 - axis, :3], position[there] - position[here])
        step -= _dot(step, d)[:, None] * d
        turn = normal[there].astype(np.float64) - n
        steps.append(step)
        columns.append((1.0 + ratio) * step + 2.0 * behind * (_dot(d, turn)[:, None] * n - _dot(d, n)[:, None] * turn))
    (tx, ty), (cx, cy), wanted = steps, columns, wanted[here]
    xx, xy, yx, yy = _dot(tx, cx), _dot(tx, cy), _dot(ty, cx), _dot(ty, cy)
    rx, ry = _dot(tx, wanted), _dot(ty, wanted)
    determinant = xx * yy - xy * yx
    # On a flat mirror: (1 + ratio)^2 |tx x ty|^2. Near 0 is the focus of a hollow one.
    flat = (1.0 + ratio[:, 0]) ** 2 * (_dot(tx, tx) * _dot(ty, ty) - _dot(tx, ty) ** 2)
    determinant = np.where(np.abs(determinant) > 0.01 * flat, determinant, np.nan)
    x, y = (rx * yy - ry * xy) / determinant, (ry * xx - rx * yx) / determinant
    moved[here] = x[:, None] * tx + y[:, None] * ty
    return moved


def _nearer(normal: np.ndarray, object_id: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Along an axis, the neighbour of the same object whose normal is nearer (1 = ahead, -1 = behind, 0 = none); and how near.

    How near: `[H, W]`, the squared difference of the normals, 0 where there is none.
    """
    turn = np.diff(normal, axis=axis)
    square = np.where(np.diff(object_id, axis=axis) == 0, _dot(turn, turn), np.inf)
    square = np.where(np.isnan(square), np.inf, square)
    edge = [(0, 0), (0, 0)]
    ahead, behind = (
        np.pad(square, [*edge[:axis], side, *edge[axis + 1 :]], constant_values=np.inf) for side in ((0, 1), (1, 0))
    )
    least = np.minimum(ahead, behind)
    some = np.isfinite(least)
    return np.where(some, np.where(ahead <= behind, 1, -1), 0), np.where(some, least, 0.0)


def _dot(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", one, other)


def _eye(camera: Camera) -> np.ndarray:
    return np.linalg.inv(camera.world_to_camera)[:3, 3]


def _screen(camera: Camera, point: np.ndarray) -> np.ndarray:
    """`[H, W, 2]`: where a camera sees world points; `BEHIND` where it doesn't."""
    whole = camera.camera_to_screen @ camera.world_to_camera
    x, y, w = (point @ whole[k, :3] + whole[k, 3] for k in (0, 1, 3))
    return np.stack([np.where(w > 0, a / np.where(w > 0, w, 1.0), BEHIND) for a in (x, y)], -1)


def _depth_along(camera: Camera, position: np.ndarray, towards: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Depth at which the ray from the camera to `towards` meets the plane through `position`."""
    eye, forward = _eye(camera), camera.world_to_camera[2]
    ray, normal = towards - eye, normal.astype(np.float64)
    slant = _dot(ray, normal)
    reach = _dot(position - eye, normal) / np.where(np.abs(slant) > 1e-12, slant, 1.0)
    return np.where(np.abs(slant) > 1e-12, reach * (ray @ forward[:3]), position @ forward[:3] + forward[3])
