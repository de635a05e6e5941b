"""Sequences on disk as one video: side by side, or as stripes of one picture. NumPy only."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from svgf_jax import preview, tonemapping
from svgf_jax.references import read_radiance
from svgf_jax.sequences import find_sequence, format_range
from svgf_jax.threads import read_ahead
from svgf_jax.types import SvgfError

KINDS = (".mp4", ".gif", ".webp")
MOVING = "moving"  # a line that sweeps there and back once in the length of the video


def make_film(
    inputs: Sequence[str],
    out: Path,
    *,
    labels: Sequence[str] | None = None,
    layout: str = "side",
    split: float | str | None = None,
    frames: str | None = None,
    fps: float = 24.0,
    exposure: float = 1.0,
    curve: str = preview.CURVE,
    scale: int = 1,
) -> tuple[int, float]:
    """Write the frames that all inputs have as a video; how many frames, and at what rate.

    Args:
        inputs: folders, patterns or files as `find_sequence` takes them; EXRs of one size.
        out: an .mp4 (needs the extra `video`), .gif or .webp.
        labels: one for each input; None takes their names, and a single picture gets none.
        layout: "side" (one beside the other) or "split" (stripes of one picture).
        split: with "split" and two inputs: where the line is, as a part of the width, or "moving".
        frames: only these: 1-100, 1-100x2 or 1,3,5-9.
        fps: frames per second; a GIF or WebP takes the nearest that it knows.
        exposure, curve: of `preview.to_8bit`.
        scale: screen pixels a pixel, each way, a whole number.

    Raises SvgfError: whatever cannot be, before any work; unreadable files, frames of different sizes.
    """
    position = _check(inputs, out, labels, layout, split, scale)
    preview.frame_rate(fps)
    tonemapping.check_exposure(exposure)
    found = [
        find_sequence(name, frames=frames, missing="reset", prefer=("frame", "denoised", "beauty")) for name in inputs
    ]
    files = [{number: path for number, path in sequence.files if path is not None} for sequence in found]
    numbers = sorted(set.intersection(*(set(paths) for paths in files)))
    if not numbers:
        listed = ", ".join(f"{s.name} ({format_range(f)})" for s, f in zip(found, files, strict=True))
        raise SvgfError(f"{listed} have no frame number in common; wanted the same frames in all.")
    titles = (
        tuple(labels) if labels is not None else tuple(_name(name) for name in inputs) if len(inputs) > 1 else ("",)
    )

    def read(number: int) -> list[np.ndarray]:
        images = [read_radiance(paths[number]) for paths in files]
        if len({image.shape for image in images}) != 1:
            sizes = ", ".join(
                f"{paths[number]} is {image.shape[1]} x {image.shape[0]}"
                for paths, image in zip(files, images, strict=True)
            )
            raise SvgfError(f"{sizes}; wanted pictures of one size.")
        return [
            preview.to_8bit(image, exposure=exposure, curve=curve).repeat(scale, 0).repeat(scale, 1) for image in images
        ]

    def pictures() -> Iterator[np.ndarray]:
        for index, shown in enumerate(read_ahead(read, numbers, threads=2)):
            panels = list(zip(titles, shown, strict=True))
            if len(panels) == 1 and not titles[0]:
                yield shown[0]
            elif layout == "side":
                yield preview.side_by_side(panels)
            else:
                sweep = 0.5 - 0.45 * math.cos(2 * math.pi * index / len(numbers))
                yield preview.split_screen(panels, position=sweep if position == MOVING else position)

    if out.suffix.lower() == ".mp4":
        preview.write_video(out, pictures(), fps=fps)
        return len(numbers), float(preview.frame_rate(fps))
    return len(numbers), preview.write_animation(out, pictures(), fps=fps)


def _check(
    inputs: Sequence[str], out: Path, labels: Sequence[str] | None, layout: str, split: float | str | None, scale: int
):
    """The split's position; SvgfError for what does not go together."""
    if out.suffix.lower() not in KINDS:
        raise SvgfError(f"Got {out} as the video; wanted a name that ends in {', '.join(KINDS)}.")
    if out.suffix.lower() == ".mp4":
        preview.require_video()
    if not inputs:
        raise SvgfError("Got nothing to show; wanted one sequence or more.")
    if labels is not None and len(labels) != len(inputs):
        raise SvgfError(f"Got the labels {', '.join(labels)} for {len(inputs)} sequences; wanted one for each.")
    if layout not in ("side", "split"):
        raise SvgfError(f"Got the layout {layout!r}; wanted side or split.")
    if not 1 <= scale <= 16:
        raise SvgfError(f"Got the scale {scale}; wanted a whole number from 1 to 16.")
    if split is None or split == MOVING:
        position = split
    else:
        try:
            position = float(split)
        except ValueError:
            position = math.nan
        if not 0 <= position <= 1:
            raise SvgfError(f"Got the split {split}; wanted a number from 0 to 1 (0.5 is the middle), or {MOVING}.")
    if position is not None and (layout != "split" or len(inputs) != 2):
        raise SvgfError(
            f"The split {split} is of the layout split with two sequences; got {layout} with {len(inputs)}."
        )
    return position


def _name(pattern: str) -> str:
    """What to call an input: its folder, or its file's name without number and suffix."""
    path = Path(pattern)
    return path.name if path.is_dir() else path.stem.split("#")[0].split("%")[0].rstrip("._-0123456789") or path.stem
