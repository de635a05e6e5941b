"""The variance estimators, and temporal anti-aliasing, on the real sequences: preset `paper`, whole frames, all of them.

    python tests/bench/variance_and_taa.py scores      (PSNR and temporal error against the references)
    python tests/bench/variance_and_taa.py flicker     (change of a surface point's value from frame to frame)

Results go to tests/bench/variance_and_taa.json.
"""

import json
import sys
from pathlib import Path

import jax
import numpy as np

import tune
from svgf_jax import Config, Frame, init, load_reference, load_sequence, preset, step
from svgf_jax.metrics import display

DATA = Path(__file__).parents[3] / "shared" / "data"
RESULTS = Path(__file__).with_suffix(".json")
SEQUENCES = ("cornell-dolly", "gallery-pan", "lights-flicker")
CHOICES = {
    "svgf": {},
    "svgf, TAA": {"taa": True},
    "spatial": {"variance": "spatial"},
    "temporal": {"variance": "temporal"},
    "temporal, scale 1": {"variance": "temporal", "variance_scale": 1.0},
}


def store(title: str, name: str, values: dict) -> None:
    """Add to the results of a choice on a sequence."""
    found = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    found.setdefault(title, {}).setdefault(name, {}).update(values)
    RESULTS.write_text(json.dumps(found, indent=1) + "\n")
    print(title, name, values, flush=True)


def scores() -> None:
    """Every choice against the references."""
    for title, changes in CHOICES.items():
        params, config = preset("paper")
        params = params._replace(**{k: v for k, v in changes.items() if k in params._fields})
        config = config._replace(**{k: v for k, v in changes.items() if k in config._fields})
        for name in SEQUENCES:
            mean = tune.measure(tune.shot_of_files(str(DATA / name), str(DATA / name)), params, config).mean
            store(title, name, {"psnr": round(mean.psnr, 3), "temporal": round(mean.temporal, 5)})


def flicker() -> None:
    """RMSE of display(frame) at p less display(frame before) at p + motion, over what was in the picture before."""
    for name in SEQUENCES:
        frames, reference = load_sequence(DATA / name), load_reference(DATA / name)
        shown = {"reference": reference, "noisy": frames.radiance.sum(1) + frames.emission}
        for title in ("svgf", "svgf, TAA"):
            shown[title] = filtered(frames, Config(taa="TAA" in title))
        for title, images in shown.items():
            squares = [along_motion(*images[t - 1 : t + 1], frames.motion[t]) for t in range(1, len(images))]
            store(title, name, {"flicker": round(float(np.sqrt(np.mean(squares))), 4)})


def filtered(frames: Frame, config: Config) -> np.ndarray:
    """Preset `paper` over a sequence, frame by frame."""
    history, images = None, []
    for t in range(len(frames.depth)):
        frame = jax.tree.map(lambda leaf, t=t: leaf[t], frames)
        history, output = step(history or init(frame, config=config), frame, params=preset("paper")[0], config=config)
        images.append(np.asarray(output.image))
    return np.stack(images)


def along_motion(before: np.ndarray, now: np.ndarray, motion: np.ndarray) -> float:
    """Mean square of the change of display values, the frame before read bilinearly."""
    height, width, _ = now.shape
    y, x = np.mgrid[:height, :width]
    motion = np.where(np.isfinite(motion), motion, -1e4)
    at_x, at_y = x + motion[..., 0], y + motion[..., 1]
    there = (at_x >= 0) & (at_x <= width - 1) & (at_y >= 0) & (at_y <= height - 1)
    at_x, at_y = np.clip(at_x, 0, width - 1.001), np.clip(at_y, 0, height - 1.001)
    column, row = np.floor(at_x).astype(int), np.floor(at_y).astype(int)
    right, down = (at_x - column)[..., None], (at_y - row)[..., None]
    d = display(before)
    upper = (1 - right) * d[row, column] + right * d[row, column + 1]
    lower = (1 - right) * d[row + 1, column] + right * d[row + 1, column + 1]
    change = display(now) - ((1 - down) * upper + down * lower)
    return float(np.square(change)[there].mean())


if __name__ == "__main__":
    {"scores": scores, "flicker": flicker}[sys.argv[1]]()
