"""The table of docs/games202.md: flicker, grain and ghost of each method on the homework's box scene.

python tests/bench/games202_box.py FOLDER       (the homework's scene `box`, as handed out)
"""

import sys

import numpy as np

import svgf_jax as svgf

LUMINANCE = np.float32([0.2126, 0.7152, 0.0722])
BALL, WALL = 6, 3
METHODS = {
    "joint-bilateral": ("joint-bilateral", {}),
    "accumulate": ("accumulate", {}),
    "games202": ("games202", {}),
    "games202-atrous": ("games202-atrous", {}),
    "games202, no clamp": ("games202", {"clamp_radius": 0}),
    "games202, no id test": ("games202", {"id_test": False}),
    "games202, no id test and no clamp": ("games202", {"id_test": False, "clamp_radius": 0}),
    "games202, alpha .8": ("games202", {"alpha": 0.8}),
}


def main(folder: str) -> None:
    """Print the table."""
    frames = svgf.load_sequence(folder, position=True)
    images = {"noisy input": frames.radiance[:, 0]}
    for row, (name, values) in METHODS.items():
        params, config = svgf.method(name)
        params = params._replace(**{k: v for k, v in values.items() if k in params._fields})
        config = config._replace(**{k: v for k, v in values.items() if k in config._fields})
        images[row] = svgf.baseline_denoise(frames, params=params, config=config)[1].image
    images["SVGF, preset paper"] = svgf.denoise(frames._replace(position=None))[1].image
    before, now = frames.object_id[2:4]
    still = (before == now) & (now != -1) & (now != BALL)
    uncovered = (before == BALL) & (now != BALL) & (now != -1)
    wall = ((now == WALL) & (np.roll(now, -1, 1) == WALL))[:, :-1]
    light = {row: np.asarray(image)[2:4] @ LUMINANCE for row, image in images.items()}
    alone = light["joint-bilateral"][1]
    print(f"{'':36}flicker  grain  ghost   ({uncovered.sum()} pixels uncovered)")
    for row, (past, last) in light.items():
        flicker = rms((last - past)[still]) / 2**0.5
        grain = rms((last[:, :-1] - last[:, 1:])[wall & still[:, :-1] & still[:, 1:]]) / 2**0.5
        print(f"{row:36}{flicker:.4f}  {grain:.4f}  {rms((last - alone)[uncovered]):.4f}")


def rms(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main(sys.argv[1])
