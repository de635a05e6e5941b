"""Around a fit: the error along each number by itself, and where in the image each number matters."""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from svgf_jax import SvgfError, exr
from svgf_jax.threads import read_ahead
from tune.fitting import Fit
from tune.free import natural, to_free
from tune.residuals import Term
from tune.shots import Shot
from tune.sweep import frame_blocks, pose, sweep

STEPS = (-1.0, -0.5, -0.25, 0.0, 0.25, 0.5, 1.0)
"""Where a profile is taken, in free coordinates: from 1/e of a scale to e times it."""


class Profile(NamedTuple):
    """The error along one number, the others held: `values` of it and `losses` there, 1 = the error at the fit's start."""

    label: str
    values: np.ndarray
    losses: np.ndarray


class Sensitivity(NamedTuple):
    """Where numbers matter, mean over the frames of a shot.

    Attributes:
        error: `[H, W]`, the squared residuals.
        slopes: `[n, H, W]`, half their derivative in each free coordinate: negative where a larger number would be better.
    """

    error: np.ndarray
    slopes: np.ndarray


def profile(found: Fit, shots: Sequence[Shot], terms: Sequence[Term]) -> tuple[Profile, ...]:
    """The error along each number through the fitted point: a pass without derivatives for each of `STEPS` but one."""
    coordinates = found.coordinates
    problem = pose(coordinates, to_free(coordinates.start, coordinates), terms, shots)
    centre = sweep(problem, found.y, linear=False).loss
    curves = []
    for i, label in enumerate(coordinates.labels):
        points = [found.y + step * np.eye(found.y.size)[i] for step in STEPS]
        losses = [
            centre if step == 0 else sweep(problem, y, linear=False).loss for step, y in zip(STEPS, points, strict=True)
        ]
        values = [natural(y, coordinates)[i] for y in points]
        curves.append(Profile(label, np.array(values), np.array(losses)))
    return tuple(curves)


def sensitivity(found: Fit, shot: Shot, terms: Sequence[Term], *, tangent_batch: int = 8) -> Sensitivity:
    """Maps over a shot, of the terms that look at pixels; in the memory of one frame's derivatives."""
    coordinates = found.coordinates
    start = to_free(coordinates.start, coordinates)
    problem = pose(coordinates, start, terms, [shot], tangent_batch=tangent_batch)
    with closing(read_ahead(shot.read, [0], threads=1)) as examples:
        height, width = np.shape(next(iter(examples)).frame.depth)
    error, slopes = np.zeros((height, width)), np.zeros((len(coordinates.free), height, width))
    with closing(frame_blocks(problem, 0, shot, found.y, True)) as blocks:
        for residual, columns in blocks:
            seen = residual.size // (height * width) * height * width  # what does not look at pixels comes last
            r = jnp.asarray(residual)[:seen].reshape(height, width, -1)
            error += np.asarray((r * r).sum(-1), np.float64)
            row = 0
            for part in columns:
                change = part[:, :seen].reshape(part.shape[0], *r.shape)
                slopes[row : row + part.shape[0]] += np.asarray((change * r[None]).sum(-1), np.float64)
                row += part.shape[0]
    return Sensitivity(error * height * width, slopes * height * width)


def write_maps(folder: Path, found: Fit, maps: Sensitivity) -> Path:
    """One EXR, `sensitivity.exr`: the channel `error`, and one channel per number."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SvgfError(f"{folder}: can't be made ({error.strerror or error}); choose another folder") from None
    channels = {"error": maps.error.astype(np.float32)}
    for label, plane in zip(found.coordinates.labels, maps.slopes, strict=True):
        channels["slope." + label.replace("[", "_").replace("]", "")] = plane.astype(np.float32)
    path = folder / "sensitivity.exr"
    exr.write(path, exr.new_image(channels))
    return path
