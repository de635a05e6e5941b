"""`svgf-jax video`."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from svgf_jax.commands import results, settings, terminal


def video(
    *inputs: Annotated[str, Parameter(name="SEQUENCE")],
    out: Annotated[Path, Parameter(name=["--out", "-o"], metavar="FILE")],
    labels: Annotated[str | None, Parameter(metavar="NAME,NAME")] = None,
    layout: Literal["side", "split"] = "side",
    split: Annotated[str | None, Parameter(metavar="PLACE")] = None,
    frames: Annotated[str | None, Parameter(metavar="RANGE")] = None,
    fps: float = 24.0,
    exposure: float = 1.0,
    tonemap: settings.Tonemap = "reinhard-extended",
    scale: int = 1,
    overwrite: Annotated[bool, Parameter(negative=(), show_default=False)] = False,
) -> None:
    """Show sequences as one video: MP4, or GIF or WebP for a web page.

    For example: svgf-jax video shots clean shots/ref_####.exr -o all.mp4 --labels noisy,denoised,reference

    Args:
        inputs: Folders, patterns or files; the frames that all of them have are shown.
        out: The video; its suffix says which kind: .mp4 (needs the extra `video`), .gif or .webp.
        labels: One for each sequence; their names if not given.
        layout: One beside the other, or stripes of one picture.
        split: Where the line between two stripes is: 0.5 is the middle; moving sweeps it there and back.
        frames: Only these: 1-100, 1-100x2 or 1,3,5-9.
        fps: Frames per second.
        exposure: Brightness factor.
        tonemap: Tone curve.
        scale: Screen pixels a pixel, each way.
        overwrite: Replace the file if it exists.
    """
    results.require_writable((out,), overwrite=overwrite)
    from svgf_jax.film import make_film

    count, rate = make_film(
        inputs,
        out,
        labels=None if labels is None else labels.split(","),
        layout=layout,
        split=split,
        frames=frames,
        fps=fps,
        exposure=exposure,
        curve=tonemap,
        scale=scale,
    )
    terminal.tell(f"{count} frame{'s' * (count != 1)} at {rate:.6g} a second -> {out}")
