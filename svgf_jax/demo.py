"""The bundled sample, denoised, measured and shown: what a newcomer sees first."""

import importlib.resources
import importlib.util
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from svgf_jax import preview, streaming
from svgf_jax.comparison import compare_sequences
from svgf_jax.filing import FrameReport
from svgf_jax.frames import open_source
from svgf_jax.metrics import Scores, mean_scores
from svgf_jax.references import read_radiance
from svgf_jax.sequences import find_sequence
from svgf_jax.streaming import Summary
from svgf_jax.types import Config, Params, SvgfError

EXPOSURE = 1.6
SHOWN = 7  # the frame in the picture
ZOOM = 2  # screen pixels a pixel, each way


class Demo(NamedTuple):
    """What the demo made and measured.

    Attributes:
        noisy, denoised: scores of the whole sequence before and after.
        summary: of the run.
        picture: PNG of one frame before, after, and its reference.
        video: MP4 of all frames in the same way; None where the extra `video` is not installed.
    """

    noisy: Scores
    denoised: Scores
    summary: Summary
    picture: Path
    video: Path | None


def sample() -> Path:
    """The folder of the bundled sequence; its README says what is in it."""
    return Path(str(importlib.resources.files("svgf_jax") / "sample"))


def run(
    out: str | Path,
    *,
    params: Params,
    config: Config,
    preset: str = "",
    overwrite: bool = False,
    on_frame: Callable[[FrameReport], None] = lambda report: None,
) -> Demo:
    """Denoise the sample into the folder `out`: EXRs, `demo.png`, and `demo.mp4` where PyAV is installed.

    Raises SvgfError: outputs exist and may not be replaced, the folder is not writable.
    """
    picture = Path(out) / "demo.png"
    video = Path(out) / "demo.mp4" if importlib.util.find_spec("av") is not None else None
    for path in (picture, video):
        if path is not None and os.path.exists(path) and not overwrite:
            raise SvgfError(f"{path} exists already, from an earlier demo? Choose another folder, or --overwrite.")
    source = open_source(sample())
    summary = streaming.run(
        source, out, params=params, config=config, preset=preset, overwrite=overwrite, on_frame=on_frame
    )
    noisy, denoised = (
        mean_scores(scores for _, scores in compare_sequences(folder, sample())) for folder in (sample(), out)
    )
    preview.write_png(picture, next(_panels(out, frame=SHOWN)))
    if video is not None:
        preview.write_video(video, _panels(out), fps=8)
    return Demo(noisy, denoised, summary, picture, video)


def _panels(out: str | Path, frame: int | None = None) -> Iterator[np.ndarray]:
    """Noisy, denoised and reference side by side, for one frame or all in turn."""
    columns = {
        "1 sample per pixel": find_sequence(sample()),
        "svgf-jax": find_sequence(out),
        "reference, 512 samples": find_sequence(sample(), prefer=("ref",)),
    }
    for files in zip(*(sequence.files for sequence in columns.values()), strict=True):
        if frame is None or files[0][0] == frame:
            pictures = [preview.to_8bit(read_radiance(str(path)), exposure=EXPOSURE) for _, path in files]
            large = [picture.repeat(ZOOM, axis=0).repeat(ZOOM, axis=1) for picture in pictures]
            yield preview.side_by_side(list(zip(columns, large, strict=True)))
