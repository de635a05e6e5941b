"""From files to frames: open a sequence, read its frames as NumPy arrays in the conventions of `svgf_jax.types`.

A pixel has no surface (`object_id` -1) if any of what is there says so: id -1, alpha 0, a zero normal, a depth that
is not finite, <= 0 or >= 1e8. Its guides become 0. Normals are brought to unit length. Radiance is left as it is:
what is not finite in it the filter repairs and counts.
"""

import os
import warnings
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from svgf_jax import exr, renderers
from svgf_jax.advising import advice
from svgf_jax.camera_files import find_cameras
from svgf_jax.cameras import (
    Cameras,
    find_camera,
    mismatch,
    position_from_depth,
    previous_depth,
    reproject,
)
from svgf_jax.exr_layout import PathName, Window
from svgf_jax.motion import convert, parse_convention
from svgf_jax.planes import guides, in_world, light
from svgf_jax.reflections import signals_reflected
from svgf_jax.roles import Roles, canonical_role, check_channels, resolve_roles
from svgf_jax.sequences import Missing, Sequence, beside, companion, find_sequence, patterns
from svgf_jax.types import Frame, SvgfError

_BESIDE = ("emission", "albedo", "normal", "depth", "motion", "id", "position")
_IN_FRAME = " In frame "  # what follows it in a note are that frame's numbers


class Source(NamedTuple):
    """A sequence ready to be read: every file found, every role resolved.

    Attributes:
        sequence: the frames' files; `sequence.missing` says what a missing one means.
        roles: which channel plays which role.
        files: the files of the roles that have their own.
        half: the roles that are stored in half float.
        cameras: from cameras.json, if there is one.
        data_window, display_window: of the first frame; every frame must have the same.
        warnings: what the user should know before the work starts, as sentences.
        max_pixels: largest picture that will be read.
        position: whether frames get their `Frame.position`.
        table: the renderer's table (`svgf_jax.renderers`).
    """

    sequence: Sequence
    roles: Roles
    files: dict[str, Sequence]
    half: frozenset[str]
    cameras: Cameras | None
    data_window: Window
    display_window: Window
    warnings: tuple[str, ...]
    max_pixels: int
    position: bool = False
    table: renderers.Table = renderers.NATIVE


class LoadedFrame(NamedTuple):
    """One frame, read.

    Attributes:
        frame: NumPy arrays, float32 (`object_id` int32).
        number, path: frame number and main file.
        image: the main file as it was, to pass its other layers through.
        counts: pixels repaired, by reason: `normal` (not of unit length by more than 1 %), `guides` (a hit by id or
            alpha, but no usable depth or normal), `excess` (emission above the beauty that should contain it), `rest` (beauty
            beyond all kinds of light that are there; it stays unfiltered).
        notes: what else is odd about it, as sentences.
    """

    frame: Frame
    number: int
    path: str
    image: exr.Image
    counts: dict[str, int]
    notes: tuple[str, ...]


def open_source(
    pattern: PathName,
    *,
    frames: str | None = None,
    missing: Missing = "error",
    warmup: int | None = None,
    channel: Mapping[str, Iterable[str]] | None = None,
    file: Mapping[str, PathName] | None = None,
    cameras: PathName | None = "auto",
    renderer: str = "auto",
    layer: str | None = None,
    motion: str | None = None,
    position: bool = False,
    max_pixels: int = exr.MAX_PIXELS,
) -> Source:
    """Find the files of a sequence and settle the roles by the first frame's header; no pixel is read.

    Args:
        pattern: a folder, a pattern such as `frame_####.exr`, or one file.
        frames: a range such as `1-100`, `1-100x2`; all that are there if None.
        missing: what to do about missing frames: "error", "hold" or "reset".
        warmup: also so many frames before them, to fill the history (see `find_sequence`).
        channel: role -> channel names, where they are not the native ones (see `svgf_jax.roles`).
        file: role -> pattern of files that hold this role.
        cameras: a cameras.json, or GAMES202's `matrix_#.mat`; "auto" takes those beside the frames if there are any,
            None none.
        renderer: whose names and conventions: a name of `svgf_jax.renderers`, a table of one's own (`mine.toml`), or "auto":
            by the names of channels, header attributes and files.
        layer: the view layer, where a file has several.
        motion: what the motion vectors mean, in place of what the renderer's table says: words of `svgf_jax.motion`.
        position: also give each frame its world positions, which the joint bilateral filter reads: the renderer's, or from
            depth and cameras.
        max_pixels: refuse larger pictures.

    Raises SvgfError: whatever is missing or unclear, naming the file.
    """
    table = None if renderer == "auto" else renderers.load_table(renderer)
    meaning = {} if motion is None else {"motion": str(parse_convention(motion))}
    sequence = _find_frames(pattern, table, frames=frames, missing=missing, warmup=warmup)
    at, path = next((i, path) for i, (_, path) in enumerate(sequence.files) if path is not None)
    header = exr.read_header(path)
    there = patterns(os.path.dirname(path))
    table = table or renderers.detect_renderer(header.channels, header.attributes, tuple(there))
    channels = renderers.in_layer(table, tuple(header.channels), layer, where=path)
    files = {canonical_role(role): companion(sequence, where) for role, where in (file or {}).items()}
    own = {role: (str(other.files[at][1]), exr.read_header(str(other.files[at][1]))) for role, other in files.items()}

    def settle(found: Iterable[str] = ()) -> Roles:
        names = {role: (name, tuple(other.channels)) for role, (name, other) in own.items()}
        return resolve_roles(
            channels, channel=channel, files=names, beside=tuple(found), table=table, meaning=meaning, where=path
        )

    roles = settle()
    near = {role: where for role in _BESIDE if role not in roles.layers and (where := _beside(sequence, role))}
    for role, globs in table.files.items():
        if role not in roles.layers and (where := renderers.find_file(role, globs, there, where=path)):
            near[role] = where
    if near:
        files |= {role: companion(sequence, where) for role, where in near.items()}
        own |= {role: (str(files[role].files[at][1]), exr.read_header(str(files[role].files[at][1]))) for role in near}
        roles = settle(near)
    files = {role: other for role, other in files.items() if role in roles.layers}
    found = find_cameras(cameras, sequence, header, path, elsewhere=table.cameras)
    if position and not ("position" in roles.layers or (found and "depth" in roles.layers)):
        raise SvgfError(
            f"{path}: no positions, and no depth with cameras to take them from. Wanted position.X, .Y, .Z "
            "(--file position=..., --channel position=...), or depth and a cameras.json."
        )
    if found and roles.layers.keys() & {"depth", "position"} and "motion" not in roles.layers:
        roles = roles._replace(absent=roles.absent | {"motion": f"{found.path} says"})
    if (
        "depth" not in roles.layers
        and "position" in roles.layers
        and (found or "camera" in _meaning(roles, "position"))
    ):
        roles = roles._replace(absent=roles.absent | {"depth": "the positions say"})
    if "world" in _meaning(roles, "motion") and not (found and roles.layers.keys() & {"depth", "position"}):
        raise SvgfError(
            f"{path}: motion in world space needs cameras, and positions or depth. Give a cameras.json (--cameras), or say what "
            "the motion vectors mean if this is wrong (--motion)."
        )
    half = set()
    for role, one in roles.layers.items():
        types = own[role][1].channels if one.own_file else header.channels
        if np.dtype(np.float16) in {types[name] for name in one.channels}:
            half.add(role)
    told = tuple(advice(roles, half, found, table._replace(uncertain=()) if meaning else table))
    return Source(
        sequence,
        roles,
        files,
        frozenset(half),
        found,
        header.data_window,
        header.display_window,
        told,
        max_pixels,
        position,
        table,
    )


def read_frame(source: Source, index: int) -> LoadedFrame:
    """Read the frame `source.sequence.files[index]`. May be called from several threads at once.

    Raises SvgfError that names the file: missing, unreadable, of another size than the first frame, without a channel.
    """
    number, path = source.sequence.files[index]
    planes, image = read_planes(source, index)
    counts: dict[str, int] = {}
    notes: list[str] = []
    with np.errstate(all="ignore"):  # whatever is not finite is dealt with by name below, or by the filter
        radiance, albedo, emission = light(source.roles, planes, counts)
        camera = None if source.cameras is None else find_camera(source.cameras, number)
        planes = in_world(source.roles, planes, camera, _origin(source))
        object_id, normal, depth = guides(source.roles, planes, radiance.shape[1:3], counts)
        motion, prev_depth = _past(source, index, planes, depth, object_id, notes)
        position = _position(source, number, planes, depth, object_id, notes)
        if "id" in source.half and (largest := np.fmax.reduce(planes["id"], axis=None)) > 2048:
            notes.append(
                f"object ids up to {largest:.0f} in half float: above 2048 neighbouring ids become one. "
                "Let the renderer write ids as 32-bit."
            )
    if counts.get("rest", 0) > 0.01 * object_id.size:
        notes.append(
            f"the light is more than its parts: what is in none of {', '.join(source.roles.signals)} stays unfiltered. Switch on "
            f"the passes that are missing.{_IN_FRAME}{number}: {100 * counts['rest'] / object_id.size:.3g} % of the pixels."
        )
    measured = [planes[f"{role}_variance"][..., 0] for role in source.roles.signals if f"{role}_variance" in planes]
    variance = np.stack(measured) if measured else None
    arrays: list[Any] = [radiance, albedo, emission, normal, depth, prev_depth, motion, object_id, variance]
    arrays.append(position if source.position else None)
    pair = {"number": number, "previous": _before(source, index), "origin": _origin(source)}
    arrays += signals_reflected(source.cameras, source.roles.signals, planes, depth, normal, object_id, **pair)
    counts = {reason: count for reason, count in counts.items() if count}
    return LoadedFrame(Frame(*arrays), number, str(path), image, counts, tuple(notes))


def read_planes(source: Source, index: int) -> tuple[dict[str, np.ndarray], exr.Image]:
    """The channels of each role of a frame as its files have them, `[H, W, C]`, and its main file. Raises as `read_frame`."""
    number, path = source.sequence.files[index]
    if path is None:
        raise SvgfError(f"{source.sequence.name}: frame {number} is missing; render it, or go on without (--missing).")
    images = {path: _read(path, source)}
    planes: dict[str, np.ndarray] = {}
    for role, layer in source.roles.layers.items():
        where = str(source.files[role].files[index][1]) if layer.own_file else path
        if where not in images:
            images[where] = _read(where, source)
        check_channels(layer, images[where].channels, where=where, role=role)
        planes[role] = _stack(images[where], layer.channels)
    return planes, images[path]


def load_sequence(pattern: PathName, **options: Any) -> Frame:
    """All frames of a sequence stacked along a leading T, ready for `svgf_jax.denoise`. Options: see `open_source`.

    What is odd about them is warned of (UserWarning), each thing once.
    """
    source = open_source(pattern, **options)
    with ThreadPoolExecutor(4) as pool:
        items = list(pool.map(lambda index: read_frame(source, index), range(len(source.sequence.files))))
    for note in told_once(note for item in items for note in item.notes):
        warnings.warn(note, stacklevel=2)
    frames = [item.frame for item in items]
    stacked: list[Any] = [None if planes[0] is None else np.stack(planes) for planes in zip(*frames, strict=True)]
    return Frame(*stacked)


def _beside(sequence: Sequence, role: str) -> str | None:
    """The pattern of the files beside the frames that are called after a role: normal_#.exr, ID_#.exr."""
    found = (beside(sequence, name) for name in (role, role.capitalize(), role.upper()))
    return next((where for where in found if where), None)


def _past(
    source: Source,
    index: int,
    planes: dict[str, np.ndarray],
    depth: np.ndarray,
    object_id: np.ndarray,
    notes: list[str],
) -> tuple[np.ndarray, np.ndarray]:
    """Motion `[H, W, 2]` and prev_depth `[H, W]` with respect to the frame that is read before this one."""
    number = source.sequence.files[index][0]
    before = _before(source, index)
    motion = planes.get("motion", np.zeros((*depth.shape, 2), np.float32))
    prev_depth = depth
    skipped = before is not None and before != number - 1
    convention = parse_convention(source.roles.layers["motion"].meaning if "motion" in planes else "")
    world = motion if convention.unit == "world" else None
    if "motion" in planes and world is None:
        later = None
        if convention.from_frame_before:
            later = np.zeros_like(motion) if before != number - 1 else _motion_of(source, index - 1)
        motion = convert(motion, convention, size=_screen_size(source), motion_before=later)
    if before is not None and source.cameras and planes.keys() & {"depth", "position"}:
        where: Any = {"number": number, "previous": before, "position": planes.get("position")}
        where["origin"] = _origin(source)
        if world is not None and not skipped:
            here = planes.get("position")
            if here is None:
                here = position_from_depth(find_camera(source.cameras, number), depth, origin=_origin(source))
            way = -1 if convention.direction == "from-previous" else 1
            where |= {"before": here + way * world, "position": here}
        if skipped or "motion" not in planes or world is not None:
            prev_depth, motion = reproject(source.cameras, depth, object_id, **where)
        else:
            prev_depth = previous_depth(source.cameras, depth, object_id, **where)
    elif world is not None:  # nothing before it
        motion = np.zeros((*depth.shape, 2), np.float32)
    elif skipped and "motion" in planes:
        notes.append(
            f"frame {number} follows frame {before}, but its motion vectors lead to frame {number - 1}; "
            "a cameras.json would tell the whole way."
        )
    sky = (object_id == -1)[..., None]
    return np.where(sky & ~np.isfinite(motion), 0, motion).astype(np.float32), prev_depth


def _motion_of(source: Source, index: int) -> np.ndarray:
    """The motion vectors of another frame, as its file has them."""
    layer = source.roles.layers["motion"]
    path = str((source.files["motion"] if layer.own_file else source.sequence).files[index][1])
    image = _read(path, source)
    check_channels(layer, image.channels, where=path, role="motion")
    return _stack(image, layer.channels)


def _before(source: Source, index: int) -> int | None:
    """The number of the frame that is read before this one."""
    earlier = (source.sequence.files[i] for i in range(index - 1, -1, -1))
    return next((other for other, path in earlier if path is not None), None)


def _position(
    source: Source,
    number: int,
    planes: dict[str, np.ndarray],
    depth: np.ndarray,
    object_id: np.ndarray,
    notes: list[str],
) -> np.ndarray | None:
    """World positions `[H, W, 3]`, if they are wanted or there; with cameras it is checked that they belong to them."""
    surface = object_id != -1
    position = planes.get("position")
    if source.cameras is None:
        return position
    camera = find_camera(source.cameras, number)
    if position is not None:
        known = depth if "depth" in planes else None
        seen = surface & np.isfinite(position).all(-1)
        if found := mismatch(camera, position, known, seen, origin=_origin(source)):
            notes.append(f"{source.cameras.path}: {found[0]}{_IN_FRAME}{number}: {found[1]}")
    elif source.position:
        position = position_from_depth(camera, np.where(surface, depth, 1.0), origin=_origin(source)).astype(np.float32)
    return position


def check_windows(image: exr.Image | exr.Header, path: str, source: Source) -> None:
    """Raise SvgfError where a file has other windows than the first frame."""
    if (image.data_window, image.display_window) != (source.data_window, source.display_window):
        raise SvgfError(
            f"{path}: data window {image.data_window} of {image.display_window}; wanted {source.data_window} of "
            f"{source.display_window}, as in the first frame. Render all files in one size, or denoise the parts as "
            "sequences of their own (--frames)."
        )


def told_once(notes: Iterable[str]) -> tuple[str, ...]:
    """Each note once; of those that only tell another frame's numbers, the first."""
    first: dict[str, str] = {}
    for note in notes:
        first.setdefault(note.partition(_IN_FRAME)[0], note)
    return tuple(first.values())


def _origin(source: Source) -> tuple[int, int]:
    """The first pixel's place on the screen."""
    (left, top, *_), (screen_left, screen_top, *_) = source.data_window, source.display_window
    return left - screen_left, top - screen_top


def _screen_size(source: Source) -> tuple[int, int]:
    """Width and height of the whole picture."""
    left, top, right, bottom = source.display_window
    return right - left + 1, bottom - top + 1


def _meaning(roles: Roles, role: str) -> list[str]:
    """The words of what a role's numbers mean."""
    return roles.layers[role].meaning.split() if role in roles.layers else []


def _find_frames(pattern: PathName, table: renderers.Table | None, **options: Any) -> Sequence:
    """The frames; in a folder of a renderer's files, those with the radiance."""
    text = os.fspath(pattern)
    if os.path.isdir(text):
        there = patterns(text)
        table = table or renderers.detect_renderer((), (), tuple(there))
        main = renderers.find_file("radiance", table.main, there, where=text)
        text = main or text
    return find_sequence(text, **options)


def _read(path: str, source: Source) -> exr.Image:
    image = exr.read(path, max_pixels=source.max_pixels)
    check_windows(image, path, source)
    return image


def _stack(image: exr.Image, channels: tuple[str, ...]) -> np.ndarray:
    """`[H, W, C]` float32, or float64 for 32-bit integers, which float32 does not hold."""
    planes = np.stack([image.channels[name] for name in channels], -1)
    return planes.astype(np.float64 if planes.dtype == np.uint32 else np.float32)
