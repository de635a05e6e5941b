"""What tuning brings on the real sequences: presets, tuned scalars, tuned per level, each left-out sequence measured whole.

Fits see a window of each frame, so that a run takes minutes; scores are of whole frames, all of them.

    python tests/bench/tune_real.py scalar:cornell-dolly+gallery-pan level:cornell-dolly ...   (kind:sequences to tune on)
    python tests/bench/tune_real.py steady:cornell-dolly+lights-flicker          (scalar, the temporal error at weight 1.5)
    python tests/bench/tune_real.py noisy:cornell-dolly clean:cornell-dolly       (8 frames: second noisy render, reference)
    python tests/bench/tune_real.py all-level:cornell-dolly+gallery-pan+lights-flicker        (the preset `tuned`)
    python tests/bench/tune_real.py adaptive:cornell-dolly+gallery-pan ...        (a history that follows the light; after `level:`)
    python tests/bench/tune_real.py loo                                                        (scalar, each pair of sequences)

Results are added to tests/bench/tune_real.json.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np

import tune
from svgf_jax import Config, Params, preset
from tune.free import TUNED_BY_DEFAULT
from tune.residuals import noisy_terms, reference_terms
from tune.shots import window

DATA = Path(__file__).parents[3] / "shared" / "data"
RESULTS = Path(__file__).with_suffix(".json")
SEQUENCES = ("cornell-dolly", "gallery-pan", "lights-flicker")
WINDOW = {"rows": slice(80, 200), "columns": slice(120, 376)}
SMALL_WINDOW = {"rows": slice(90, 180), "columns": slice(160, 320)}
# `adaptive` is fitted from the paper's numbers, plain thresholds, and the geometry weights that `level:` found on the same
# sequences, so that a left-out sequence has no part in it.
FOLLOWING = Params(light_gain_threshold=2.0, light_offset_threshold=2.0), Config(light_cell=4)
LIGHT = ("alpha", "sigma_luminance", "short_history_boost", "light_gain_threshold", "light_offset_threshold")
GEOMETRY = ("sigma_depth", "sigma_normal", "depth_epsilon", "kernel_near", "kernel_far")
PER_LEVEL = ("sigma_luminance", "sigma_normal", "kernel_near")


def shot(name: str) -> tune.Shot:
    return tune.shot_of_files(str(DATA / name), str(DATA / name))


def first_frames(name: str, target: str) -> tune.Shot:
    """The eight frames that have a second noisy render, with that or the reference for target."""
    return tune.shot_of_files(str(DATA / name), str(DATA / name), frames="0-7", prefer=(target,))


def measured(params: Params, config: Config) -> dict:
    return {name: tune.measure(shot(name), params, config).mean._asdict() for name in SEQUENCES}


def tuned(kind: str, names: list[str], **options) -> dict:
    params, config = FOLLOWING if kind == "adaptive" else preset("paper")
    noisy = kind == "noisy"
    shots = [
        first_frames(name, "alt" if noisy else "ref") if kind in ("noisy", "clean") else shot(name) for name in names
    ]
    if kind.startswith("all-"):  # starts where the pairs of sequences ended, in the mean
        before = kind.removeprefix("all-")
        found = [result["params"] for key, result in stored().items() if key.startswith(f"{before}:") and "+" in key]
        params = Params(**{k: np.exp(np.mean(np.log([f[k] for f in found]), axis=0)) for k in found[0]})
    if kind == "level" and (before := stored().get(f"scalar:{'+'.join(names)}")):
        params = Params(**{k: np.asarray(v) for k, v in before["params"].items()})  # the scalars are the start
    if kind == "adaptive":
        found = stored()[f"{'all-' if len(names) == 3 else ''}level:{'+'.join(names)}"]["params"]
        params = params._replace(**{k: np.asarray(found[k]) for k in GEOMETRY})
    began = time.monotonic()
    lines = []

    def tell(iteration: tune.Iteration) -> None:
        lines.append({"loss": iteration.loss, "accepted": iteration.accepted, "seconds": time.monotonic() - began})
        print(kind, names, lines[-1], iteration.values.round(4).tolist(), flush=True)

    fit = tune.fit(
        params,
        config,
        [window(s, **(SMALL_WINDOW if kind == "adaptive" else WINDOW)) for s in shots],
        noisy_terms() if noisy else reference_terms(**options),
        names=LIGHT if kind == "adaptive" else TUNED_BY_DEFAULT,
        per_level=PER_LEVEL if kind.endswith(("level", "adaptive")) else (),
        on_iteration=tell,
        least_gain=1e-5 if noisy else 5e-3,
        max_steps=6 if kind == "adaptive" else 9,
    )
    assert fit.knowledge is not None
    return {
        "params": {k: np.asarray(v).tolist() for k, v in fit.params._asdict().items()},
        "config": fit.config._asdict(),
        "result": fit.result,
        "seconds": time.monotonic() - began,
        "trials": lines,
        "free": list(fit.coordinates.labels),
        "relative_errors": fit.knowledge.relative_errors.tolist(),
        "undetermined": fit.knowledge.undetermined,
        "scores": measured(fit.params, fit.config),
    }


def stored() -> dict:
    return json.loads(RESULTS.read_text()) if RESULTS.exists() else {}


def keep(key: str, result: dict) -> None:
    RESULTS.write_text(json.dumps(stored() | {key: result}, indent=1) + "\n")
    scores = {name: f"{score['psnr']:.2f} dB, {score['temporal']:.5f}" for name, score in result["scores"].items()}
    print(key, scores, flush=True)


def main(arguments: list[str]) -> None:
    for name in ("paper", "falcor"):
        if name not in stored():
            keep(name, {"scores": measured(*preset(name))})
    if arguments == ["loo"]:
        arguments = [f"scalar:{'+'.join(name for name in SEQUENCES if name != left)}" for left in SEQUENCES]
    for argument in arguments:
        kind, _, names = argument.partition(":")
        keep(argument, tuned(kind, names.split("+"), **({"temporal": 1.5} if kind == "steady" else {})))


if __name__ == "__main__":
    main(sys.argv[1:])
