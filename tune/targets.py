"""Do the targets belong to the frames? Noise is large, but means over blocks of pixels see through it."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from svgf_jax.metrics import display
from tune.shots import Shot

BLOCK = 16  # pixels on a side: with one sample a pixel, 93 % and more of the variance of such means is the picture's
# Four real sequences of one sample a pixel and their references: correlation .999 and more, slope .99 to 1.00, brightness 1.00.
# References of other shots: correlation -.16 to .14; of the next frame .75 to .96, then displaced; gamma-encoded: slope .43 to .58.
LEAST_CORRELATION = 0.9
SLOPES = 0.75, 4 / 3
RATIOS = 0.8, 1.25
PEAK = 1.15  # displaced by one pixel they fit 1.37 to 1.49 times as well where they belong
_BLOCKS, _RELIABLE = 64, 0.5  # with fewer, or mostly noise, or a picture without any contrast, nothing can be told
_FEW = 0.25  # variance of a block's mean / mean^2, where its light is that of four pixels; fireflies are fewer
_RARE = 0.1  # share of such blocks up to which they are fireflies; more are the noise itself, without which the rest is too dark
_BOX = 4  # radius; what is wider than this box says little about where things are


class Likeness(NamedTuple):
    """How like its targets a shot's frames are.

    Attributes:
        correlation: of the logarithms of means over blocks of pixels, freed from what noise takes off; nan: cannot be told.
        slope: d log(target) / d log(frame) likewise: 1 where both are scene-linear, 1 / 2.2 for a target with that gamma.
        ratio: mean of the targets / mean of the frames, without the blocks whose light is that of a few bright pixels where these
            are rare; nan: where they are not, but have most of the light.
        displacement: (dx, dy), in whole pixels, by which the targets would have to move to fit best.
        frames_not_finite, targets_not_finite: pixels.
        unknown: why the correlation cannot be told; "" where it can.
    """

    correlation: float
    slope: float
    ratio: float
    displacement: tuple[int, int]
    frames_not_finite: int
    targets_not_finite: int
    unknown: str = ""


def likeness(shot: Shot) -> Likeness:
    """Read all frames and targets of a shot once, and compare them."""
    darkest, brightest = np.inf, -np.inf
    bad = [0, 0]
    means, noises, match = [], [], None
    for noisy, target in _pairs(shot):
        known = [np.isfinite(image) for image in (noisy, target)]
        bad = [count + int((~finite).sum()) for count, finite in zip(bad, known, strict=True)]
        both = known[0] & known[1]
        images = [np.where(both, image, 0.0) for image in (noisy, target)]
        darkest, brightest = (
            pick(target, where=both, initial=so_far) for pick, so_far in ((np.min, darkest), (np.max, brightest))
        )
        mean, noise = zip(*map(_blocks, images), strict=True)
        means.append(mean)
        noises.append(noise)
        match = _match(*images) + (0 if match is None else match)
    if match is None:
        return Likeness(np.nan, np.nan, np.nan, (0, 0), bad[0], bad[1])
    all_means, all_noises = np.concatenate(means, axis=1), np.concatenate(noises, axis=1)
    many = np.asarray((all_noises <= _FEW * all_means**2).all(axis=0))
    correlation, slope, unknown = _related(all_means[:, many], all_noises[:, many])
    if unknown and brightest - darkest <= 1e-3 * abs(brightest):
        unknown = f"all pixels of the targets are {brightest:.3g}"
    return Likeness(correlation, slope, _brightness(all_means, many), _displacement(match), bad[0], bad[1], unknown)


def _brightness(means: np.ndarray, many: np.ndarray) -> float:
    """Light of the targets / light of the frames, from their blocks `[2, n]`; nan: there is none, or fireflies decide it.

    `many` `[n]`: whether a block's light is that of many pixels.
    """
    everything, rest = means.sum(axis=1), means[:, many].sum(axis=1)
    rare = many.mean() >= 1 - _RARE
    if not rare and rest[0] < everything[0] / 2:
        return np.nan
    frame, target = rest if rare else everything
    return float(target / frame) if frame > 0 else np.nan


def doubts(name: str, found: Likeness) -> tuple[str, ...]:
    """What a user should know, as sentences; () where all is as it should be."""
    said = []
    if found.frames_not_finite:
        said.append(
            f"{name}: {found.frames_not_finite} pixels of the frames are not finite: taken as in denoising, as 0"
        )
    if found.targets_not_finite:
        said.append(f"{name}: {found.targets_not_finite} pixels of the targets are not finite: they count for nothing")
    dx, dy = found.displacement
    if found.unknown:
        said.append(f"{name}: whether the targets belong to the frames cannot be told: {found.unknown}")
    if found.correlation < LEAST_CORRELATION:
        said.append(
            f"{name}: the targets do not look like the frames (block means correlate by {found.correlation:.2f}; "
            f"wanted {LEAST_CORRELATION:g} or more): are they of this shot, and are the frame numbers the same?"
        )
    elif (dx, dy) != (0, 0):
        said.append(
            f"{name}: the targets fit best moved by {dx} pixels in x and {dy} in y: are they of the same frames, and of the "
            "same crop?"
        )
    if not SLOPES[0] <= found.slope <= SLOPES[1] and not np.isnan(found.slope):
        said.append(
            f"{name}: the targets are about the frames to the power of {found.slope:.2f}: wanted scene-linear ones, "
            "without gamma or tone mapping"
        )
    elif not RATIOS[0] <= found.ratio <= RATIOS[1] and not np.isnan(found.ratio):
        said.append(
            f"{name}: the targets are {found.ratio:.2f} times as bright as the frames: is the exposure the same?"
        )
    return tuple(said)


def with_doubts(shot: Shot) -> Shot:
    """The shot, its doubts among its notes."""
    return shot._replace(notes=(*shot.notes, *doubts(shot.name, likeness(shot))))


def _pairs(shot: Shot) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Brightness of each frame as it came and of its target, `[H, W]`, where there is one; nan where it is not finite."""
    for index in range(shot.length):
        frame, target = shot.read(index)
        if target is not None:
            beauty = np.sum(np.asarray(frame.radiance, np.float64), axis=0) + np.asarray(frame.emission, np.float64)
            yield beauty.mean(axis=-1), np.asarray(target, np.float64).mean(axis=-1)


def _blocks(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means over blocks, and the variances of these means as their pixels tell them; flat."""
    height, width = (side // BLOCK for side in image.shape)
    blocks = image[: height * BLOCK, : width * BLOCK].reshape(height, BLOCK, width, BLOCK).swapaxes(1, 2)
    blocks = blocks.reshape(-1, BLOCK**2)
    return blocks.mean(axis=1), blocks.var(axis=1) / BLOCK**2


def _related(means: np.ndarray, noises: np.ndarray) -> tuple[float, float, str]:
    """Correlation and slope of the logarithms, with the share of noise (Spearman's correction for attenuation) taken out.

    The third says why they are nan, "" where they are known.
    """
    lit = (means > 1e-6).all(axis=0)
    if lit.sum() < _BLOCKS:
        size = f"{BLOCK} x {BLOCK} pixels"
        return (
            np.nan,
            np.nan,
            f"light is in {lit.sum()} blocks of {size} of both (fireflies left out); wanted {_BLOCKS} or more",
        )
    logs = np.log(means[:, lit])
    total, noise = logs.var(axis=1), (noises[:, lit] / means[:, lit] ** 2).mean(axis=1)
    picture = total - noise
    for what, one, all_of_it in zip(("frames", "targets"), picture, total, strict=True):
        if all_of_it < 1e-3:
            return np.nan, np.nan, f"the {what} have no contrast"
        if one < max(_RELIABLE * all_of_it, 1e-3):
            return np.nan, np.nan, f"the {what} are mostly noise"
    covariance = np.mean((logs[0] - logs[0].mean()) * (logs[1] - logs[1].mean()))
    return float(min(covariance / np.sqrt(picture.prod()), 1.0)), float(np.sqrt(picture[1] / picture[0])), ""


def _match(image: np.ndarray, target: np.ndarray) -> np.ndarray:
    """How well fine structures fit, for each displacement (periodic): the cross-correlation of what a box does not hold."""
    fine = [_fine(display(np.maximum(a, 0.0))) for a in (image, target)]
    spectra = [np.fft.rfft2(a) for a in fine]
    return np.fft.irfft2(spectra[0] * np.conj(spectra[1]), s=image.shape)


def _fine(image: np.ndarray) -> np.ndarray:
    """The image less its mean over a box, less and less of it towards the border."""
    width = 2 * _BOX + 1
    sums = np.pad(image, ((_BOX + 1, _BOX), (_BOX + 1, _BOX)), mode="edge").cumsum(axis=0).cumsum(axis=1)
    box = sums[width:, width:] - sums[:-width, width:] - sums[width:, :-width] + sums[:-width, :-width]
    return (image - box / width**2) * np.outer(*(np.hanning(side) for side in image.shape))


def _displacement(match: np.ndarray) -> tuple[int, int]:
    """(dx, dy) of the best fit; none where it is hardly better than where things are, or than noise."""
    peak = np.unravel_index(match.argmax(), match.shape)
    spread = 1.4826 * float(np.median(np.abs(match - np.median(match))))
    if match[peak] < max(PEAK * match[0, 0], match[0, 0] + 6 * spread, 12 * spread):
        return 0, 0
    dy, dx = ((int(at) + side // 2) % side - side // 2 for at, side in zip(peak, match.shape, strict=True))
    return dx, dy
