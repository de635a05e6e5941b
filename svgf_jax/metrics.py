"""Image and sequence quality against a reference, in NumPy (float64). No JAX.

All take scene-linear radiance, `image` and `reference` of shape `[H, W, C]`. PSNR, SSIM and the temporal error look at
`display(x) = x / (1 + x)` with x clamped at 0, so that a few very bright pixels do not decide the score; every mean
runs over pixels and channels alike. A nan in an image makes its scores nan, and with them those of its sequence.
"""

import importlib
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from svgf_jax.tonemapping import tonemap
from svgf_jax.types import SvgfError

SSIM_SIGMA, SSIM_RADIUS = 1.5, 5  # 11 x 11 Gaussian window, Wang et al. 2004
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2  # (K1 L)^2, (K2 L)^2 with the dynamic range L = 1 of `display`


class Scores(NamedTuple):
    """The scores of one frame, or of a sequence (`mean_scores`). `nan` where a score does not exist.

    Attributes:
        psnr: dB; `inf` for identical images.
        relmse: relative squared error.
        ssim: structural similarity, 1 for identical images; `nan` for images smaller than 11 pixels on a side.
        temporal: error of the change since the previous frame; `nan` for the first frame.
        flip: HDR-FLIP in [0, 1]; `nan` where it was not asked for.
    """

    psnr: float
    relmse: float
    ssim: float
    temporal: float
    flip: float


_TEMPORAL = Scores._fields.index("temporal")


def display(image: np.ndarray) -> np.ndarray:
    """`x / (1 + x)` of scene-linear `image`, negative values taken as 0: float64 in [0, 1]; +inf gives 1, nan nan."""
    return tonemap(np.asarray(image, np.float64))


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB: `-10 log10 mean((display(image) - display(reference))^2)`; inf where equal."""
    _check_shapes(image, reference)
    error = float(np.mean(np.square(display(image) - display(reference))))
    return float("inf") if error == 0 else -10.0 * float(np.log10(error))


def relmse(image: np.ndarray, reference: np.ndarray) -> float:
    """Relative squared error, `mean((x - r)^2 / (r^2 + 0.01))` on the radiance itself (Rousselle et al. 2011)."""
    _check_shapes(image, reference)
    x, r = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    with np.errstate(invalid="ignore"):  # inf - inf
        return float(np.mean(np.square(x - r) / (np.square(r) + 0.01)))


def ssim(image: np.ndarray, reference: np.ndarray) -> float:
    """Structural similarity of Wang et al. 2004, on `display` values, channel by channel.

    Gaussian window of 11 x 11 taps with sigma 1.5, K1 = 0.01, K2 = 0.03, L = 1, population covariances; mean over the
    pixels whose window lies inside the image, and over channels. nan below 11 pixels on a side. scikit-image calls it
    `structural_similarity` with `gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1`.
    """
    _check_shapes(image, reference)
    if min(np.shape(image)[:2]) < 2 * SSIM_RADIUS + 1:
        return float("nan")
    x, r = display(image), display(reference)
    mean_x, mean_r = _window_mean(x), _window_mean(r)
    variance_x, variance_r = _window_mean(x * x) - mean_x**2, _window_mean(r * r) - mean_r**2
    covariance = _window_mean(x * r) - mean_x * mean_r
    luminance = (2 * mean_x * mean_r + SSIM_C1) / (mean_x**2 + mean_r**2 + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (variance_x + variance_r + SSIM_C2)
    return float(np.mean(luminance * structure))


def temporal_error(
    image: np.ndarray, previous: np.ndarray, reference: np.ndarray, previous_reference: np.ndarray
) -> float:
    """Flicker: RMSE of `(d(image) - d(previous)) - (d(reference) - d(previous_reference))`, d = `display`.

    What changes from frame to frame in the image but not in the reference. 0 for a sequence that errs steadily.
    """
    for other in (previous, reference, previous_reference):
        _check_shapes(image, other)
    change, true_change = display(image) - display(previous), display(reference) - display(previous_reference)
    return float(np.sqrt(np.mean(np.square(change - true_change))))


def flip(image: np.ndarray, reference: np.ndarray) -> float:
    """Mean HDR-FLIP (Andersson et al. 2021) in [0, 1], lower is better, at FLIP's default viewing distance.

    Three-channel images; negative values count as 0; nan where either holds a nan. Needs the extra `flip`
    (NVIDIA's `flip-evaluator`); `SvgfError` without it.
    """
    _check_shapes(image, reference)
    if np.isnan(image).any() or np.isnan(reference).any():
        return float("nan")
    _, mean, _ = _flip_evaluator().evaluate(_for_flip(reference), _for_flip(image), "HDR", applyMagma=False)
    return float(mean)


def flip_map(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """FLIP of each pixel `[H, W]` in [0, 1] of pictures as they are shown: sRGB `[H, W, 3]` in [0, 1] (LDR-FLIP).

    HDR-FLIP, which `flip` gives, is the worst of this over many exposures, and takes that many times as long.
    """
    _check_shapes(image, reference)
    pair = (np.ascontiguousarray(np.clip(np.nan_to_num(x), 0, 1), np.float32) for x in (reference, image))
    return np.asarray(_flip_evaluator().evaluate(*pair, "LDR", inputsRGB=True, applyMagma=False)[0])[..., 0]


def require_flip() -> None:
    """Raise `SvgfError` where the extra `flip` is not installed, so that a long job finds out before it starts."""
    _flip_evaluator()


def score(
    image: np.ndarray,
    reference: np.ndarray,
    *,
    previous: tuple[np.ndarray, np.ndarray] | None = None,
    with_flip: bool = False,
    with_ssim: bool = True,
) -> Scores:
    """The scores of one frame. `previous` is the previous frame's (image, reference), None for the first."""
    return Scores(
        psnr=psnr(image, reference),
        relmse=relmse(image, reference),
        ssim=ssim(image, reference) if with_ssim else float("nan"),
        temporal=float("nan") if previous is None else temporal_error(image, previous[0], reference, previous[1]),
        flip=flip(image, reference) if with_flip else float("nan"),
    )


def score_frames(
    pairs: Iterable[tuple[np.ndarray, np.ndarray | None]], *, with_flip: bool = False, with_ssim: bool = True
) -> Iterator[Scores | None]:
    """The scores of consecutive frames (image, reference), one by one; None for a frame without a reference.

    A frame has a temporal error where the one before it has a reference, and their size is the same.
    """
    previous = None
    for image, reference in pairs:
        if reference is None:
            previous = None
            yield None
            continue
        if previous is not None and previous[0].shape != image.shape:
            previous = None
        yield score(image, reference, previous=previous, with_flip=with_flip, with_ssim=with_ssim)
        previous = image, reference


def mean_scores(scores: Iterable[Scores]) -> Scores:
    """The scores of a sequence from its frames': the plain mean, but for `temporal` the root mean square.

    Frames that have no such score (`absent`) do not count; nan where no frame has it, and where a frame is broken. The
    root mean square over frames of an RMSE is the RMSE over all pixels of the sequence.
    """
    rows = list(scores)
    if not rows:
        raise SvgfError("mean_scores got no frames; it wants the scores of at least one frame.")
    table = np.asarray(rows, np.float64)
    table[:, _TEMPORAL] **= 2
    known = [column[~none] for column, none in zip(table.T, absent(rows).T, strict=True)]
    means = Scores(*(float(np.mean(column)) if column.size else float("nan") for column in known))
    return means._replace(temporal=float(np.sqrt(means.temporal)))


def absent(scores: Sequence[Scores]) -> np.ndarray:
    """`[N, 5]` bool: which scores of consecutive frames do not exist, unlike those that are nan for the pixels' sake.

    The PSNR always exists, so that where it is nan the image is broken, and with it its other scores and the next
    frame's temporal error. The first frame has no temporal error in any case.
    """
    table = np.asarray(scores, np.float64).reshape(-1, len(Scores._fields))
    broken = np.isnan(table[:, 0])
    blamed = np.repeat(broken[:, None], table.shape[1], axis=1)
    blamed[1:, _TEMPORAL] |= broken[:-1]
    blamed[:1, _TEMPORAL] = False
    blamed[:, 1] = True
    blamed[:, 4] &= ~np.isnan(table[:, 4]).all()  # not asked for
    return np.isnan(table) & ~blamed


def _window_mean(plane: np.ndarray) -> np.ndarray:
    """Gaussian-weighted mean of `[H, W, C]` over the SSIM window, where it fits: `[H - 10, W - 10, C]`."""
    weights = np.exp(-0.5 * np.square(np.arange(-SSIM_RADIUS, SSIM_RADIUS + 1) / SSIM_SIGMA))
    weights /= weights.sum()
    for axis in (0, 1):
        length = plane.shape[axis] - 2 * SSIM_RADIUS
        taps = (np.take(plane, range(i, i + length), axis=axis) * w for i, w in enumerate(weights))
        plane = sum(taps, start=np.zeros(()))
    return plane


def _check_shapes(image: np.ndarray, reference: np.ndarray) -> None:
    if np.ndim(image) != 3 or np.shape(image) != np.shape(reference) or 0 in np.shape(image):
        raise SvgfError(
            f"Cannot compare images of shapes {np.shape(image)} and {np.shape(reference)}: "
            "wanted two images of one shape [height, width, channels]."
        )


def _for_flip(image: np.ndarray) -> np.ndarray:
    """FLIP wants finite, nonnegative, contiguous float32."""
    return np.ascontiguousarray(np.maximum(np.nan_to_num(image, posinf=65504.0), 0.0), np.float32)


def _flip_evaluator():
    """The module `flip_evaluator`: the only place that knows it."""
    try:
        return importlib.import_module("flip_evaluator")
    except ImportError as error:
        raise SvgfError(
            "HDR-FLIP was asked for, but the package flip-evaluator is not installed. "
            "Try `pip install 'svgf-jax[flip]'`, or leave FLIP out."
        ) from error
