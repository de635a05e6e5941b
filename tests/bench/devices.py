"""One frame over several CPU devices.

JAX_NUM_CPU_DEVICES=4 python tests/bench/devices.py check      every preset over 2, 3 and 4 devices, with derivatives
JAX_NUM_CPU_DEVICES=2 python tests/bench/devices.py scaling [1920x1080]    seconds a frame, interleaved
"""

import sys
import time
from functools import partial
from pathlib import Path

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
import over_devices
import scenes
from bridge import to_frame

from svgf_jax import init, preset, step, step_over


def check():
    """The largest difference to one device, relative to the largest value; of the derivative by all numbers too."""
    for name in ("paper", "falcor", "tuned", "adaptive"):
        for count, height in ((2, 24), (3, 25), (4, 25)):
            print(name, count, height, over_devices.steps(name, count, (height, 14), signals=2), flush=True)
        print(name, "derivative", derivative(name), flush=True)


def derivative(name):
    """Of the second frame's image along a change of all numbers and the radiance."""
    params, config = preset(name)
    params = type(params)(*(np.asarray(value, np.float32) for value in params))
    first, second = (to_frame(frame, np.float32) for frame in scenes.synthetic(3, 13, 11, frames=2))
    history, _ = step(init(first), first, params=params, config=config)

    def image(go, params, radiance):
        return go(history, second._replace(radiance=radiance), params=params, config=config)[1].image

    given = (params, second.radiance)
    functions = (step, partial(step_over, devices=jax.devices()[:3]))
    return over_devices.difference(*(jax.jvp(partial(image, go), given, given)[1] for go in functions))


def scaling(size="1920x1080"):
    """Strong: a picture over 1 and 2 devices. Weak: half of it over 1."""
    width, height = map(int, size.split("x"))
    params, config = preset("paper")
    cases = {"1 device": (height, 1), "2 devices": (height, 2), "1 device, half the picture": (height // 2, 1)}
    runs = {}
    for name, (rows, count) in cases.items():
        frame = to_frame(scenes.synthetic(3, rows, width, frames=1)[0], np.float32)
        go = partial(step_over, devices=jax.devices()[:count], params=params, config=config)
        history, _ = go(init(frame), frame)
        runs[name] = (go, history, frame, [])
    for _ in range(9):
        for go, history, frame, seconds in runs.values():
            began = time.perf_counter()
            jax.block_until_ready(go(history, frame))
            seconds.append(time.perf_counter() - began)
    for name, (*_, seconds) in runs.items():
        print(f"{name}: median {np.median(seconds):.2f} s, least {min(seconds):.2f} s", flush=True)


if __name__ == "__main__":
    {"check": check, "scaling": scaling}[sys.argv[1]](*sys.argv[2:])
