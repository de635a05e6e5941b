"""`svgf-jax demo`."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from svgf_jax.commands import settings, terminal
from svgf_jax.commands.compare import print_scores
from svgf_jax.commands.completing import PRESET


def demo(
    *,
    out: Annotated[Path, Parameter(name=["--out", "-o"], metavar="FOLDER")] = Path("svgf-demo"),
    preset: Annotated[str, PRESET, Parameter(metavar="NAME")] = "paper",
    overwrite: Annotated[bool, Parameter(negative=(), show_default=False)] = False,
) -> None:
    """Denoise the bundled ten-frame sample, measure it, and show it beside its reference.

    Args:
        out: The output folder.
        preset: A preset by name.
        overwrite: Replace the output of an earlier demo.
    """
    name, params, config = settings.choose(preset, None, ())
    from svgf_jax import demo as bundled

    frames = len(list(bundled.sample().glob("frame_*.exr")))
    with terminal.progress(frames) as on_frame:
        made = bundled.run(out, params=params, config=config, preset=name, overwrite=overwrite, on_frame=on_frame)
    terminal.warn(made.summary.notes)
    print_scores("", {"noisy": made.noisy, "denoised": made.denoised})
    print(f"frames:  {out}")
    print(f"picture: {made.picture}")
    print(f"video:   {made.video or 'not made; it needs the extra: pip install svgf-jax[video]'}")
