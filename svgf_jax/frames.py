"""From files to frames: open a sequence, read its frames as NumPy arrays in the conventions of `svgf_jax.types`.

A pixel has no surface (`object_id` -1) if any of what is there says so: id -1, alpha 0, a zero normal, a depth that
is not finite, <= 0 or >= 1e8. Its guides become 0. Normals are brought to unit length. Radiance is left as it is:
what is not finite in it the filter repairs and counts.
"""

import os
import warnings
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from svgf_jax import exr, memory, renderers
from svgf_jax.advising import advice
from svgf_jax.assembly import IN_FRAME, Place, assemble, check_roles, meaning_of
from svgf_jax.camera_files import find_cameras
from svgf_jax.cameras import Cameras
from svgf_jax.exr_layout import PathName, Window
from svgf_jax.limits import Limits, limits
from svgf_jax.motion import parse_convention
from svgf_jax.roles import Roles, canonical_role, check_channels, left_out, resolve_roles
from svgf_jax.sequences import Missing, Sequence, beside, companion, find_sequence, patterns
from svgf_jax.types import Frame, SvgfError

_BESIDE = ("emission", "albedo", "normal", "depth", "motion", "id", "position")


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
        most: how large a picture may be that is read.
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
    most: Limits
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
    meaning: Mapping[str, str] | None = None,
    position: bool = False,
    max_pixels: int | None = None,
    max_ratio: int | None = None,
) -> Source:
    """Find the files of a sequence and settle the roles by the first frame's header; no pixel is read.

    Args:
        pattern: a folder, a pattern such as `frame_####.exr`, or one file.
        frames: a range such as `1-100`, `1-100x2`; all that are there if None.
        missing: what to do about missing frames: "error", "hold" or "reset".
        warmup: also so many frames before them, to fill the history (see `find_sequence`).
        channel: role -> channel names, where they are not the native ones (see `svgf_jax.roles`); ["none"] = leave it out.
        file: role -> pattern of files that hold this role.
        cameras: a cameras.json, or GAMES202's `matrix_#.mat`; "auto" takes those beside the frames if there are any,
            None none.
        renderer: whose names and conventions: a name of `svgf_jax.renderers`, a table of one's own (`mine.toml`), or "auto":
            by the names of channels, header attributes and files.
        layer: the view layer, where a file has several.
        motion: what the motion vectors mean, in place of what the renderer's table says: words of `svgf_jax.motion`.
        meaning: role -> what other numbers mean, likewise: words of `svgf_jax.renderers`.
        position: also give each frame its world positions, which the joint bilateral filter reads: the renderer's, or from
            depth and cameras.
        max_pixels: refuse larger pictures; those of more than 2**28 pixels if None.
        max_ratio: refuse files that claim more than 256 MB of pixels and so many times their own bytes; 1100 if None.

    Raises SvgfError: whatever is missing or unclear, naming the file.
    """
    table = None if renderer == "auto" else renderers.load_table(renderer)
    means = dict(meaning or {})
    for role, text in means.items():
        renderers.check_meaning(role, text)
    means |= {} if motion is None else {"motion": str(parse_convention(motion))}
    sequence = _find_frames(pattern, table, frames=frames, missing=missing, warmup=warmup)
    at, path = next((i, path) for i, (_, path) in enumerate(sequence.files) if path is not None)
    most = limits(max_pixels, max_ratio)
    read_header = partial(exr.read_header, most=most)
    header = read_header(path)
    there = patterns(os.path.dirname(path))
    table = table or renderers.detect_renderer(header.channels, header.attributes, tuple(there))
    channels = renderers.in_layer(table, tuple(header.channels), layer, where=path)
    files = {canonical_role(role): companion(sequence, where) for role, where in (file or {}).items()}
    own = {role: (str(other.files[at][1]), read_header(str(other.files[at][1]))) for role, other in files.items()}

    def settle(found: Iterable[str] = ()) -> Roles:
        names = {role: (name, tuple(other.channels)) for role, (name, other) in own.items()}
        return resolve_roles(
            channels, channel=channel, files=names, beside=tuple(found), table=table, meaning=means, where=path
        )

    roles = settle()
    settled = roles.layers.keys() | left_out(channel)
    near = {role: where for role in _BESIDE if role not in settled and (where := _beside(sequence, role))}
    for role, globs in table.files.items():
        if role not in settled and (where := renderers.find_file(role, globs, there, where=path)):
            near[role] = where
    if near:
        files |= {role: companion(sequence, where) for role, where in near.items()}
        own |= {role: (str(files[role].files[at][1]), read_header(str(files[role].files[at][1]))) for role in near}
        roles = settle(near)
    files = {role: other for role, other in files.items() if role in roles.layers}
    found = find_cameras(cameras, sequence, header, path, elsewhere=table.cameras)
    check_roles(roles, found, position=position, where=path)
    if found and roles.layers.keys() & {"depth", "position"} and "motion" not in roles.layers:
        roles = roles.told_by("motion", f"{found.path} says")
    if (
        "depth" not in roles.layers
        and "position" in roles.layers
        and (found or "camera" in meaning_of(roles, "position"))
    ):
        roles = roles.told_by("depth", "the positions say")
    half = set()
    for role, one in roles.layers.items():
        types = own[role][1].channels if one.own_file else header.channels
        if np.dtype(np.float16) in {types[name] for name in one.channels}:
            half.add(role)
    told = tuple(advice(roles, half, found, table._replace(uncertain=()) if "motion" in means else table))
    return Source(
        sequence,
        roles,
        files,
        frozenset(half),
        found,
        header.data_window,
        header.display_window,
        told,
        most,
        position,
        table,
    )


def read_frame(source: Source, index: int) -> LoadedFrame:
    """Read the frame `source.sequence.files[index]`. May be called from several threads at once.

    Raises SvgfError that names the file: missing, unreadable, of another size than the first frame, without a channel.
    """
    number, path = source.sequence.files[index]
    planes, image = read_planes(source, index)
    place = Place(number, _before(source, index), _origin(source), _screen_size(source), source.cameras)
    frame, counts, notes = assemble(
        source.roles,
        planes,
        place,
        half=source.half,
        position=source.position,
        motion_before=lambda: _motion_of(source, index - 1),
    )
    return LoadedFrame(frame, number, str(path), image, counts, notes)


def read_planes(
    source: Source, index: int, *, image: exr.Image | None = None
) -> tuple[dict[str, np.ndarray], exr.Image]:
    """The channels of each role of a frame as its files have them, `[H, W, C]`, and its main file. Raises as `read_frame`.

    `image` is the main file, where it has been read already.
    """
    number, path = source.sequence.files[index]
    if path is None:
        raise SvgfError(f"{source.sequence.name}: frame {number} is missing; render it, or go on without (--missing).")
    images = {path: _read(path, source) if image is None else image}
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
        first.setdefault(note.partition(IN_FRAME)[0], note)
    return tuple(first.values())


def _origin(source: Source) -> tuple[int, int]:
    """The first pixel's place on the screen."""
    (left, top, *_), (screen_left, screen_top, *_) = source.data_window, source.display_window
    return left - screen_left, top - screen_top


def _screen_size(source: Source) -> tuple[int, int]:
    """Width and height of the whole picture."""
    left, top, right, bottom = source.display_window
    return right - left + 1, bottom - top + 1


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
    image = exr.read(path, most=source.most)
    check_windows(image, path, source)
    return image


def _stack(image: exr.Image, channels: tuple[str, ...]) -> np.ndarray:
    """`[H, W, C]` float32, or float64 for 32-bit integers, which float32 does not hold."""
    pixels = [image.channels[name] for name in channels]
    whole = all(plane.dtype == np.uint32 for plane in pixels)
    out = memory.zeros((*pixels[0].shape, len(pixels)), np.float64 if whole else np.float32)
    return np.stack(pixels, -1, out=out)
