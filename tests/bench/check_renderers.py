"""Render small moving scenes with the renderers that are here, and check what is read of them. Says why where one is not.

    python tests/bench/check_renderers.py [--blender PYTHON_WITH_BPY] [--mitsuba PYTHON_WITH_MITSUBA]

Each Python is the one that has the package (this one by default). Mitsuba's llvm variants may want DRJIT_LIBLLVM_PATH.
"""

import argparse
import subprocess
import sys
import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np

from svgf_jax.frames import open_source, read_frame
from svgf_jax.motion import Convention
from svgf_jax.warping import Step, find_convention, warp_residual

HERE = Path(__file__).parent
SIZE = ("128", "72", "4")


def render(python: str, package: str, script: str, folder: Path, *options: str) -> str | None:
    """Why it could not be rendered; None if it was."""
    try:
        found = subprocess.run([python, "-c", f"import {package}"], capture_output=True, text=True, check=False)
    except OSError as error:
        return f"{python}: {error}"
    if found.returncode:
        return f"{python} has no {package}: {found.stderr.strip().splitlines()[-1]}"
    done = subprocess.run(
        [python, str(HERE / script), str(folder), *SIZE, *options], capture_output=True, text=True, check=False
    )
    return done.stderr[-500:] if done.returncode else None


def check(name: str, folder: Path, *, at_most: float, **options) -> None:
    """The motion leads to the same places, its convention is found, and no light is lost."""
    source = open_source(folder, position=True, **options)
    items = [read_frame(source, i) for i in range(len(source.sequence.files))]
    frames = [item.frame for item in items]
    pairs = list(pairwise(frames))
    residuals = [warp_residual(before, now, now.motion) for before, now in pairs]
    verdict = find_convention([Step(before, now, now.motion, before.motion) for before, now in pairs])
    beauty = [
        item.image.channels[channel] for item in items[1:2] for channel in source.roles.layers["radiance"].channels
    ]
    total = frames[1].radiance.sum(0) + frames[1].emission
    lost = float(np.abs(total - np.stack(beauty, -1)).max())
    pixels = max(one.pixels for one in residuals)
    print(f"{name}: {source.table.name}, signals {len(source.roles.signals)}, warnings {list(source.warnings)}")
    print(
        f"  motion off by {pixels:.4f} pixels (at most {at_most}); "
        f"fits {[str(one) for one in verdict.fits]}; light off by {lost:.2g}"
    )
    if not (pixels < at_most and verdict.fits == (Convention(),) and lost < 1e-4):
        raise SystemExit(f"{name}: not as it should be")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--blender", default=sys.executable)
    parser.add_argument("--mitsuba", default=sys.executable)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        for parts in ("multi", "single"):
            folder = Path(place) / parts
            why = render(chosen.blender, "bpy", "render_cycles.py", folder, f"parts={parts}")
            print(f"cycles, {parts}: skipped: {why}") if why else check(f"cycles, {parts}", folder, at_most=0.02)
        folder = Path(place) / "mitsuba"
        folder.mkdir()
        why = render(chosen.mitsuba, "mitsuba", "render_mitsuba.py", folder)
        print(f"mitsuba: skipped: {why}") if why else check("mitsuba", folder, at_most=0.75)
