"""What following the light looks like, and what it costs beside the preset `paper`.

    python tests/bench/adaptive.py pictures FOLDER OUT.png [--frames 11,12]     (reference, paper, adaptive, its change)
    python tests/bench/adaptive.py cost FOLDER [--rounds 15] [--tile 2]

Pictures: one row a frame; the change of the direct light, red = the history was made brighter, blue = darker. Cost: steps of both
presets in turn on the same frame (tiled to a larger one), medians of processor and wall time, added to tests/bench/adaptive.json.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import numpy as np
from PIL import Image

import svgf_jax as sj
from svgf_jax import preview

RESULTS = Path(__file__).with_suffix(".json")
PRESETS = ("paper", "adaptive")


def outputs(folder: str, name: str, wanted: list[int]) -> list[sj.Output]:
    source, history, found = sj.open_source(folder), None, []
    params, config = sj.preset(name)
    params = jax.tree.map(np.float32, params)
    for i in range(max(wanted) + 1):
        frame = sj.read_frame(source, i).frame
        history = sj.init(frame) if history is None else history
        history, output = sj.step(history, frame, params=params, config=config)
        if i in wanted:
            found.append(jax.tree.map(np.asarray, output))
    return found


def signed(values: np.ndarray) -> np.ndarray:
    """-1 blue, 0 white, 1 red, 8 bits."""
    up, down = np.clip(values, 0, 1)[..., None], np.clip(-values, 0, 1)[..., None]
    color = 1 - up * np.array([0.1, 0.85, 0.9]) - down * np.array([0.9, 0.7, 0.1])
    return np.round(255 * color).astype(np.uint8)


def halved(image: np.ndarray, factor: float = 1.5) -> np.ndarray:
    """8-bit panels at 1 / factor of their size."""
    height, width = image.shape[:2]
    return np.asarray(
        Image.fromarray(image).resize((round(width / factor), round(height / factor)), Image.Resampling.BOX)
    )


def pictures(folder: str, out: Path, frames: list[int]) -> None:
    references = list(sj.load_reference(folder))
    paper, adaptive = (outputs(folder, name, frames) for name in PRESETS)
    rows = []
    for at, one, other in zip(frames, paper, adaptive, strict=True):
        shown = [preview.to_8bit(image) for image in (references[at], one.image, other.image)]
        rows.append(np.concatenate([halved(p) for p in (*shown, signed(other.change[0]))], axis=1))
    Image.fromarray(np.concatenate(rows)).quantize(255).save(out, optimize=True)


def cost(folder: str, rounds: int, tile: int) -> None:
    source = sj.open_source(folder)
    tiled = lambda a: np.concatenate([np.concatenate([a] * tile, axis=-2)] * tile, axis=-3)  # noqa: E731
    plane = lambda a: tiled(a[..., None])[..., 0]  # noqa: E731
    frames = []
    for i in (0, 1, 2):
        frame = sj.read_frame(source, i).frame
        large = {k: tiled(getattr(frame, k)) for k in ("radiance", "albedo", "emission", "normal", "motion")}
        frames.append(
            frame._replace(**large, **{k: plane(getattr(frame, k)) for k in ("depth", "prev_depth", "object_id")})
        )
    history, spent = {}, {name: [] for name in PRESETS}
    chosen = {name: (jax.tree.map(np.float32, sj.preset(name)[0]), sj.preset(name)[1]) for name in PRESETS}
    for name, (params, config) in chosen.items():
        history[name] = sj.init(frames[0])
        for frame in frames:
            history[name], _ = jax.block_until_ready(sj.step(history[name], frame, params=params, config=config))
    for _ in range(rounds):
        for name, (params, config) in chosen.items():
            wall, processor = time.monotonic(), time.process_time()
            jax.block_until_ready(sj.step(history[name], frames[2], params=params, config=config))
            spent[name].append((time.process_time() - processor, time.monotonic() - wall))
    result = {
        name: dict(zip(("processor", "wall"), np.median(s, axis=0).tolist(), strict=True)) for name, s in spent.items()
    }
    height, width = frames[0].depth.shape
    stored = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    RESULTS.write_text(json.dumps(stored | {f"{width}x{height}, {rounds} rounds": result}, indent=1) + "\n")
    for kind in ("processor", "wall"):
        print(
            kind,
            {n: round(r[kind], 4) for n, r in result.items()},
            f"{result['adaptive'][kind] / result['paper'][kind]:.3f}",
        )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("pictures", "cost"))
    parser.add_argument("folder")
    parser.add_argument("out", nargs="?", type=Path)
    parser.add_argument("--frames", default="11,12")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--tile", type=int, default=2)
    given = parser.parse_args()
    if given.what == "pictures":
        pictures(given.folder, given.out, [int(i) for i in given.frames.split(",")])
    else:
        cost(given.folder, given.rounds, given.tile)


if __name__ == "__main__":
    main()
