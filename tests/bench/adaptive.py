"""What following the light looks like beside the preset `paper`. (What it costs: speed.py step.)

    python tests/bench/adaptive.py FOLDER OUT.jpg [--frames 11,12]     (reference, paper, adaptive, its change and its worth)

One row a frame; the change of the direct light, red = the history was made brighter, blue = darker, and how many frames its history
is worth, bright = the most there may be, dark = none.
"""

import argparse
from pathlib import Path

import jax
import numpy as np
from PIL import Image

import svgf_jax as sj
from svgf_jax import page, preview
from svgf_jax.shown import most_worth

PRESETS = ("paper", "adaptive")


def outputs(folder: str, name: str, wanted: list[int]) -> list[sj.Output]:
    source, history, found = sj.open_source(folder), None, []
    params, config = sj.preset(name)
    params = jax.tree.map(np.float32, params)
    for i in range(max(wanted) + 1):
        frame = sj.read_frame(source, i).frame
        history = sj.init(frame, effective_history=True) if history is None else history
        history, output = sj.step(history, frame, params=params, config=config)
        if i in wanted:
            found.append(jax.tree.map(np.asarray, output))
    return found


def halved(image: np.ndarray, factor: float = 1.5) -> np.ndarray:
    """8-bit panels at 1 / factor of their size."""
    height, width = image.shape[:2]
    return np.asarray(
        Image.fromarray(image).resize((round(width / factor), round(height / factor)), Image.Resampling.BOX)
    )


def pictures(folder: str, out: Path, frames: list[int]) -> None:
    references = list(sj.load_reference(folder))
    paper, adaptive = (outputs(folder, name, frames) for name in PRESETS)
    rows, most = [], most_worth(sj.preset("adaptive")[0]._asdict())
    for at, one, other in zip(frames, paper, adaptive, strict=True):
        shown = [preview.to_8bit(image) for image in (references[at], one.image, other.image)]
        maps = page.signed(other.change[0]), page.heat(other.effective_history[0] / most)
        rows.append(np.concatenate([halved(p) for p in (*shown, *maps)], axis=1))
    Image.fromarray(np.concatenate(rows)).save(out, quality=90)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder")
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", default="11,12")
    given = parser.parse_args()
    pictures(given.folder, given.out, [int(i) for i in given.frames.split(",")])


if __name__ == "__main__":
    main()
