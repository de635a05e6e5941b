"""From a file's numbers to this library's: light put together, guides brought to world space and z, surfaces decided. Pure NumPy.

`planes` holds by role what the file has, `[H, W, C]` float32; what its numbers mean is in the roles' layers.
"""

from collections.abc import Collection
from typing import Any

import numpy as np

from svgf_jax import memory
from svgf_jax.cameras import Camera, eye_ray_lengths, from_camera, position_residual
from svgf_jax.roles import REST, Roles

FAR = 1e8
"""Depths from here on are the renderers' way of saying that nothing was hit."""

CHANGED = 0.02
"""Share of the pixels that a beauty may be off its parts both ways: a denoised one is in nearly all."""


def light(
    roles: Roles, planes: dict[str, np.ndarray], counts: dict[str, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Radiance `[S, H, W, 3]`, albedo `[S or 1, H, W, 3]` and emission `[H, W, 3]`.

    Light that is already divided by its albedo is multiplied by it: a signal is reflected radiance, and demodulation gives the
    file's numbers back wherever the albedo is above its floor. (So no other file of this library needs to know.) From a beauty,
    which contains it, the emission is taken off. What a beauty has beyond the kinds of light that are there is a signal of its own
    (`rest`), or where none is expected, stays unfiltered with the emission and is counted. A beauty that is more than its parts
    here and less there, in more than `CHANGED` of the pixels each, was changed after it was rendered: it is left out, and counted.
    """
    emitted = [planes[role] for role in ("emission", "environment") if role in planes]
    shape = next(iter(planes.values())).shape[:2]
    emission = sum(emitted[1:], emitted[0]) if emitted else memory.zeros((*shape, 3))
    colors = [roles.light[name].albedo for name in roles.signals]
    white = None if all(color in planes for color in colors) else np.ones((*shape, 3), np.float32)
    albedos: Any = [planes.get(color, white) for color in colors]
    signals = []
    for name, albedo in zip(roles.signals, albedos, strict=True):
        if name != REST:
            signals.append(planes[name] * albedo if roles.light[name].divided else planes[name])
    if roles.signals == ("radiance",):
        signals = [_without(signals[0], emission, counts)] if emitted else signals
    elif "radiance" in planes:
        parts = sum(signals, emission)
        rest = planes["radiance"] - parts
        rest = np.where(np.abs(rest) > 0.01 * np.maximum(np.abs(parts), planes["radiance"]), rest, 0)
        more, less = ((one > 0).any(-1) for one in (rest, -rest))
        if min(more.mean(), less.mean()) > CHANGED:
            counts["changed"] = int((more | less).sum())
            rest = np.zeros_like(rest)
        if REST in roles.signals:
            signals.append(np.maximum(rest, 0))
        else:
            counts["rest"] = int((rest > 0).any(-1).sum())
            emission = emission + np.where(np.isfinite(rest), rest, 0)
    names = {roles.layers[one.albedo].channels if one.albedo in roles.layers else () for one in roles.light.values()}
    return _stacked(signals), _stacked(albedos[:1] if len(names) == 1 else albedos), emission


def light_roles(roles: Roles) -> set[str]:
    """The planes that `light` reads, and nothing else does."""
    albedos = {one.albedo for one in roles.light.values()}
    return {*roles.signals, *albedos, "radiance", "emission", "environment"}


def _stacked(images: list[np.ndarray]) -> np.ndarray:
    if len(images) == 1:
        return images[0][None]
    return np.stack(images, out=memory.zeros((len(images), *images[0].shape), np.result_type(*images)))


def _without(beauty: np.ndarray, emission: np.ndarray, counts: dict[str, int]) -> np.ndarray:
    known = np.where(np.isfinite(emission), emission, 0)
    reflected = beauty - known
    slack = 2.0**-9 * np.abs(known)  # half-float rounding of both
    counts["excess"] = int((reflected < -slack).any(-1).sum())
    return np.maximum(reflected, 0)  # NaN stays NaN


def in_world(
    roles: Roles, planes: dict[str, np.ndarray], camera: Camera | None, origin: tuple[int, int]
) -> dict[str, np.ndarray]:
    """The planes with positions and normals in world space, and depth as z, as far as a camera is known.

    Depth is taken from the positions where there is none, or only distances along the ray. Without a camera, what is in camera
    space stays there.
    """
    planes = dict(planes)
    means = {role: layer.meaning for role, layer in roles.layers.items()}
    position = planes.get("position")
    if position is not None and "or" in means["position"].split():
        means["position"] = _space_of(position, camera, origin) if camera else "camera"
    if "or" in means.get("normal", "").split():
        means["normal"] = means.get("position", "camera")
    for role, w in (("position", 1.0), ("normal", 0.0)):
        words = means.get(role, "").split()
        if role in planes and "camera" in words:
            mine = planes[role] * np.array(camera_signs(words), np.float32)
            planes[role] = mine if camera is None else from_camera(camera, mine, w).astype(np.float32)
    if means.get("depth") == "z-back" and "depth" in planes:
        planes["depth"] = -planes["depth"]
    distance = means.get("depth") == "distance"
    if position is not None and ("depth" not in planes or distance):
        hit = (position != 0).any(-1) & np.isfinite(position).all(-1)
        z = _z_of(planes["position"], camera, means.get("position", ""))
        if z is not None:
            far = planes["depth"][..., 0] if distance else np.zeros(hit.shape, np.float32)
            hit &= (far > 0) & (far < FAR) if distance else True
            planes["depth"] = np.where(hit, z, far)[..., None].astype(np.float32)
            distance = False
    if distance and "depth" in planes and camera is not None:
        planes["depth"] = planes["depth"] / eye_ray_lengths(camera, planes["depth"].shape[:2], origin)[..., None]
        planes["depth"] = planes["depth"].astype(np.float32)
    return planes


def camera_signs(words: Collection[str]) -> tuple[int, int, int]:
    """What takes the camera space of these words to that of `Camera`: x right, y down, z forward."""
    return (1, 1 if "y-down" in words else -1, -1 if "z-back" in words else 1)


def _z_of(position: np.ndarray, camera: Camera | None, space: str) -> np.ndarray | None:
    if camera is not None:
        return position.astype(np.float64) @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    return position[..., 2] if "camera" in space.split() else None


def _space_of(position: np.ndarray, camera: Camera, origin: tuple[int, int]) -> str:
    """Where the camera shows the positions in their pixels: read as in camera space, or in world space."""
    seen = (position != 0).any(-1)
    if not seen.any():
        return "camera"
    local = from_camera(camera, position * np.array([1, -1, 1], np.float32), 1.0)
    apart = [
        np.median(np.nan_to_num(position_residual(camera, one, origin=origin)[seen], nan=np.inf))
        for one in (local, position)
    ]
    return "camera" if apart[0] <= apart[1] else "world"


def guides(
    roles: Roles, planes: dict[str, np.ndarray], shape: tuple[int, ...], counts: dict[str, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """object_id, normal (unit) and depth; 0 where there is no surface, which is decided here."""
    ids = np.zeros(shape, np.int32)
    hit = np.ones(shape, bool)
    if "id" in planes:
        given = planes["id"][..., 0]
        ids = np.where(np.isfinite(given), np.rint(given), -1).astype(np.int64).astype(np.int32)  # uint32 wraps round
        if none := roles.layers["id"].meaning:
            ids = np.where(ids == int(none), -1, ids)
        hit = ids != -1
    if "alpha" in planes:
        hit &= ~(planes["alpha"][..., 0] == 0)
    surface = hit.copy()
    normal = planes.get("normal", np.broadcast_to(np.array([0, 0, 1], np.float32), (*shape, 3)))
    length = np.sqrt((normal * normal).sum(-1, dtype=np.float32))
    surface &= ~(length == 0)  # one that is not finite counts as a surface that the filter drops and counts
    depth = planes["depth"][..., 0] if "depth" in planes else np.ones(shape, np.float32)
    surface &= (depth > 0) & (depth < FAR)
    if "id" in planes or "alpha" in planes:
        unexplained = ~(depth >= FAR)
        if "id" in planes:  # an id says that something was hit: at an infinite depth the filter cannot follow it
            unexplained |= np.isposinf(depth)
        counts["guides"] = int((hit & ~surface & unexplained).sum())
    counts["normal"] = int((surface & (np.abs(length - 1) > 0.01)).sum())
    normal = (normal / length[..., None]).astype(np.float32, copy=False)
    normal[~surface] = 0
    ids, depth = np.where(surface, ids, -1), np.where(surface, depth, 0)
    return ids.astype(np.int32, copy=False), normal, depth.astype(np.float32, copy=False)
