"""The strips of svgf_jax/docs/parameters.md: what one parameter does to the picture, the others as in `paper`.

Each strip shows the bundled sample, the frame and the place where the panels differ most (mean absolute difference from their
mean on x / (1 + x), over a window), with the PSNR of the whole frame: python tests/bench/parameter_strips.py [NAME ...]
"""

import functools
import sys
from pathlib import Path

import jax
import numpy as np
from PIL import Image

import svgf_jax as svgf
from svgf_jax.metrics import display, psnr
from svgf_jax.parameters import override
from svgf_jax.preview import side_by_side, to_8bit

OUT = Path(__file__).parents[2] / "svgf_jax" / "docs" / "parameters"
WINDOW = (64, 96)  # rows, columns
ZOOM = 2
STRIPS: dict[str, tuple[dict, tuple]] = {  # parameter: (what else is set, its values)
    "alpha": ({}, (0.05, 0.2, 0.5, 1.0)),
    "alpha_moments": ({}, (0.02, 0.2, 0.5, 1.0)),
    "max_history": ({"alpha": 0.0}, (2, 4, 8, 32)),
    "sigma_luminance": ({}, (0.5, 2.0, 8.0, 64.0)),
    "sigma_normal": ({}, (0, 8, 128, 2048)),
    "sigma_depth": ({}, (0.02, 0.2, 1.0, 50.0)),
    "depth_epsilon": ({}, (0.0001, 0.001, 0.03, 1.0)),
    "short_history_boost": ({}, (1, 4, 16, 64)),
    "kernel_far": ({}, (0.0, 1 / 6, 0.5, 1.0)),
    "clamp_sigma": ({"clamp_radius": 3}, (0.0, 0.5, 1.0, 3.0)),
    "outlier_sigma": ({"outlier_radius": 3}, (0.5, 2.0, 5.0, 10.0)),
    "levels": ({}, (0, 1, 3, 5)),
    "feedback_level": ({}, (-1, 0, 1, 3)),
}


@functools.cache
def compiled(config):
    return jax.jit(functools.partial(svgf.denoise, config=config))


def images(frames, values):
    """All frames of the sample, filtered."""
    params, config = override(*svgf.preset("paper"), values)
    return np.asarray(compiled(config)(frames, params=params)[1].image)


def place(panels):
    """(frame, row, column) of the window where the panels `[N, T, H, W, 3]` differ most."""
    shown = display(panels)
    apart = np.abs(shown - shown.mean(0)).mean((0, -1))
    sums = np.pad(apart, ((0, 0), (1, 0), (1, 0))).cumsum(1).cumsum(2)
    rows, columns = WINDOW
    totals = (
        sums[:, rows:, columns:] - sums[:, :-rows, columns:] - sums[:, rows:, :-columns] + sums[:, :-rows, :-columns]
    )
    return np.unravel_index(totals.argmax(), totals.shape)


def main():
    frames, reference = svgf.load_sequence(svgf.sample()), svgf.load_reference(svgf.sample())
    OUT.mkdir(exist_ok=True)
    for name in sys.argv[1:] or STRIPS:
        others, values = STRIPS[name]
        panels = np.stack([images(frames, others | {name: value}) for value in values])
        t, y, x = place(panels)
        crops = []
        for value, panel in [*zip(values, panels, strict=True), (None, reference)]:
            cut = panel[t, y : y + WINDOW[0], x : x + WINDOW[1]]
            large = to_8bit(cut, exposure=1.6).repeat(ZOOM, 0).repeat(ZOOM, 1)
            label = "reference" if value is None else f"{value:.4g}: {psnr(panel[t], reference[t]):.1f} dB"
            crops.append((label, large))
        path = OUT / f"{name}.jpg"
        Image.fromarray(side_by_side(crops)).save(path, quality=80)
        print(f"{name}: frame {t}, {path.stat().st_size / 1000:.0f} kB; " + ", ".join(label for label, _ in crops[:-1]))


if __name__ == "__main__":
    main()
