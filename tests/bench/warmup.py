"""How far a part of a sequence (`denoise --frames A-B --warmup N`) is from the same frames of the whole run.

    python tests/bench/warmup.py FOLDER [FOLDER ...] [--first 40] [--warmup 0 8 16 32]

For each preset and N: relMSE of the part's frames against the whole run's, that of the first frame and the mean. The table goes to
tests/bench/warmup.json. The sequences: 56 frames of the scenes of render_scenes.py (--frames 56 --spp 16 --size 240x135).
"""

import argparse
import json
from pathlib import Path

import jax
import numpy as np

from svgf_jax import init, load_sequence, preset, step
from svgf_jax.metrics import relmse

RESULTS = Path(__file__).with_suffix(".json")
PRESETS = ("paper", "falcor", "tuned", "adaptive")


def images(frames, params, config, numbers):
    """The filtered images of frames `numbers`, from an empty history."""
    history = init(jax.tree.map(lambda a: a[0], frames), config=config)
    for t in numbers:
        history, output = step(history, jax.tree.map(lambda a, t=t: a[t], frames), params=params, config=config)
        yield t, np.asarray(output.image)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--first", type=int, default=40)
    parser.add_argument("--warmup", type=int, nargs="+", default=[0, 8, 16, 32])
    given = parser.parse_args()
    found = {}
    for folder in given.folders:
        frames = load_sequence(folder)
        count = len(frames.depth)
        for name in PRESETS:
            params, config = preset(name)
            whole = dict(images(frames, params, config, range(count)))
            for warmup in given.warmup:
                part = images(frames, params, config, range(given.first - warmup, count))
                errors = [relmse(image, whole[t]) for t, image in part if t >= given.first]
                told = {"first": round(errors[0], 6), "mean": round(float(np.mean(errors)), 6)}
                found.setdefault(folder.name, {}).setdefault(name, {})[str(warmup)] = told
                print(folder.name, name, warmup, told, flush=True)
    RESULTS.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
