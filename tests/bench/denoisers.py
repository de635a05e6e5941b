"""This library beside others and beside its own parts: error, flicker and time of each, frame by frame over whole sequences.

    pip install '.[bench,flip]'        (pyoidn is Intel Open Image Denoise)
    python tests/bench/denoisers.py FOLDER... [--only paper,adaptive] [--frames 0-7] [--no-flip]
    python tests/bench/denoisers.py --table                                        (what was measured, as Markdown)

A FOLDER holds frame_####.exr and ref_####.exr. PSNR, relMSE, FLIP and temporal error are means over all frames, as `svgf-jax
compare` measures them; seconds are processor time (all cores), the median of a frame, compilation and reading left out. Open
Image Denoise sees each frame alone: color, albedo and normal (`oidn`), and with the guides declared clean (`oidn clean`). It gets
what SVGF gets: emission, which has no noise, is added afterwards (with it in the color, rims of lamps cost up to 7 dB).
Results are added to tests/bench/denoisers.json.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np

from svgf_jax import Config, Frame, Params, init, load_reference, open_source, preset, read_frame, step
from svgf_jax.metrics import mean_scores, score_frames

RESULTS = Path(__file__).with_suffix(".json")
Denoiser = Callable[[Iterator[Frame]], Iterator[tuple[np.ndarray, float]]]  # (image, processor seconds) of each frame


def svgf(params: Params, config: Config, *, alone: bool = False) -> Denoiser:
    """`alone`: each frame as if it were the first."""

    def run(frames: Iterator[Frame]) -> Iterator[tuple[np.ndarray, float]]:
        leaves = Params(*(np.asarray(leaf, np.float32) for leaf in params))
        history = None
        for frame in frames:
            if history is None:
                history = init(frame)
                jax.block_until_ready(step(history, frame, params=leaves, config=config))  # compiles
            began = time.process_time()
            history = init(frame) if alone else history
            history, output = jax.block_until_ready(step(history, frame, params=leaves, config=config))
            yield np.asarray(output.image), time.process_time() - began

    return run


def beauty(frame: Frame) -> np.ndarray:
    return np.asarray(frame.radiance.sum(axis=0) + frame.emission, np.float32)


def noisy(frames: Iterator[Frame]) -> Iterator[tuple[np.ndarray, float]]:
    for frame in frames:
        yield beauty(frame), 0.0


def oidn(*, clean: bool) -> Denoiser:
    import pyoidn

    def run(frames: Iterator[Frame]) -> Iterator[tuple[np.ndarray, float]]:
        for frame in frames:
            guides = {"albedo": np.float32(np.clip(frame.albedo[0], 0, 1)), "normal": np.float32(frame.normal)}
            reflected = np.asarray(frame.radiance.sum(axis=0), np.float32)
            began = time.process_time()
            image = pyoidn.denoise(reflected, **guides, hdr=True, clean_aux=clean, quality="high")
            yield np.asarray(image) + np.asarray(frame.emission, np.float32), time.process_time() - began

    return run


def denoisers() -> dict[str, Callable[[], Denoiser]]:
    paper = Params()
    presets = {name: lambda name=name: svgf(*preset(name)) for name in ("paper", "falcor", "tuned", "adaptive")}
    return {
        "noisy": lambda: noisy,
        "accumulation alone": lambda: svgf(paper, Config(levels=0)),
        "a-trous alone": lambda: svgf(paper, Config(), alone=True),
        **presets,
        "oidn": lambda: oidn(clean=False),
        "oidn clean": lambda: oidn(clean=True),
    }


def measure(folder: Path, denoiser: Denoiser, frames: str | None, flip: bool) -> dict[str, float]:
    source = open_source(str(folder), frames=frames)
    count = len(source.sequence.files)
    references = load_reference(str(folder), frames=frames)
    read = (read_frame(source, i).frame for i in range(count))
    seconds = []

    def pairs() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for (image, spent), reference in zip(denoiser(read), references, strict=True):
            seconds.append(spent)
            yield image, reference

    scores = [s for s in score_frames(pairs(), with_flip=flip) if s is not None]
    known = {name: score for name, score in mean_scores(scores)._asdict().items() if np.isfinite(score)}
    return known | {"seconds": float(np.median(seconds)), "frames": count}


def table() -> None:
    """One row a denoiser and sequence; times beside those of `paper` on the same sequence."""
    print("| sequence | | PSNR | relMSE | FLIP | temporal | seconds |\n|---|---|---|---|---|---|---|")
    for sequence, results in json.loads(RESULTS.read_text()).items():
        for name in denoisers():
            r = results[name]
            errors = " | ".join(
                f"{r[key]:.4f}".lstrip("0") if key in r else "" for key in ("relmse", "flip", "temporal")
            )
            print(f"| {sequence} | {name} | {r['psnr']:.2f} | {errors} | {r['seconds']:.2f} |")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--only")
    parser.add_argument("--frames")
    parser.add_argument("--no-flip", action="store_true")
    given = parser.parse_args()
    if given.table:
        return table()
    known = denoisers()
    names = given.only.split(",") if given.only else list(known)
    for folder in given.folders:
        for name in names:
            result = measure(folder, known[name](), given.frames, not given.no_flip)
            stored = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
            stored.setdefault(folder.name, {})[name] = result
            RESULTS.write_text(json.dumps(stored, indent=1) + "\n")
            print(f"{folder.name:16} {name:20}", "  ".join(f"{k} {v:.4g}" for k, v in result.items()), flush=True)


if __name__ == "__main__":
    main()
