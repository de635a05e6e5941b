"""The golden set: what four presets made of a piece of the bundled sample, kept to see what a change, a version or a device does.

    python tests/golden.py                # compare: for each preset and layer the largest difference, where, and the tolerance
    python tests/golden.py --devices 2    # the same, with each frame's rows divided over so many devices
    python tests/golden.py --write        # keep what comes out now, with the versions that made it

Exits with 1 if anything is beyond its tolerance. A difference is relative to |then| + 1/1000 of the layer's largest value.
"""

import argparse
import json
import platform
import sys
from functools import partial
from pathlib import Path

import jax
import numpy as np

import svgf_jax as svgf
from svgf_jax import atomic

KEPT = Path(__file__).parent / "data" / "golden" / "sample.npz"
PRESETS = ("paper", "falcor", "tuned", "adaptive")
LAYERS = ("image", "variance", "history_length")
ROWS, COLUMNS = slice(62, 86), slice(92, 124)  # the moving box's edge, its shadow, the wall behind
FRAMES = "0-3"
COLOURS = ("radiance", "albedo", "emission", "normal", "motion")
TOLERANCE = {"image": 1e-5, "variance": 1e-4, "history_length": 1e-5}  # ten times and more what versions differ by


def frames() -> svgf.Frame:
    """Four frames of 24x32, float32."""
    whole = svgf.load_sequence(svgf.sample(), frames=FRAMES)

    def cut(name, array):
        return array[..., ROWS, COLUMNS, :] if name in COLOURS else array[..., ROWS, COLUMNS]

    given = {name: np.asarray(array) for name, array in whole._asdict().items() if array is not None}
    return svgf.Frame(**{name: cut(name, array) for name, array in given.items()})


def outputs(presets=PRESETS, *, devices: int = 1) -> dict[str, np.ndarray]:
    """`preset.layer` -> the last frame's, of each preset. Presets of one configuration share what is compiled."""
    found, shot, steps = {}, frames(), {}
    for preset in presets:
        params, config = svgf.preset(preset)
        levels = (config.levels,)
        params = jax.tree.map(lambda number: np.broadcast_to(np.float32(number), levels), params)  # noqa: B023 (at once)
        if config not in steps:
            step = partial(svgf.step, config=config)
            if devices > 1:
                step = partial(svgf.step_over, config=config, devices=jax.devices()[:devices])
            steps[config] = jax.jit(step)
        history, output = svgf.init(jax.tree.map(lambda a: a[0], shot), config=config), None
        for i in range(len(shot.depth)):
            history, output = steps[config](history, jax.tree.map(lambda a: a[i], shot), params=params)  # noqa: B023
        found |= {f"{preset}.{layer}": np.asarray(getattr(output, layer)) for layer in LAYERS}
    return found


def difference(now: np.ndarray, then: np.ndarray) -> np.ndarray:
    """Relative, for each element; infinite where one of them is not finite."""
    now, then = now.astype(np.float64), then.astype(np.float64)
    scale = np.abs(then) + 1e-3 * max(np.abs(then).max(), 1e-30)
    return np.where(np.isfinite(now), np.abs(np.where(np.isfinite(now), now, 0) - then) / scale, np.inf)


def versions() -> dict[str, str]:
    device = jax.devices()[0]
    processor = platform.machine()
    return {
        "svgf_jax": svgf.__version__,
        "jax": jax.__version__,
        "device": f"{device.platform} ({device.device_kind}, {processor})",
    }


def load() -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, str]]:
    """The kept arrays, the tolerance of each layer, the versions that made them."""
    with np.load(KEPT) as file:
        arrays = {name: file[name] for name in file.files}
    about = json.loads(str(arrays.pop("about")))
    return arrays, about["tolerance"], about["versions"]


def compare(now: dict[str, np.ndarray]) -> tuple[list[str], bool]:
    """A line for each array, and whether all are within their tolerance."""
    then, tolerance, made_by = load()
    lines = [f"then {made_by}", f"now  {versions()}", f"{'preset.layer':24} {'largest':>9} {'allowed':>9}"]
    good = now.keys() <= then.keys()
    for name in sorted(now.keys() & then.keys()):
        if now[name].shape != then[name].shape:
            lines.append(f"{name:24} shape {now[name].shape}, was {then[name].shape}")
            good = False
            continue
        error, allowed = difference(now[name], then[name]), tolerance[name.split(".")[1]]
        at = np.unravel_index(error.argmax(), error.shape)
        text = f"{name:24} {error.max():9.1e} {allowed:9.1e}"
        if error.max() > 0:
            place = ", ".join(map(str, map(int, at)))
            text += f"  at [{place}]: {then[name][at]:.8g} -> {now[name][at]:.8g}"
        if error.max() > allowed:
            good = False
            text += f"  BEYOND ({int((error > allowed).sum())} of {error.size} values)"
        lines.append(text)
    return lines, good


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--devices", type=int, default=1)
    options = parser.parse_args()
    if options.devices > 1:
        jax.config.update("jax_num_cpu_devices", options.devices)
        if len(jax.devices()) < options.devices:
            parser.error(f"there are only {len(jax.devices())} devices here")
    now = outputs(devices=options.devices)
    if options.write:
        KEPT.parent.mkdir(parents=True, exist_ok=True)
        about = json.dumps({"tolerance": TOLERANCE, "versions": versions(), "frames": FRAMES})
        with atomic.replacing(KEPT) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, about=np.asarray(about), **now)
        print(f"{KEPT}: {KEPT.stat().st_size} bytes")
        return 0
    lines, good = compare(now)
    print("\n".join(lines))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
