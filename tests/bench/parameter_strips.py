"""The strips of svgf_jax/docs/parameters.md: what one parameter does to the picture, the others as in `paper`.

Each strip shows the bundled sample, or a sequence of shared/data, the frame and the place where the panels differ most (mean
absolute difference from their mean on x / (1 + x), over a window; also printed, in levels of 255), with the PSNR of the whole
frame: python tests/bench/parameter_strips.py [NAME ...]
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
DATA = Path(__file__).parents[3] / "shared" / "data"
LIGHT = {"light_cell": 4}
STRIPS: dict[str, tuple[str, dict, tuple]] = {  # parameter: (a sequence, "" = the sample; what else is set; its values)
    "alpha": ("", {}, (0.05, 0.2, 0.5, 1.0)),
    "alpha_moments": ("", {}, (0.02, 0.2, 0.5, 1.0)),
    "max_history": ("", {"alpha": 0.0}, (2, 4, 8, 32)),
    "reproject_depth": ("gallery-pan", {}, (0.0, 0.01, 0.1, 10.0)),
    "reproject_normal": ("", {}, (-1.0, 0.5, 0.9, 0.9999)),
    "sigma_luminance": ("", {}, (0.5, 2.0, 8.0, 64.0)),
    "sigma_normal": ("", {}, (0, 8, 128, 2048)),
    "sigma_depth": ("", {}, (0.02, 0.2, 1.0, 50.0)),
    "depth_epsilon": ("", {}, (0.0001, 0.001, 0.03, 1.0)),
    "luminance_epsilon": ("", {}, (1e-6, 0.1, 1.0, 1e9)),
    "short_history_boost": ("", {}, (1, 4, 16, 64)),
    "kernel_near": ("", {}, (0.0, 2 / 3, 1.0, 4.0)),
    "kernel_far": ("", {}, (0.0, 1 / 6, 0.5, 1.0)),
    "albedo_floor": ("gallery-pan", {}, (0.001, 0.03, 0.3, 1.0)),
    "light_gain_threshold": ("lights-flicker", LIGHT, (0.0, 1.5, 5.0, 20.0)),
    "light_offset_threshold": ("lights-flicker", LIGHT, (0.0, 2.1, 8.0, 50.0)),
    "light_sigma_normal": ("lights-flicker", LIGHT, (0.0, 4.0, 64.0, 1024.0)),
    "initial_variance": ("", {"variance": "temporal"}, (0.0, 0.01, 1.0, 100.0)),
    "variance_scale": ("", {"variance": "temporal"}, (0.01, 1.0, 100.0, 10000.0)),
    "clamp_sigma": ("", {"clamp_radius": 3}, (0.0, 0.5, 1.0, 3.0)),
    "taa_alpha": ("", {"taa": True}, (0.02, 0.1, 0.5, 1.0)),
    "outlier_sigma": ("", {"outlier_radius": 3}, (0.5, 2.0, 5.0, 10.0)),
    "levels": ("", {}, (0, 1, 3, 5)),
    "feedback_level": ("", {}, (-1, 0, 1, 3)),
    "light_cell": ("lights-flicker", {}, (0, 2, 4, 12)),
    "variance": ("", {}, ("svgf", "temporal", "spatial")),
    "warm_up": ("", {"alpha": 0.05}, (True, False)),
    "clamp_radius": ("", {}, (0, 1, 3, 6)),
    "taa": ("", {}, (False, True)),
    "outlier_radius": ("", {}, (0, 1, 3, 6)),
}


@functools.cache
def sequence(name):
    """Its frames, and their references."""
    folder = DATA / name if name else svgf.sample()
    return svgf.load_sequence(folder), svgf.load_reference(folder)


@functools.cache
def compiled(config):
    return jax.jit(functools.partial(svgf.denoise, config=config))


def images(frames, values):
    """All frames of the sample, filtered."""
    params, config = override(*svgf.preset("paper"), values)
    return np.asarray(compiled(config)(frames, params=params)[1].image)


def place(panels):
    """(frame, row, column) of the window where the panels `[N, T, H, W, 3]` differ most, and by how much, in levels of 255."""
    shown = display(panels)
    apart = np.abs(shown - shown.mean(0)).mean((0, -1))
    sums = np.pad(apart, ((0, 0), (1, 0), (1, 0))).cumsum(1).cumsum(2)
    rows, columns = WINDOW
    totals = (
        sums[:, rows:, columns:] - sums[:, :-rows, columns:] - sums[:, rows:, :-columns] + sums[:, :-rows, :-columns]
    )
    return np.unravel_index(totals.argmax(), totals.shape), 255 * totals.max() / (rows * columns)


def main():
    OUT.mkdir(exist_ok=True)
    for name in sys.argv[1:] or STRIPS:
        folder, others, values = STRIPS[name]
        frames, reference = sequence(folder)
        panels = np.stack([images(frames, others | {name: value}) for value in values])
        (t, y, x), apart = place(panels)
        crops = []
        for value, panel in [*zip(values, panels, strict=True), (None, reference)]:
            cut = panel[t, y : y + WINDOW[0], x : x + WINDOW[1]]
            large = to_8bit(cut, exposure=1.6).repeat(ZOOM, 0).repeat(ZOOM, 1)
            text = f"{value:.4g}" if type(value) in (int, float) else str(value).lower()
            label = "reference" if value is None else f"{text}: {psnr(panel[t], reference[t]):.1f} dB"
            crops.append((label, large))
        path = OUT / f"{name}.jpg"
        Image.fromarray(side_by_side(crops)).save(path, quality=80)
        told = ", ".join(label for label, _ in crops[:-1])
        print(f"{name}: frame {t}, {path.stat().st_size / 1000:.0f} kB, {apart:.2f} levels; {told}", flush=True)


if __name__ == "__main__":
    main()
