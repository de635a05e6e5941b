"""From planes by role to a frame: light, guides and the past, wherever the planes came from (files or arrays). NumPy only."""

from collections.abc import Callable, Collection
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from svgf_jax.cameras import (
    Cameras,
    find_camera,
    mismatch,
    position_from_depth,
    previous_depth,
    reproject,
)
from svgf_jax.motion import convert, parse_convention
from svgf_jax.planes import guides, in_world, light, light_roles
from svgf_jax.reflections import signals_reflected
from svgf_jax.roles import Roles, short_names
from svgf_jax.types import Frame, SvgfError

IN_FRAME = " In frame "  # what follows it in a note are that frame's numbers


class Place(NamedTuple):
    """Where a frame stands in its sequence and on the screen.

    Attributes:
        number, previous: of this frame, and of the one before it; None if nothing is.
        origin: the first pixel's place on the screen.
        screen: width and height of the whole picture.
        cameras: of both frames, if they are known.
    """

    number: int
    previous: int | None
    origin: tuple[int, int]
    screen: tuple[int, int]
    cameras: Cameras | None


def check_roles(roles: Roles, cameras: Cameras | None, *, position: bool, where: str) -> None:
    """Raise SvgfError where positions are wanted, or motion is in world space, and nothing tells what that takes."""
    if position and not ("position" in roles.layers or (cameras and "depth" in roles.layers)):
        raise SvgfError(
            f"{where}: no positions, and no depth with cameras to take them from. Wanted position.X, .Y, .Z "
            "(--file position=..., --channel position=...), or depth and a cameras.json."
        )
    if "world" in meaning_of(roles, "motion") and not (cameras and roles.layers.keys() & {"depth", "position"}):
        raise SvgfError(
            f"{where}: motion in world space needs cameras, and positions or depth. Give a cameras.json (--cameras), or say what "
            "the motion vectors mean if this is wrong (--motion)."
        )


def meaning_of(roles: Roles, role: str) -> list[str]:
    """The words of what a role's numbers mean."""
    return roles.layers[role].meaning.split() if role in roles.layers else []


def assemble(
    roles: Roles,
    planes: dict[str, np.ndarray],
    place: Place,
    *,
    half: Collection[str] = (),
    position: bool = False,
    motion_before: Callable[[], np.ndarray | None],
) -> tuple[Frame, dict[str, int], tuple[str, ...]]:
    """A frame of NumPy arrays; the pixels repaired, by reason (`svgf_jax.frames.LoadedFrame`); and what else is odd.

    Args:
        roles: what the planes mean.
        planes: the channels of each role, `[H, W, C]`, as the renderer has them; those of light are taken out, for they are large.
        place: where the frame stands.
        half: the roles that are stored in half float.
        position: whether the frame gets its world positions.
        motion_before: asked for the motion vectors of the frame before, if the convention puts them there and there is one.
    """
    counts: dict[str, int] = {}
    notes: list[str] = []
    with np.errstate(all="ignore"):  # whatever is not finite is dealt with by name below, or by the filter
        radiance, albedo, emission = light(roles, planes, counts)
        for role in light_roles(roles) & planes.keys():
            del planes[role]
        camera = None if place.cameras is None else find_camera(place.cameras, place.number)
        planes = in_world(roles, planes, camera, place.origin)
        object_id, normal, depth = guides(roles, planes, radiance.shape[1:3], counts)
        motion, prev_depth = _past(roles, place, planes, depth, object_id, notes, motion_before)
        where = _position(place, planes, depth, object_id, notes, wanted=position)
        if "id" in half and (largest := np.fmax.reduce(planes["id"], axis=None)) > 2048:
            notes.append(
                f"object ids up to {largest:.0f} in half float: above 2048 neighbouring ids become one. "
                "Let the renderer write ids as 32-bit."
            )
    if counts.get("rest", 0) > 0.01 * object_id.size:
        notes.append(
            f"the light is more than its parts: what is in none of {', '.join(roles.signals)} stays unfiltered. Switch on "
            f"the passes that are missing.{IN_FRAME}{place.number}: {100 * counts['rest'] / object_id.size:.3g} % of the pixels."
        )
    if changed := counts.get("changed", 0):
        notes.append(
            f"{short_names(roles.layers['radiance'].channels)} is not the sum of its parts, more here and less there: denoised, or "
            "changed by the compositor. It is left out, and the sum taken. Render without a denoiser, or with the noisy picture "
            f"beside it.{IN_FRAME}{place.number}: {100 * changed / object_id.size:.3g} % of the pixels."
        )
    measured = [planes[f"{role}_variance"][..., 0] for role in roles.signals if f"{role}_variance" in planes]
    variance = np.stack(measured) if measured else None
    arrays: list[Any] = [radiance, albedo, emission, normal, depth, prev_depth, motion, object_id, variance]
    arrays.append(where if position else None)
    between = partial(signals_reflected, number=place.number, previous=place.previous, origin=place.origin)
    arrays += between(place.cameras, roles.signals, planes, depth, normal, object_id)
    return Frame(*arrays), {reason: count for reason, count in counts.items() if count}, tuple(notes)


def _past(
    roles: Roles,
    place: Place,
    planes: dict[str, np.ndarray],
    depth: np.ndarray,
    object_id: np.ndarray,
    notes: list[str],
    motion_before: Callable[[], np.ndarray | None],
) -> tuple[np.ndarray, np.ndarray]:
    """Motion `[H, W, 2]` and prev_depth `[H, W]` with respect to the frame that is read before this one."""
    number, before, cameras = place.number, place.previous, place.cameras
    motion = planes.get("motion", np.zeros((*depth.shape, 2), np.float32))
    prev_depth = depth
    skipped = before is not None and before != number - 1
    convention = parse_convention(roles.layers["motion"].meaning if "motion" in planes else "")
    world = motion if convention.unit == "world" else None
    if "motion" in planes and world is None:
        later = None
        if convention.from_frame_before:
            later = np.zeros_like(motion) if before != number - 1 else motion_before()
        motion = convert(motion, convention, size=place.screen, motion_before=later)
    if before is not None and cameras and planes.keys() & {"depth", "position"}:
        where: Any = {"number": number, "previous": before, "position": planes.get("position"), "origin": place.origin}
        if world is not None and not skipped:
            here = planes.get("position")
            if here is None:
                here = position_from_depth(find_camera(cameras, number), depth, origin=place.origin)
            way = -1 if convention.direction == "from-previous" else 1
            where |= {"before": here + way * world, "position": here}
        if skipped or "motion" not in planes or world is not None:
            prev_depth, motion = reproject(cameras, depth, object_id, **where)
        else:
            prev_depth = previous_depth(cameras, depth, object_id, **where)
    elif world is not None:  # nothing before it
        motion = np.zeros((*depth.shape, 2), np.float32)
    elif skipped and "motion" in planes:
        notes.append(
            f"frame {number} follows frame {before}, but its motion vectors lead to frame {number - 1}; "
            "a cameras.json would tell the whole way."
        )
    sky = (object_id == -1)[..., None]
    return np.where(sky & ~np.isfinite(motion), 0, motion).astype(np.float32, copy=False), prev_depth


def _position(
    place: Place,
    planes: dict[str, np.ndarray],
    depth: np.ndarray,
    object_id: np.ndarray,
    notes: list[str],
    *,
    wanted: bool,
) -> np.ndarray | None:
    """World positions `[H, W, 3]`, if they are wanted or there; with cameras it is checked that they belong to them."""
    surface = object_id != -1
    position = planes.get("position")
    if place.cameras is None:
        return position
    camera = find_camera(place.cameras, place.number)
    if position is not None:
        known = depth if "depth" in planes else None
        seen = surface & np.isfinite(position).all(-1)
        if found := mismatch(camera, position, known, seen, origin=place.origin):
            notes.append(f"{place.cameras.path}: {found[0]}{IN_FRAME}{place.number}: {found[1]}")
    elif wanted:
        position = position_from_depth(camera, np.where(surface, depth, 1.0), origin=place.origin).astype(np.float32)
    return position
