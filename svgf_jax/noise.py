"""How noisy a frame's radiance is, judged by itself: no reference, and no JAX.

Noise is what differs between neighbours that show the same surface: the same object_id, nearly the same normal.
"""

from typing import NamedTuple

import numpy as np

from svgf_jax.types import Frame

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
ALIKE = 0.99
"""Least cosine between the normals of neighbours that count as the same surface."""
BLOCK = 16  # pixels each way of the blocks that medians are taken over
LEAST = 48  # pixels that a block must have to count
STILL = 0.03  # deviation of bounded light below which a block counts as free of noise: a tenth of the light

# J. Immerkaer, "Fast Noise Variance Estimation", 1996: blind to planes, and of variance 36 for white noise of variance 1.
_IMMERKAER = {(dx, dy): (-2 if dx else 4) * (-2 if dy else 4) // 4 for dx in (-1, 0, 1) for dy in (-1, 0, 1)}


class Fireflies(NamedTuple):
    """Pixels far above their neighbours: their share of the pixels with a surface, and of the light of these."""

    pixels: float
    light: float


class Neighbours(NamedTuple):
    """Deviation of bounded light (`bounded`), and the correlation of its noise between neighbouring pixels: 0 if independent."""

    spread: float
    correlation: float | None


def illumination(frame: Frame, *, albedo_floor: float = 1e-3) -> np.ndarray:
    """Luminance of the radiance without its albedo, `[S, H, W]`; what is not finite or negative is 0, as in the filter."""
    with np.errstate(all="ignore"):
        radiance = np.where(np.isfinite(frame.radiance) & (frame.radiance > 0), frame.radiance, 0)
        known = np.maximum(np.nan_to_num(frame.albedo, nan=1.0, posinf=1.0, neginf=0.0), albedo_floor)
        return (radiance / known) @ LUMINANCE


def beauty(frame: Frame) -> np.ndarray:
    """The noisy picture `[H, W, 3]` on x / (1 + x), in which errors are measured."""
    with np.errstate(all="ignore"):
        total = np.nan_to_num(frame.radiance, nan=0, posinf=65504).clip(0).sum(0) + np.nan_to_num(frame.emission)
    return total / (1 + np.maximum(total, 0))


def alike(frame: Frame, dx: int, dy: int) -> np.ndarray:
    """`[H, W]` bool: whether a pixel and that at (x + dx, y + dy) show the same surface. False at the border."""
    ids, normal = np.asarray(frame.object_id), np.asarray(frame.normal)
    there = (ids != -1) & (shifted(ids, dx, dy, -1) == ids)
    with np.errstate(all="ignore"):
        cosine = sum(normal[..., c] * shifted(normal[..., c], dx, dy, 0) for c in range(3))
    return there & (cosine > ALIKE)


def uniform(frame: Frame) -> np.ndarray:
    """`[H, W]` bool: pixels whose eight neighbours all show their surface."""
    found = np.asarray(frame.object_id) != -1
    for dx, dy in _IMMERKAER:
        if (dx, dy) > (0, 0):  # half of them: the others are these, seen from the neighbour
            pair = alike(frame, dx, dy)
            found = found & pair & shifted(pair, -dx, -dy, False)
    return found


def residual(values: np.ndarray) -> np.ndarray:
    """What no plane through 3 x 3 pixels explains of `values` `[H, W]`; white noise keeps its deviation, the border is 0."""
    total = np.zeros_like(values)
    inside = total[1:-1, 1:-1]
    height, width = values.shape
    for (dx, dy), weight in _IMMERKAER.items():
        inside += weight / 6 * values[1 + dy : height - 1 + dy, 1 + dx : width - 1 + dx]
    return total


def relative_noise(light: np.ndarray, where: np.ndarray) -> float | None:
    """Standard deviation of the noise of `light` `[H, W]` in units of the light itself, the median over blocks.

    `where` is `uniform`. None where there is no light on any surface large enough.
    """
    count, energy, total = (_by_block(values * where) for values in (1.0, residual(light) ** 2, light))
    judged = (count >= LEAST) & (total > 0)
    return float(np.median(np.sqrt(energy[judged] * count[judged]) / total[judged])) if judged.any() else None


def expected_psnr(picture: np.ndarray, where: np.ndarray, surface: float) -> float | None:
    """PSNR in dB that the noisy picture `[H, W, 3]` (on x / (1 + x)) has of a converged one, by its own noise.

    `surface` is the share of pixels that are noisy at all. None where no surface is large enough.
    """
    if not where.any():
        return None
    error = np.mean([np.mean(residual(picture[..., c])[where] ** 2) for c in range(3)]) * surface
    return float(-10 * np.log10(error)) if error > 0 else float("inf")


def bounded(light: np.ndarray, where: np.ndarray) -> np.ndarray:
    """`light` `[H, W]` on x / (x + its mean over a block), so that bright pixels do not decide what comes of it alone."""
    count, total = _by_block(1.0 * where), _by_block(light * where)
    mean = np.divide(total, count, out=np.zeros_like(total), where=count > 0)
    spread = np.zeros(light.shape)
    filled = mean.repeat(BLOCK, 0).repeat(BLOCK, 1)
    spread[: filled.shape[0], : filled.shape[1]] = filled
    return np.divide(light, light + spread, out=np.zeros(light.shape), where=(spread > 0) & where)


def change(light: np.ndarray, before: np.ndarray, frame: Frame, frame_before: Frame) -> tuple[np.ndarray, Frame]:
    """Bounded `light` less that of the frame before where the motion leads (nearest pixel), over the root of 2: noise, no texture.

    Also the frame, without a surface where it leads out of the picture.
    """
    height, width = light.shape
    with np.errstate(all="ignore"):
        to = np.nan_to_num(np.asarray(frame.motion, np.float64), nan=1e9).clip(-1e9, 1e9) + np.indices(light.shape)[
            ::-1
        ].transpose(1, 2, 0)
        x, y = np.rint(to).astype(np.int64).transpose(2, 0, 1)
    ids = np.asarray(frame.object_id)
    known = (ids != -1) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    there = bounded(before, np.asarray(frame_before.object_id) != -1)[np.where(known, y, 0), np.where(known, x, 0)]
    values = np.where(known, bounded(light, ids != -1) - there, 0) / np.sqrt(2)
    return values, frame._replace(object_id=np.where(known, ids, -1))


def neighbours(values: np.ndarray, frame: Frame) -> Neighbours:
    """How much `values` `[H, W]` (of `change`, or `bounded`) differ on the same surface, and how little less the nearest do.

    The correlation is 1 - D(1) / D(3), with D(n) the mean square difference over n pixels, into which what changes slowly
    hardly enters; medians over blocks. None where less than half of the blocks have noise.
    """
    near, far, pairs = 0.0, 0.0, 0.0
    for dx, dy in ((1, 0), (0, 1)):
        whole = alike(frame, dx, dy) & alike(frame, 2 * dx, 2 * dy) & alike(frame, 3 * dx, 3 * dy)
        pairs = pairs + _by_block(1.0 * whole)
        near = near + _by_block(whole * (shifted(values, dx, dy, 0) - values) ** 2)
        far = far + _by_block(whole * (shifted(values, 3 * dx, 3 * dy, 0) - values) ** 2)
    judged = pairs >= 2 * LEAST
    if not judged.any():
        return Neighbours(0.0, None)
    spread = np.sqrt(far[judged] / (2 * pairs[judged]))
    noisy = spread > STILL
    told = noisy.sum() >= max(4, 0.5 * judged.sum())
    correlation = float(np.median(1 - near[judged][noisy] / far[judged][noisy])) if told else None
    return Neighbours(float(np.median(spread)), correlation)


def repeated_noise(light: np.ndarray, before: np.ndarray, moving: np.ndarray, still: np.ndarray) -> float | None:
    """How much of the noise of the frame before is there again at the same pixels: 1 for the same random numbers, else 0.

    Of `moving` surfaces `[H, W]` (by a pixel or more) the correlation of what no plane explains; texture has moved on. Of
    those that are `still`, if too few move, the share of equal values. None where there is too little noise or light.
    """
    if moving.sum() >= 4 * LEAST:
        first, second = residual(bounded(light, moving))[moving], residual(bounded(before, moving))[moving]
        scale = np.sqrt((first**2).sum() * (second**2).sum())
        return float((first * second).sum() / scale) if scale > STILL**2 * moving.sum() else None
    lit = still & (light > 0)
    return _share((light == before)[lit].sum(), lit.sum()) if lit.sum() >= 4 * LEAST else None


def fireflies(light: np.ndarray, surface: np.ndarray, *, radius: int = 3, sigma: float = 10.0) -> Fireflies:
    """Pixels of `light` `[H, W]` more than `sigma` deviations above the mean of their neighbours, themselves left out.

    As `outliers.remove_outliers` judges: over (2 radius + 1)^2 pixels, those with a `surface`.
    """
    known = light * surface
    count = _window_sum(1.0 * surface, radius) - surface
    some = np.maximum(count, 1)
    mean = (_window_sum(known, radius) - known) / some
    spread = np.sqrt(np.maximum((_window_sum(known**2, radius) - known**2) / some - mean**2, 0))
    above = surface & (count >= 8) & (light > mean + sigma * spread + 1e-6)
    total = known.sum(dtype=np.float64)
    return Fireflies(_share(above.sum(), surface.sum()), _share(known[above].sum(dtype=np.float64), total))


def shifted(values: np.ndarray, dx: int, dy: int, fill: object) -> np.ndarray:
    """`values` `[H, W]` at (x + dx, y + dy); `fill` outside the picture."""
    height, width = values.shape
    out = np.full_like(values, fill)
    rows, columns = slice(max(0, -dy), height - max(0, dy)), slice(max(0, -dx), width - max(0, dx))
    out[rows, columns] = values[max(0, dy) : height + min(0, dy), max(0, dx) : width + min(0, dx)]
    return out


def _by_block(values: np.ndarray) -> np.ndarray:
    """Sums over blocks of BLOCK x BLOCK pixels; what does not fill one at the right and bottom is left out."""
    height, width = (size // BLOCK * BLOCK for size in values.shape)
    cut = values[:height, :width].astype(np.float64)
    return cut.reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK).sum((1, 3))


def _window_sum(values: np.ndarray, radius: int) -> np.ndarray:
    """Sums over (2 radius + 1)^2 pixels; outside the picture there is nothing."""
    for axis in (0, 1):
        ends = [(radius + 1, radius) if i == axis else (0, 0) for i in (0, 1)]
        running = np.pad(values.astype(np.float64), ends).cumsum(axis)
        width = 2 * radius + 1
        running = running if axis == 0 else running.T
        difference = running[width:] - running[:-width]
        values = difference if axis == 0 else difference.T
    return values


def _share(part: float, whole: float) -> float:
    return float(part / whole) if whole else 0.0
