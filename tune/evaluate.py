"""Before and after, measured with the library's own metrics, shot by shot."""

from collections.abc import Callable, Iterator
from contextlib import closing
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import numpy as np

from svgf_jax import Config, Params, init, step
from svgf_jax.metrics import Scores, mean_scores, score_frames
from svgf_jax.threads import read_ahead
from tune.shots import Shot, frame_numbers


class Measured(NamedTuple):
    """Scores of a shot: of each frame with a reference, of the whole, and the numbers of those frames."""

    name: str
    frames: tuple[Scores, ...]
    mean: Scores
    numbers: tuple[int, ...] = ()


def measure(shot: Shot, params: Params, config: Config, *, with_flip: bool = False) -> Measured:
    """Denoise a shot whose targets are references, and score it. One frame in memory at a time."""
    found = zip(frame_numbers(shot), score_frames(filtered(shot, params, config), with_flip=with_flip), strict=True)
    scores = {number: score for number, score in found if score is not None}
    return Measured(shot.name, tuple(scores.values()), mean_scores(scores.values()), tuple(scores))


def filtered(shot: Shot, params: Params, config: Config) -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
    """(filtered image `[H, W, 3]`, target) of each frame of a shot."""
    run = _step(config)
    history = None
    with closing(read_ahead(shot.read, range(shot.length), threads=1)) as examples:
        for frame, target in examples:
            leaves = Params(*(np.asarray(leaf, frame.depth.dtype) for leaf in params))
            history, output = run(init(frame, config=config) if history is None else history, frame, params=leaves)
            yield np.asarray(output.image), target


def worse(before: Measured, after: Measured, *, tolerance: float = 0.0) -> str | None:
    """In what a shot got worse, as a sentence; None if it did not: PSNR (by more than `tolerance` dB)."""
    loss = before.mean.psnr - after.mean.psnr
    if loss > tolerance or np.isnan(after.mean.psnr):
        return f"{after.name}: PSNR fell from {before.mean.psnr:.2f} to {after.mean.psnr:.2f} dB"
    return None


@cache
def _step(config: Config) -> Callable[..., Any]:
    return jax.jit(partial(step, config=config))
