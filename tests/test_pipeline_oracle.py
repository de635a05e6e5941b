"""The library against the oracle: float64 to 1e-9, float32 to 1e-3 on 99.9 % of pixels; real and synthetic frames."""

import functools

import numpy as np
import oracle
import pytest
import scenes
from bridge import PRESETS, relative_error, run, worst
from compiling import AS_USERS

REAL_FRAMES = 4  # enough for history lengths on both sides of 4
PER_LEVEL = oracle.PAPER | {
    "alpha": [0.3, 0.9, 0.9],
    "sigma_depth": [1.0, 2.0, 0.5],
    "sigma_normal": [16.0, 64.0, 128.0],
    "sigma_luminance": [8.0, 2.0, 4.0],
    "depth_epsilon": [1e-3, 1e-2, 1e-4],
    "luminance_epsilon": [1e-6, 1e-2, 1e-4],
    "short_history_boost": [3.0, 1.0, 1.0],
    "kernel_near": [0.7, 0.5, 0.9],
    "kernel_far": [0.2, 0.3, 0.1],
}
# name: (frames, params, config)
SYNTHETIC = {
    "one signal, paper": (
        lambda: scenes.synthetic(10, 13, 17, signals=1, frames=6),
        oracle.PAPER,
        oracle.PAPER_CONFIG,
    ),
    "two signals, falcor": (lambda: scenes.synthetic(11, 13, 17, frames=6), oracle.FALCOR, oracle.FALCOR_CONFIG),
    "three signals, an albedo each, per-level parameters": (
        lambda: scenes.synthetic(12, 13, 17, signals=3, albedos=3, frames=6),
        PER_LEVEL,
        {"levels": 3, "feedback_level": 1},
    ),
    "NaN, Inf and negative pixels": (
        lambda: scenes.synthetic(13, 13, 17, frames=6, dirty=True),
        oracle.FALCOR,
        oracle.FALCOR_CONFIG,
    ),
    "no feedback": (
        lambda: scenes.synthetic(14, 13, 17, frames=6),
        oracle.PAPER | {"max_history": 4.0},
        {"levels": 2, "feedback_level": -1},
    ),
    "feedback beyond the last level": (
        lambda: scenes.synthetic(15, 13, 17, frames=5),
        oracle.PAPER,
        {"levels": 2, "feedback_level": 7},
    ),
    "the choices of temporal anti-aliasing": (
        lambda: scenes.synthetic(18, 13, 17, frames=4, dirty=True),
        oracle.PAPER | {"clamp_sigma": 0.7},
        {"levels": 1, "feedback_level": 0, "clamp_radius": 3}
        | {"reprojection": "nearest", "fallback": False, "id_test": False, "warm_up": False, "prefilter": False},
    ),
    "no levels": (lambda: scenes.synthetic(16, 13, 17, frames=5), oracle.PAPER, {"levels": 0, "feedback_level": 0}),
    "rows that do not divide into strips": (
        lambda: scenes.synthetic(17, 73, 5, signals=1, frames=2),
        oracle.PAPER,
        {"levels": 3, "feedback_level": 0},
    ),
}


@functools.cache
def real_case(data, name, preset):
    frames = scenes.real(data, name, frames=REAL_FRAMES)
    return frames, oracle.denoise(frames, *PRESETS[preset])


def assert_float64(results, expected):
    errors = worst(results, expected)
    assert max(errors.values()) < 1e-9, errors


def assert_float32(results, expected):
    for t, ((_, output), wanted) in enumerate(zip(results, expected, strict=True)):
        assert output.image.dtype == np.float32
        error = relative_error(output.image, wanted["image"]).max(axis=-1)
        assert np.mean(error < 1e-3) >= 0.999, (t, float(np.mean(error < 1e-3)), float(error.max()))


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", scenes.CROPS)
def test_real_crop_float64(data, name, preset):
    frames, expected = real_case(data, name, preset)
    assert (expected[-1]["history_length"] >= 4 - 1e-3).any()
    assert_float64(run(frames, *PRESETS[preset], options=AS_USERS), expected)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", scenes.CROPS)
def test_real_crop_float32(data, name, preset):
    frames, expected = real_case(data, name, preset)
    assert_float32(run(frames, *PRESETS[preset], dtype=np.float32, options=AS_USERS), expected)


@pytest.mark.parametrize("case", SYNTHETIC)
def test_synthetic_float64(case):
    make, params, config = SYNTHETIC[case]
    frames = make()
    expected = oracle.denoise(frames, params, config)
    results = run(frames, params, config)
    assert_float64(results, expected)
    for (_, output), wanted in zip(results, expected, strict=True):
        assert {k: int(v) for k, v in output.rejected._asdict().items()} == wanted["rejected"]


def test_synthetic_float32():
    frames = scenes.synthetic(11, 32, 33, frames=6)
    assert_float32(
        run(frames, oracle.FALCOR, oracle.FALCOR_CONFIG, np.float32),
        oracle.denoise(frames, oracle.FALCOR, oracle.FALCOR_CONFIG),
    )


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 9), (9, 1), (2, 3)])
def test_any_size(height, width):
    frames = scenes.synthetic(height + 10 * width, height, width, frames=5)
    config = {"levels": 2, "feedback_level": 0}
    assert_float64(run(frames, oracle.PAPER, config), oracle.denoise(frames, oracle.PAPER, config))
