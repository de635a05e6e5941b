"""The variance estimators, and temporal anti-aliasing, on the real sequences: preset `paper`, whole frames, all of them.

python tests/bench/variance_and_taa.py        (results go to tests/bench/variance_and_taa.json)
"""

import json
from pathlib import Path

import tune
from svgf_jax import preset

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


def main() -> None:
    """Measure every choice, and write the table after each."""
    found: dict = {}
    for title, changes in CHOICES.items():
        params, config = preset("paper")
        params = params._replace(**{k: v for k, v in changes.items() if k in params._fields})
        config = config._replace(**{k: v for k, v in changes.items() if k in config._fields})
        for name in SEQUENCES:
            shot = tune.shot_of_files(str(DATA / name), str(DATA / name))
            mean = tune.measure(shot, params, config).mean
            found.setdefault(title, {})[name] = {"psnr": round(mean.psnr, 3), "temporal": round(mean.temporal, 5)}
            print(title, name, found[title][name], flush=True)
            RESULTS.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
