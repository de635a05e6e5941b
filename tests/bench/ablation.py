"""What each part of the filter is worth on the real sequences: `svgf-jax ablate`'s rows, whole frames, all of them.

    python tests/bench/ablation.py [--preset paper] [--only no-history,levels-*]      scores
    python tests/bench/ablation.py --times          times: the rows take turns, so that whatever else runs hits all alike
    python tests/bench/ablation.py --references     the temporal error that TAA gives the references

Results are added to tests/bench/ablation.json.
"""

import argparse
import json
import time
from functools import partial
from pathlib import Path

import jax
import numpy as np

from svgf_jax import open_source, preset, read_frame, read_radiance, taa, taa_init
from svgf_jax.ablation import BASE, ablate, choose_rows, grid, settings_of
from svgf_jax.compiled import compile_filters, to_host
from svgf_jax.metrics import mean_scores, score_frames
from svgf_jax.references import pair_references

DATA = Path(__file__).parents[3] / "shared" / "data"
RESULTS = Path(__file__).with_suffix(".json")
SEQUENCES = ("cornell-dolly", "gallery-pan", "lights-flicker")
WARM, ROUNDS = 5, 9


def save(kind: str, sequence: str, row: str, value) -> None:
    """Add one result to the file."""
    found = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    found.setdefault(kind, {}).setdefault(sequence, {})[row] = value
    RESULTS.write_text(json.dumps(found, indent=1) + "\n")
    print(sequence, row, value, flush=True)


def scores(base: str, only: list[str]) -> None:
    """The rows on every sequence."""
    params, config = preset(base)
    rows = choose_rows(only, grid(params, config))
    for name in SEQUENCES:
        source = open_source(DATA / name)
        references, _ = pair_references(source.sequence, DATA / name)
        for row, mean, *_ in ablate(source, references, rows=rows, params=params, config=config):
            kept = {"psnr": round(mean.psnr, 3), "relmse": round(mean.relmse, 6), "temporal": round(mean.temporal, 5)}
            save(base, name, row.name, kept)


def times(base: str) -> None:
    """The least processor time of `ROUNDS` of a frame with history, in seconds."""
    name, (params, config) = SEQUENCES[0], preset(base)
    source = open_source(DATA / name)
    inputs = [read_frame(source, i).frame for i in range(WARM + 1)]
    ready = {}
    for row in (BASE, *grid(params, config)):
        filters = compile_filters(*settings_of(row, params, config), device=None, pipeline=None)
        altered = [row.alter(frame) if row.alter else frame for frame in inputs]
        history = filters.init(altered[0])
        for frame in altered[:-1]:
            history, _ = filters.step(history, frame)
        history, output = filters.step(history, altered[-1])
        to_host(output, name)
        ready[row.name] = [filters, history, altered[-1]]
    took: dict[str, list[float]] = {row: [] for row in ready}
    for _ in range(ROUNDS):
        for row, (filters, history, frame) in ready.items():
            began = time.process_time()
            ready[row][1], output = filters.step(history, frame)
            to_host(output, name)
            took[row].append(time.process_time() - began)
    for row, each in took.items():
        save(f"{base}, seconds", name, row, round(float(np.min(each)), 4))


def references() -> None:
    """What TAA makes of the references themselves."""
    params = jax.tree.map(np.float32, preset("paper")[0])
    anti_alias = jax.jit(partial(taa, params=params))
    for name in SEQUENCES:
        source = open_source(DATA / name)
        paths, _ = pair_references(source.sequence, DATA / name)
        past, pairs = None, []
        for index, (number, _) in enumerate(source.sequence.files):
            frame, image = read_frame(source, index).frame, read_radiance(paths[number])
            past, smooth = anti_alias(taa_init(image) if past is None else past, image, frame.motion, frame.depth)
            pairs.append((np.asarray(smooth), image))
        save("references through TAA", name, "temporal", round(mean_scores(score_frames(pairs)).temporal, 5))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--only", default="")
    parser.add_argument("--times", action="store_true")
    parser.add_argument("--references", action="store_true")
    asked = parser.parse_args()
    if asked.references:
        references()
    elif asked.times:
        times(asked.preset)
    else:
        scores(asked.preset, [name for name in asked.only.split(",") if name])
