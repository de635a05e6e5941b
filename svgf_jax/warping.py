"""Which convention motion vectors follow, told by what they do to noise-free guides. Pure NumPy.

Right motion leads from a pixel to one of the frame before that shows the same point: the same position, normal, albedo and object.
So every convention can be tried, and what is left over be compared.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from svgf_jax.motion import CONVENTIONS, Convention, convert
from svgf_jax.types import Frame


class Step(NamedTuple):
    """Two frames in a row, and the motion vectors as their files have them, `[H, W, 2 or more]`.

    `stored_before`, those of the frame before, may be None: then nothing is said of conventions to and from the next frame.
    """

    previous: Frame
    current: Frame
    stored: np.ndarray
    stored_before: np.ndarray | None = None


class Residual(NamedTuple):
    """How well motion leads from one frame's guides to those of the frame before.

    Attributes:
        pixels: how many pixels the motion is off, about: by how much the guides at its ends differ, in units of what
            they differ by from pixel to pixel; from 0 to `FARTHEST`. NaN where there is nothing to judge by.
        share: share of the judged pixels whose motion ends inside the picture.
        guides: the guides that this was judged by.
        judged: how many pixels.
    """

    pixels: float
    share: float
    guides: tuple[str, ...]
    judged: int


class Verdict(NamedTuple):
    """Which conventions fit.

    Attributes:
        residuals: by convention, the best first; `None` is no motion at all, and alone where all vectors are 0.
        fits: those that fit as well as the best. One: that is it. Several: the frames do not tell them apart. None:
            nothing fits, or no motion at all fits as well.
    """

    residuals: dict[Convention | None, Residual]
    fits: tuple[Convention, ...]


FARTHEST = 4.0
"""Pixels beyond which being wrong is not told apart any more."""

NEAR = 1.0
"""Pixels that motion may be off, by position: noise in the guides and jitter of the camera make about half of that."""

NOTHING = 1e-5
"""Vectors no longer than this are 0 but for rounding, whatever their unit."""

FEWEST, MOST = 16, 8192
"""Pixels from which on there is something to judge by; so many do."""


def warp_residual(previous: Frame, current: Frame, motion: np.ndarray, *, where: np.ndarray | None = None) -> Residual:
    """How well motion `[H, W, 2]` (pixels, as `Frame.motion`) leads from `current` to `previous`.

    The guides are read bilinearly where the motion ends and compared with this pixel's, in units of what neighbouring pixels
    differ by; ends outside the picture count `FARTHEST`. Where the camera moves and positions are there, they decide, by the
    median: what stands still has one position in both frames. Else normals, albedo, depths and object ids do, by the mean over
    the places where they change; from the depths' differences the camera's own part (linear in x z, y z, z and 1) is taken off.

    Args:
        previous, current: frames as loaded, NumPy arrays.
        motion: what is judged.
        where: `[H, W]`, the pixels to judge by (of many, some `MOST`); those that move at all if None.
    """
    if where is None:
        with np.errstate(all="ignore"):
            where = _length(motion) > 0.01
    return _judge(_scene(previous, current, where), motion)


def find_convention(steps: Sequence[Step], *, size: tuple[int, int] | None = None) -> Verdict:
    """Which of `CONVENTIONS` the motion vectors of a few pairs of frames follow.

    Conventions fit as well as the best if their residual is within 10 % (and a hundredth of a pixel) of its. The best fits
    only if it is below 0.8 of the residual of no motion at all, and by position within `NEAR`. The pixels that count are those
    that move by at least a tenth of what the fast ones do; without any vector, all that show a surface.

    Args:
        steps: pairs of frames; some three from different places of a sequence do.
        size: width and height of the whole picture, if the arrays are crops.
    """
    before = all(step.stored_before is not None for step in steps)
    lengths = [_length(_finite(step.stored[..., :2])) for step in steps]
    surfaces = [np.asarray(step.current.object_id) != -1 for step in steps]
    told = any((length[surface] > NOTHING).any() for length, surface in zip(lengths, surfaces, strict=True))
    candidates = [None, *(one for one in CONVENTIONS if told and (before or not one.from_frame_before))]
    judged: dict[Convention | None, list[Residual]] = {one: [] for one in candidates}
    for step, length, surface in zip(steps, lengths, surfaces, strict=True):
        fast = np.quantile(length[surface], 0.98) if surface.any() else 0.0
        scene = _scene(step.previous, step.current, length > 0.1 * fast if told else surface)
        for one in candidates:
            if one is None:
                motion = np.zeros((*surface.shape, 2), np.float32)
            else:
                motion = convert(step.stored, one, size=size, motion_before=step.stored_before)
            judged[one].append(_judge(scene, motion))
    means = {one: _mean(residuals) for one, residuals in judged.items()}
    ranked = dict(sorted(means.items(), key=lambda item: np.nan_to_num(item[1].pixels, nan=np.inf)))
    named = {one: residual.pixels for one, residual in ranked.items() if one is not None}
    best, still = next(iter(named.values()), np.nan), means[None].pixels
    if not best < 0.8 * still or any(off(one) for one in ranked.values() if one.pixels == best):
        return Verdict(ranked, ())
    return Verdict(ranked, tuple(one for one, value in named.items() if value <= 1.1 * best + 0.01))


def shown(pixels: float, form: str = ".2g") -> str:
    """`pixels` of a residual for people: at `FARTHEST` it may be any more."""
    return f"{FARTHEST:g} or more" if pixels > FARTHEST - 0.05 else f"{pixels:{form}}"


def off(residual: Residual) -> bool:
    """Whether motion is further off than noise and jitter explain; told by positions alone, which nothing hides."""
    return residual.guides == ("position",) and residual.pixels > NEAR


def _mean(residuals: Sequence[Residual]) -> Residual:
    """That of several pairs of frames, each by its number of pixels; pairs with nothing to judge by count for nothing."""
    told = [one for one in residuals if np.isfinite(one.pixels)]
    judged = sum(one.judged for one in told)
    if not told:
        return Residual(float("nan"), 0.0, (), 0)
    pixels = sum(one.pixels * one.judged for one in told) / judged
    share = sum(one.share * one.judged for one in told) / judged
    return Residual(pixels, share, max((one.guides for one in told), key=len), judged)


class _Guide(NamedTuple):
    """One guide: the previous frame's `[H, W, C]`, this one's at the judged pixels `[N, C]`, and its change there `[N]`."""

    name: str
    previous: np.ndarray
    here: np.ndarray
    change: np.ndarray


class _Scene(NamedTuple):
    """What motion is judged by: the pixels' rows and columns `[N]`, the guides, and where something was seen before."""

    rows: np.ndarray
    columns: np.ndarray
    guides: tuple[_Guide, ...]
    seen: np.ndarray


def _scene(previous: Frame, current: Frame, where: np.ndarray) -> _Scene:
    ids = np.asarray(current.object_id)
    surface = ids != -1
    rows, columns = np.nonzero(surface & where)
    camera_moves = 2 * len(rows) > surface.sum()
    if len(rows) > MOST:
        rows, columns = (one[:: -(-len(rows) // MOST)] for one in (rows, columns))
    ids_before = np.asarray(previous.object_id)
    seen = (ids_before != -1)[..., None].astype(np.float32)
    guides: list[_Guide] = []

    def add(name: str, before: np.ndarray, now: np.ndarray, change: np.ndarray) -> None:
        guides.append(_Guide(name, before, now[rows, columns], change[rows, columns]))

    if camera_moves and previous.position is not None and current.position is not None:
        now = _finite(current.position).astype(np.float64)
        steps = np.stack([np.fmin(*pair) for pair in _differences(now)])
        add("position", _finite(previous.position).astype(np.float64), now, steps.max(0))
        return _Scene(rows, columns, tuple(guides), seen)
    add("normal", _finite(previous.normal), _finite(current.normal), _spread(_finite(current.normal)))
    for i, (before, now) in enumerate(zip(previous.albedo, current.albedo, strict=True)):
        name = f"albedo {i}" if len(current.albedo) > 1 else "albedo"
        add(name, _finite(before), _finite(now), _spread(_finite(now)))
    now = np.maximum(_finite(current.depth), 1e-12)[..., None].astype(np.float64)
    add("depth", _finite(previous.depth)[..., None].astype(np.float64), now, _spread(np.log(now)) * now[..., 0])
    add("id", ids_before[..., None], ids[..., None], np.mean([other != ids for other in _around(ids)], 0))
    return _Scene(rows, columns, tuple(guides), seen)


def _judge(scene: _Scene, motion: np.ndarray) -> Residual:
    count = len(scene.rows)
    if count < FEWEST:
        return Residual(float("nan"), 0.0, (), count)
    size = np.array(motion.shape[1::-1])
    with np.errstate(all="ignore"):
        ends = np.stack([scene.columns, scene.rows], -1) + motion[scene.rows, scene.columns]
        inside: np.ndarray = np.logical_and.reduce((ends > -0.5) & (ends < size - 0.5), -1)
    share = float(inside.mean())
    if not inside.any():
        return Residual(FARTHEST, share, (), count)
    taps = _taps(ends[inside], size)
    found = {}
    for guide in scene.guides:
        errors = np.full(count, FARTHEST)
        errors[inside] = _apart(guide, scene, inside, taps) / np.maximum(guide.change[inside], 1e-12)
        errors = np.minimum(errors, FARTHEST)
        if guide.name == "position":
            found[guide.name] = np.median(errors)
        elif guide.change.sum() > 1e-3 * FEWEST:
            found[guide.name] = (errors * guide.change).sum() / guide.change.sum()
    return Residual(float(np.mean(list(found.values()))) if found else float("nan"), share, tuple(found), count)


def _apart(guide: _Guide, scene: _Scene, inside: np.ndarray, taps: "_Taps") -> np.ndarray:
    """`[N]`: how much a guide differs at both ends of those motions that end inside the picture."""
    here = guide.here[inside]
    if guide.name == "id":
        return taps.differ(guide.previous, here)
    there = taps.read(guide.previous)
    if guide.name != "depth":
        return _length(there - here)
    place = np.stack([scene.columns, scene.rows], -1)[inside] / max(guide.previous.shape)
    solid = taps.read(scene.seen)[:, 0] > 0.999
    return np.where(solid, _without_camera(there[:, 0], here[:, 0], place, solid), 0)


class _Taps(NamedTuple):
    """The 2 x 2 pixels around places: rows, columns and bilinear weights, each `[4, N]`."""

    rows: np.ndarray
    columns: np.ndarray
    weights: np.ndarray

    def read(self, array: np.ndarray) -> np.ndarray:
        """`[H, W, C]` read at the places: `[N, C]`."""
        return (self.weights[..., None] * array[self.rows, self.columns]).sum(0)

    def differ(self, array: np.ndarray, here: np.ndarray) -> np.ndarray:
        """By what weight the pixels of `[H, W, C]` differ from `[N, C]`: `[N]`."""
        return (self.weights * (array[self.rows, self.columns] != here).any(-1)).sum(0)


def _taps(places: np.ndarray, size: np.ndarray) -> _Taps:
    corner = np.floor(places)
    (x, y), (part_x, part_y) = corner.astype(np.int64).T, (places - corner).T
    columns, rows = np.stack([x, x + 1, x, x + 1]), np.stack([y, y, y + 1, y + 1])
    weights = np.stack([1 - part_x, part_x, 1 - part_x, part_x]) * np.stack([1 - part_y, 1 - part_y, part_y, part_y])
    return _Taps(np.clip(rows, 0, size[1] - 1), np.clip(columns, 0, size[0] - 1), weights)


def _without_camera(there: np.ndarray, z: np.ndarray, place: np.ndarray, known: np.ndarray) -> np.ndarray:
    """|difference of depths| less what a moving camera does to them, by least squares that leave out the worst."""
    terms = np.stack([place[:, 0] * z, place[:, 1] * z, z, np.ones_like(z)], -1)
    keep, apart = known, np.zeros_like(z)
    for _ in range(4):
        if keep.sum() < FEWEST:
            break
        answer = np.linalg.lstsq(terms[keep], there[keep], rcond=None)[0]
        apart = np.abs(there - terms @ answer)
        keep = known & (apart <= np.quantile(apart[known], 0.8))
    return apart


def _differences(array: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Distance of `[H, W, C]` to the neighbour before and after, along x and along y; the border has only one."""
    for axis in (1, 0):
        step = _length(np.diff(array, axis=axis))
        before, after = [(0, 0), (0, 0)], [(0, 0), (0, 0)]
        before[axis], after[axis] = (1, 0), (0, 1)
        yield np.pad(step, before, constant_values=np.nan), np.pad(step, after, constant_values=np.nan)


def _spread(array: np.ndarray) -> np.ndarray:
    """Mean distance of `[H, W, C]` to the neighbours."""
    return np.nanmean(np.stack([one for pair in _differences(array) for one in pair]), 0)


def _around(array: np.ndarray) -> tuple[np.ndarray, ...]:
    """The four neighbours of each pixel; beyond the border the pixel itself."""
    padded = np.pad(array, 1, mode="edge")
    return padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]


def _finite(array: Any) -> np.ndarray:
    return np.nan_to_num(np.asarray(array), posinf=0, neginf=0)


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt((vectors * vectors).sum(-1))
