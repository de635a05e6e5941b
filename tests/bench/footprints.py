"""Time and error of the footprints of the joint bilateral filter against `full`, on a real frame.

    python tests/bench/footprints.py [cornell-dolly|games202-box] [--rounds 5]

Prints a Markdown table. Times are medians of rounds in which all forms of a radius take turns, as ratios to `full`; errors are RMSE
on x / (1 + x) against the `full` of the same radius, over the pixels with a surface. sigma_space = radius, the other sigmas are
those of the homework.
"""

import argparse
import sys
import time
from pathlib import Path

import jax
import numpy as np

import svgf_jax as sj
from svgf_jax import exr
from svgf_jax.metrics import display

DATA = Path(__file__).parents[3] / "shared" / "data"
FORMS = {
    "full": {"footprint": "full"},
    "separable": {"footprint": "separable"},
    "atrous": {"footprint": "atrous"},
    "atrous, last pass": {"footprint": "atrous", "last_pass": True},
}
RADII = (4, 8, 16, 32)


def read(name):
    """(image, normal, position, surface) of one frame."""
    if name == "games202-box":
        read_file = lambda kind: exr.read(DATA / name / "input" / f"{kind}_0.exr").channels  # noqa: E731
        image, normal, position = (
            np.stack([read_file(k)[c] for c in "RGB"], axis=-1) for k in ("beauty", "normal", "position")
        )
        return image, normal, position, read_file("ID")["Y"] >= 0
    channels = exr.read(DATA / name / "frame_0005.exr").channels
    layer = lambda kind, names: np.stack([channels[f"{kind}.{c}"] for c in names], axis=-1).astype(np.float32)  # noqa: E731
    normal = layer("normal", "XYZ")
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    image = layer("direct", "RGB") + layer("indirect", "RGB")
    return image, normal, layer("position", "XYZ"), channels["id.I"] >= 0


def filters(radius, **options):
    """The three filters at one radius, on (image, normal, position, mask)."""
    joint = lambda i, n, x, m: sj.joint_bilateral_filter(  # noqa: E731
        i, normal=n, position=x, sigma_space=float(radius), radius=radius, mask=m, **options
    )
    bilateral = lambda i, n, x, m: sj.bilateral_filter(  # noqa: E731
        i, sigma_space=float(radius), sigma_color=0.6, radius=radius, mask=m, **options
    )
    gaussian = lambda i, n, x, m: sj.gaussian_filter(i, sigma=float(radius), radius=radius, mask=m, **options)  # noqa: E731
    return {"joint bilateral": joint, "bilateral": bilateral, "gaussian": gaussian}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("name", nargs="?", default="games202-box")
    parser.add_argument("--rounds", type=int, default=5)
    asked = parser.parse_args()
    frame = read(asked.name)
    surface = frame[-1]
    error = lambda a, b: float(np.sqrt(np.mean((display(a) - display(b))[surface] ** 2)))  # noqa: E731
    print("| filter | radius | full | " + " | ".join(f"{form} | error" for form in list(FORMS)[1:]) + " |")
    print("|---" * (2 * len(FORMS) + 1) + "|")
    for kind in ("joint bilateral", "bilateral", "gaussian"):
        for radius in RADII:
            run = {form: jax.jit(filters(radius, **options)[kind]) for form, options in FORMS.items()}
            images = {form: np.asarray(function(*frame)) for form, function in run.items()}
            seconds = {form: [] for form in FORMS}
            for _ in range(asked.rounds):
                for form, function in run.items():
                    start = time.perf_counter()
                    jax.block_until_ready(function(*frame))
                    seconds[form].append(time.perf_counter() - start)
            medians = {form: float(np.median(values)) for form, values in seconds.items()}
            cells = [f"{medians['full']:.2f} s"]
            for form in list(FORMS)[1:]:
                cells += [f"x {medians[form] / medians['full']:.2f}", f"{error(images[form], images['full']):.4f}"]
            print(f"| {kind} | {radius} | " + " | ".join(cells) + " |", flush=True)
    changed = error(frame[0], np.asarray(jax.jit(filters(16)["joint bilateral"])(*frame)))
    print(f"\nError of the unfiltered frame against the joint filter of radius 16: {changed:.4f}", file=sys.stderr)


if __name__ == "__main__":
    main()
