"""What a sequence is, before a long run: every header, and the pixels of a few frames. No JAX; `svgf_jax.findings` judges."""

from collections import Counter
from collections.abc import Iterable
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from svgf_jax import geometry, noise
from svgf_jax.advising import absences
from svgf_jax.cameras import Camera, find_camera
from svgf_jax.estimates import Estimate, estimate
from svgf_jax.frames import LoadedFrame, Source, read_frame, read_planes, told_once
from svgf_jax.geometry import VIEW_Z, Z_AFTER_ALL, Fit
from svgf_jax.motion import Convention, parse_convention
from svgf_jax.noise import Fireflies
from svgf_jax.renderers import Table
from svgf_jax.roles import Roles
from svgf_jax.scan import Scan, require_sound, samples_per_pixel, scan_files
from svgf_jax.types import Config, Frame, Params
from svgf_jax.warping import Residual, Step, Verdict, find_convention, warp_residual

SIDE = 640  # pixels: of larger pictures, noise, normals, depth and motion are judged in the middle, so many pixels each way
NOISY = 0.25  # noise relative to the light from which on it can be compared between frames
SHORT = 0.8  # share of pixels with history below which something is wrong


class Broken(NamedTuple):
    """Pixels of a role, in all frames read, with a component that is no number, infinite, or negative where that means nothing."""

    nan: int
    infinite: int
    negative: int


class Light(NamedTuple):
    """A signal's noise relative to its light (None: nothing to judge by), and its fireflies."""

    noise: float | None
    fireflies: Fireflies


class Halves(NamedTuple):
    """What half floats do to the guides; None where they are not half.

    Attributes:
        position: largest rounding step of the positions, in distances between neighbouring pixels.
        motion: rounding step of the longest motion vectors (99th percentile), in pixels.
        clipped: pixels of the radiance at the largest half float, 65504.
    """

    position: float | None
    motion: float | None
    clipped: int | None


class Facts(NamedTuple):
    """What was found; the values of `findings.judge`. Shares are of the pixels with a surface, means over the frames read.

    Attributes:
        name: of the sequence.
        scan, roles: of all files.
        table: the renderer's (`svgf_jax.renderers`).
        warnings: what loading had to tell.
        size: width and height.
        crop: whether the data window is not the whole picture.
        samples: header attribute and samples per pixel.
        read: frame numbers whose pixels were read.
        light: by signal.
        psnr: in dB, of the noisy picture against a converged one, by its own noise.
        correlation: of the noise between neighbouring pixels, of the noisiest signal.
        spread: deviation of that noise, of light brought to 0 ... 1 (`noise.bounded`).
        repeated: correlation of the noise from frame to frame, likewise.
        broken: by role, where there is anything.
        background: share of all pixels.
        repaired: pixels repaired on loading, by reason (`frames.LoadedFrame`).
        packed: whether normals look as if brought to 0 ... 1.
        below: share of the depths that are negative.
        cameras: whether they tell the motion where no channel does.
        normals, depth: what they fit; normals as in the files if a camera is known, depth as read.
        halves: hazards of half floats.
        motion: which conventions the motion vectors fit; None without two frames in a row or motion vectors in screen space.
        moved: surface pixels that show another surface than the frame before, edges left out; in the pair with more.
        warped: how well the motion that the filter gets leads to the frame before; None without two frames in a row.
        continuity: whether the previous frame has what each pixel shows; None without two frames in a row.
        lost: the test of history ("id", "depth", "normal") by which most is lost, where that is much.
        history: mean history length to expect; None without two frames in a row, and of other methods than svgf.
        needs: of a run.
    """

    name: str
    scan: Scan
    roles: Roles
    table: Table
    warnings: tuple[str, ...]
    size: tuple[int, int]
    crop: bool
    samples: tuple[str, float] | None
    read: tuple[int, ...]
    light: dict[str, Light]
    psnr: float | None
    correlation: float | None
    spread: float | None
    repeated: float | None
    broken: dict[str, Broken]
    background: float
    repaired: dict[str, int]
    packed: bool
    below: float
    cameras: bool
    normals: Fit | None
    depth: Fit | None
    halves: Halves
    motion: Verdict | None
    moved: int
    warped: Residual | None
    continuity: geometry.Continuity | None
    lost: str
    history: float | None
    needs: Estimate


class _Read(NamedTuple):
    """A frame, its planes by role as in the files, and of both the middle; `corner` is where that begins (x, y)."""

    loaded: LoadedFrame
    planes: dict[str, np.ndarray]
    camera: Camera | None
    frame: Frame
    inner: dict[str, np.ndarray]
    corner: tuple[int, int]


class _Noise(NamedTuple):
    """What one frame's radiance says; `where` noise can be judged; `lights` are the signals' luminances."""

    signals: tuple[Light, ...]
    psnr: float | None
    where: np.ndarray
    lights: np.ndarray


def inspect_source(source: Source, *, params: Any = Params(), config: Any = Config()) -> Facts:
    """Find out all of it. Raises SvgfError where not even the frames in question can be read.

    `params` and `config` are those of a run; of other methods than svgf, whose tests of history are their own, no length is told.
    """
    tests = params if isinstance(params, Params) else Params()
    scan = scan_files(source)
    known = source.roles.layers.keys()
    source = source._replace(position="position" in known or (source.cameras is not None and "depth" in known))
    pairs = _pairs(source, scan)
    read = {index: _load(source, index) for index in sorted({index for pair in pairs for index in pair})}
    noises = {index: _noise(one.frame) for index, one in read.items()}
    steps = [(read[before], read[now]) for before, now in pairs if before != now]
    near = [_correlation(read[b], noises[b], *((read[a], noises[a]) if a != b else (None, None))) for a, b in pairs]
    left, top, right, bottom = source.data_window
    width, height = right - left + 1, bottom - top + 1
    screen_left, screen_top, screen_right, screen_bottom = source.display_window
    matched = [geometry.continuity(a.loaded.frame, b.loaded.frame, params=tests) for a, b in steps]
    share, still = _mean(one.share for one in matched), _mean(one.still for one in matched)
    most = float(np.max(tests.max_history))
    last = read[max(read)]
    told = set(absences(source.roles, source.cameras, source.table).values())  # the roles say it themselves
    return Facts(
        name=source.sequence.name,
        scan=scan,
        roles=source.roles,
        table=source.table,
        warnings=told_once(
            [
                *(one for one in source.warnings if one not in told),
                *(note for one in read.values() for note in one.loaded.notes),
            ]
        ),
        size=(width, height),
        crop=source.data_window != source.display_window,
        samples=samples_per_pixel(scan.attributes, like=_layer(source.roles)),
        read=tuple(one.loaded.number for one in read.values()),
        light={
            name: Light(
                _mean(one.signals[at].noise for one in noises.values()),
                Fireflies(*np.mean([one.signals[at].fireflies for one in noises.values()], axis=0).tolist()),
            )
            for at, name in enumerate(source.roles.signals)
        },
        psnr=_mean(one.psnr for one in noises.values()),
        correlation=_mean(one.correlation for one in near),
        spread=_mean(one.spread for one in near),
        repeated=_mean(_repeated(read[a], read[b], noises[a], noises[b]) for a, b in pairs if a != b),
        broken=_broken(source.roles, read.values()),
        background=float(np.mean([(np.asarray(one.loaded.frame.object_id) == -1).mean() for one in read.values()])),
        repaired=dict(sum((Counter(one.loaded.counts) for one in read.values()), Counter())),
        packed=_packed(last.inner),
        below=_below(source.roles, last.planes),
        cameras=source.cameras is not None and bool(source.roles.layers.keys() & {"depth", "position"}),
        normals=_normals(last),
        depth=_depth(source, last),
        halves=_halves(source, last),
        motion=None
        if declared(source.roles).unit == "world"
        else _motion(steps, (screen_right - screen_left + 1, screen_bottom - screen_top + 1)),
        moved=max((_moved(a.frame, b.frame) for a, b in steps), default=0),
        warped=_warped(steps),
        continuity=None if share is None or still is None else geometry.Continuity(share, still),
        lost=_lost(steps, tests) if share is not None and share < SHORT else "",
        history=None
        if share is None or tests is not params
        else geometry.expected_length(share, frames=len(scan.there), most=most),
        needs=estimate(scan, pixels=width * height, signals=len(source.roles.signals), config=config),
    )


def _layer(roles: Roles) -> str:
    """What stands before the radiance's channels: a view layer's name, for renderers that have them."""
    return roles.layers[roles.signals[0]].channels[0].partition(".")[0] if roles.signals[0] in roles.layers else ""


def declared(roles: Roles) -> Convention:
    """The convention that motion vectors are taken to follow."""
    layer = roles.layers.get("motion")
    return parse_convention(layer.meaning if layer else "")


def _pairs(source: Source, scan: Scan) -> list[tuple[int, int]]:
    """Two frames in a row at the beginning and in the middle; (i, i) where none are in a row."""
    files = source.sequence.files
    there = [i for i, (number, path) in enumerate(files) if path is not None and number not in scan.damaged]
    if not there:
        require_sound(scan)
    rows = [(a, b) for a, b in pairwise(there) if files[b][0] == files[a][0] + 1]
    return list(dict.fromkeys([rows[0], rows[len(rows) // 2]])) if rows else [(there[0], there[0])]


def _load(source: Source, index: int) -> _Read:
    loaded = read_frame(source, index)
    camera = find_camera(source.cameras, loaded.number) if source.cameras is not None else None
    planes, _ = read_planes(source, index, image=loaded.image)
    x, y = (max(0, (size - SIDE) // 2) for size in loaded.frame.depth.shape[::-1])
    cut = np.s_[y : y + SIDE, x : x + SIDE]
    whole = loaded.frame._asdict().items()
    parts: list[Any] = [
        None if value is None else value[:, *cut] if name in ("radiance", "albedo", "variance") else value[cut]
        for name, value in whole
    ]
    return _Read(loaded, planes, camera, Frame(*parts), {role: plane[cut] for role, plane in planes.items()}, (x, y))


def _noise(frame: Frame) -> _Noise:
    where, surface = noise.uniform(frame), np.asarray(frame.object_id) != -1
    lights = noise.illumination(frame)
    signals = tuple(Light(noise.relative_noise(light, where), noise.fireflies(light, surface)) for light in lights)
    return _Noise(signals, noise.expected_psnr(noise.beauty(frame), where, float(surface.mean())), where, lights)


def _correlation(now: _Read, noise_now: _Noise, before: _Read | None, noise_before: _Noise | None) -> noise.Neighbours:
    """Of the signal with the most noise, by what changed since the frame before if there is one: texture is no noise."""
    found = []
    for at, light in enumerate(noise_now.lights):
        if before is None or noise_before is None:
            surface = np.asarray(now.frame.object_id) != -1
            found.append(noise.neighbours(noise.bounded(light, surface), now.frame))
        else:
            changed = noise.change(light, noise_before.lights[at], now.frame, before.frame)
            found.append(noise.neighbours(*changed))
    return max(found, key=lambda one: one.spread)


def _repeated(before: _Read, now: _Read, noise_before: _Noise, noise_now: _Noise) -> float | None:
    """Of the signal with the most noise for its light."""
    which = int(np.argmax([one.noise or 0.0 for one in noise_now.signals]))
    if (noise_now.signals[which].noise or 0.0) < NOISY:
        return None
    same = np.asarray(before.frame.object_id) == np.asarray(now.frame.object_id)
    where = noise_before.where & noise_now.where & same
    with np.errstate(all="ignore"):
        moved = np.linalg.norm(now.frame.motion, axis=-1)
        moving, still = where & (moved >= 1), where & (moved < 0.01)
    return noise.repeated_noise(noise_now.lights[which], noise_before.lights[which], moving, still)


def _broken(roles: Roles, read: Iterable[_Read]) -> dict[str, Broken]:
    """Of guides, only where there is a surface: what is behind it may hold anything."""
    found: dict[str, Broken] = {}
    colors = {
        role for role in roles.layers if role in (*roles.light, "emission", "environment") or role.endswith("albedo")
    }
    for one in read:
        surface = np.asarray(one.loaded.frame.object_id) != -1
        for role, plane in one.planes.items():
            if np.isfinite(plane).all() and (role not in colors or plane.min() >= 0):
                continue
            counts = (
                surface
                if role in ("normal", "motion", "position") or role.endswith("albedo")
                else np.ones_like(surface)
            )
            infinite = np.isinf(plane) if role != "depth" else np.isneginf(plane)
            kinds = (np.isnan(plane), infinite, (plane < 0) & np.isfinite(plane) & (role in colors))
            sums = [int((kind.any(-1) & counts).sum()) for kind in kinds]
            if any(sums):
                found[role] = Broken(*(a + b for a, b in zip(found.get(role, (0, 0, 0)), sums, strict=True)))
    return found


def _packed(planes: dict[str, np.ndarray]) -> bool:
    """Whether normals lie between 0 and 1, and would be of unit length if stretched to -1 ... 1."""
    if "normal" not in planes:
        return False
    normal = planes["normal"][np.isfinite(planes["normal"]).all(-1) & (planes["normal"] != 0).any(-1)]
    if len(normal) < geometry.LEAST or normal.min() < 0 or normal.max() > 1.01:
        return False
    lengths = (np.abs(np.linalg.norm(vectors, axis=-1) - 1) for vectors in (normal, 2 * normal - 1))
    plain, stretched = (float(np.median(apart)) for apart in lengths)
    return stretched < 0.02 < plain


def _below(roles: Roles, planes: dict[str, np.ndarray]) -> float:
    if "depth" not in planes:
        return 0.0
    front = -1 if roles.layers["depth"].meaning == "z-back" else 1
    with np.errstate(all="ignore"):
        return float((front * planes["depth"] < 0).mean())


def _normals(one: _Read) -> Fit | None:
    frame = one.frame
    if "normal" not in one.planes or frame.position is None:
        return None
    stored = None if one.camera is None else one.inner["normal"]  # without a camera, all stays in the positions' space
    return geometry.normal_space(frame, np.asarray(frame.position), one.camera, normals=stored)


def _depth(source: Source, one: _Read) -> Fit | None:
    if "depth" not in one.planes:
        return None
    fit = _depth_kind(source, one, np.asarray(one.frame.depth))
    if fit and VIEW_Z not in fit.best and source.roles.layers["depth"].meaning == "distance" and one.camera is not None:
        stored = _depth_kind(source, one, one.inner["depth"][..., 0])
        fit = stored._replace(best=(Z_AFTER_ALL,)) if stored and stored.best == (VIEW_Z,) else fit
    return fit


def _depth_kind(source: Source, one: _Read, depth: np.ndarray) -> Fit | None:
    frame = one.frame
    surface = np.asarray(frame.object_id) != -1
    if one.camera is not None and "position" in one.planes:
        return geometry.depth_by_position(depth, np.asarray(frame.position), one.camera, surface)
    (left, top, *_), (screen_left, screen_top, *_) = source.data_window, source.display_window
    origin = (left - screen_left + one.corner[0], top - screen_top + one.corner[1])
    return geometry.depth_by_planes(depth, frame, camera=one.camera, origin=origin)


def _halves(source: Source, one: _Read) -> Halves:
    surface = np.asarray(one.frame.object_id) != -1
    position = motion = clipped = None
    with np.errstate(all="ignore"):
        if "position" in source.half and surface.any():
            plane = one.inner["position"]
            apart = np.linalg.norm(plane[:, 1:] - plane[:, :-1], axis=-1)[surface[:, 1:] & surface[:, :-1]]
            apart = apart[np.isfinite(apart)]
            steps = np.spacing(np.abs(plane[surface]).astype(np.float16)).astype(np.float32)
            position = float(np.nanmedian(steps.max(-1)) / max(np.median(apart), 1e-30)) if len(apart) else None
        if "motion" in source.half and surface.any():
            longest = np.nanquantile(np.abs(one.inner["motion"][surface]), 0.99)
            motion = float(np.spacing(np.float16(longest)))
        signals = [role for role in source.roles.signals if role in source.half and role in one.inner]
        if signals:
            clipped = int(sum((one.inner[role] >= 65504).any(-1).sum() for role in signals))
    return Halves(position, motion, clipped)


def _motion(steps: list[tuple[_Read, _Read]], size: tuple[int, int]) -> Verdict | None:
    if not steps or "motion" not in steps[0][1].planes:
        return None
    return find_convention([Step(a.frame, b.frame, b.inner["motion"], a.inner["motion"]) for a, b in steps], size=size)


def _moved(before: Frame, now: Frame) -> int:
    """Pixels in the middle of 3 x 3 of one surface in both frames, and not of the same: jitter does not bring that about."""
    depths = [np.asarray(frame.depth, np.float64) for frame in (before, now)]
    with np.errstate(all="ignore"):
        turned = (before.normal * now.normal).sum(-1) < noise.ALIKE
        apart = np.abs(depths[1] - depths[0]) > 0.05 * np.maximum(*depths)
    differs = (np.asarray(before.object_id) != np.asarray(now.object_id)) | turned | apart
    count = int((noise.uniform(before) & noise.uniform(now) & differs).sum())
    return count if count >= geometry.LEAST // 4 else 0


def _warped(steps: list[tuple[_Read, _Read]]) -> Residual | None:
    """Of the pair that is worse off."""
    found = [warp_residual(a.frame, b.frame, np.asarray(b.frame.motion)) for a, b in steps]
    told = [one for one in found if np.isfinite(one.pixels)]
    return max(told, key=lambda one: one.pixels) if told else None


def _lost(steps: list[tuple[_Read, _Read]], params: Params) -> str:
    """Of all pairs of frames, if they agree."""
    found = {geometry.lost_by(a.loaded.frame, b.loaded.frame, params=params) for a, b in steps}
    return found.pop() if len(found) == 1 else ""


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
