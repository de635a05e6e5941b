"""What following the light makes of steady light: false alarms, and fireflies close to each other.

    python tests/bench/response.py [alarms] [fireflies] [worth]

A plain wall of luminance 1 under noise of mean 1, preset `adaptive`. Alarms: 256x256, frames 10 to 14, with the stage and without:
variance over the pixels of the history without / with it, mean square error and squared difference of successive frames of the
filtered picture with / without it. Fireflies: 128x128, uniform noise of one sample, in the 11th frame so many pixels inside 16x16
have 1000 times the wall's light: the share of the wall whose history is made more than 30 % brighter, mean of 12 tries. (How soon
steps of the light are followed: tests/test_adaptation.py.) Worth: what `effective_history` tells beside what is seen, one frame's
variance over that of the accumulated light about its mean, without spatial filter: in the frame before a step of the light and the
three after it, of a whole wall and of squares in one, their outermost 3 pixels left out; 120x120, means of 4 draws.
"""

import sys
from pathlib import Path

import jax
import numpy as np

import svgf_jax as sj

sys.path.insert(0, str(Path(__file__).parents[1]))

import bridge
import scenes
from test_adaptation import NOISES

from svgf_jax.types import at_level

PARAMS, CONFIG = sj.preset("adaptive")
PARAMS = jax.tree.map(np.float32, PARAMS)


def wall(light: np.ndarray) -> sj.Frame:
    """A frame of light `[H, W]` on a wall."""
    radiance = np.broadcast_to(light[None, ..., None], (1, *light.shape, 3))
    return bridge.to_frame({**scenes.flat(*light.shape), "radiance": radiance}, np.float32)


def filtered(lights, config: sj.Config, params: sj.Params = PARAMS):
    """Each frame's history and output."""
    history = None
    for light in lights:
        frame = wall(light)
        history = sj.init(frame, config=config, effective_history=True) if history is None else history
        history, output = sj.step(history, frame, params=params, config=config)
        yield jax.tree.map(np.asarray, (history, output))


def alarms() -> None:
    print("| noise | samples | variance kept | mean square error | flicker |\n|---|---|---|---|---|")
    for name, noise in NOISES.items():
        for samples in (1, 2, 4):
            told = []
            for cell in (CONFIG.light_cell, 0):
                rng = np.random.default_rng(7)
                lights = (noise(rng, (samples, 256, 256)).mean(axis=0) for _ in range(14))
                found = list(filtered(lights, CONFIG._replace(light_cell=cell)))[8:]
                images = np.stack([output.image for _, output in found])
                variance = np.mean([history.illumination[0, ..., 1].var() for history, _ in found[1:]])
                told.append((variance, ((images[1:] - 1) ** 2).mean(), (np.diff(images, axis=0) ** 2).mean()))
            (variance, error, flicker), without = told
            ratios = without[0] / variance, error / without[1], flicker / without[2]
            print(f"| {name} | {samples} | " + " | ".join(f"{ratio:.2f}" for ratio in ratios) + " |", flush=True)


def fireflies() -> None:
    print("| `outlier_radius` | fireflies | share of the wall |\n|---|---|---|")
    for radius in (0, 3):
        for count in (1, 2, 3):
            shares = []
            for seed in range(12):
                rng = np.random.default_rng(seed)
                lights = rng.uniform(0, 2, (11, 128, 128))
                lights[10, rng.integers(56, 72, count), rng.integers(56, 72, count)] = 1000.0
                *_, (_, output) = filtered(lights, CONFIG._replace(outlier_radius=radius))
                shares.append((output.change[0] > 1 - 1 / 1.3).mean())  # as a share of the brighter
            print(f"| {radius} | {count} | {100 * np.mean(shares):.2f} % |", flush=True)


def worth() -> None:
    config, params = CONFIG._replace(levels=0, feedback_level=-1), at_level(PARAMS, 0)
    head = " | ".join(["before", "1st", "2nd", "3rd"])
    print(f"| noise | samples | square | step | {head} (told / seen) |\n|---|---|---|---|---|---|---|---|")
    for name, noise in NOISES.items():
        for samples, size in ((1, 120), (4, 120), (1, 100), (1, 48), (1, 24), (1, 12)):
            one = noise(np.random.default_rng(1), (samples, 10**6)).mean(axis=0).var()
            edge = (120 - size) // 2
            for factor in (0.1, 2.0, 10.0):
                inner = (slice(edge + 3, 117 - edge),) * 2
                told, seen = np.zeros(4), np.zeros(4)  # as shares of one frame's variance
                for seed in range(4):
                    rng, light = np.random.default_rng(seed), np.ones((12, 120, 120))
                    light[9:, edge : 120 - edge, edge : 120 - edge] = factor
                    lights = (now * noise(rng, (samples, 120, 120)).mean(axis=0) for now in light)
                    for i, (history, output) in enumerate(list(filtered(lights, config, params))[8:]):
                        here = history.illumination[0, ..., 1][inner] / light[8 + i, 60, 60]
                        told[i] += (1 / output.effective_history[0][inner]).mean() / 4
                        seen[i] += here.var() / one / 4
                cells = " | ".join(f"{1 / a:.2f} / {1 / b:.2f}" for a, b in zip(told, seen, strict=True))
                print(f"| {name} | {samples} | {size} | {factor:g} | {cells} |", flush=True)


if __name__ == "__main__":
    for name in sys.argv[1:] or ("alarms", "fireflies", "worth"):
        {"alarms": alarms, "fireflies": fireflies, "worth": worth}[name]()
