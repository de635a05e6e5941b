"""Tone curves against values by hand, there and back, in NumPy and in JAX."""

from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from svgf_jax import SvgfError, decode_srgb, encode_srgb, metrics, tonemap, untonemap
from svgf_jax.commands.settings import Tonemap
from svgf_jax.tonemapping import CURVES

ALL = pytest.mark.parametrize("curve", CURVES)
COLORS = np.random.default_rng(0).gamma(0.7, 1.5, (200, 3))


def by_hand(curve, rgb):
    """The curves as their sources print them, one colour at a time."""
    if curve == "aces-hill":
        to_rrt = [[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]]
        to_srgb = [[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]]
        v = [sum(m * c for m, c in zip(row, rgb, strict=True)) for row in to_rrt]
        v = [(x * (x + 0.0245786) - 0.000090537) / (x * (0.983729 * x + 0.4329510) + 0.238081) for x in v]
        shown = [sum(m * c for m, c in zip(row, v, strict=True)) for row in to_srgb]
    else:
        one = {
            "reinhard": lambda x: x / (1 + x),
            "reinhard-extended": lambda x: x * (1 + x / 16) / (1 + x),
            "aces-narkowicz": lambda x: x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14),
            "linear": lambda x: x,
        }[curve]
        shown = [one(x) for x in rgb]
    return [min(max(x, 0.0), 1.0) for x in shown]


@ALL
def test_the_curves_are_those_of_their_sources(curve):
    expected = [by_hand(curve, color) for color in COLORS]
    np.testing.assert_allclose(tonemap(COLORS, curve=curve), expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(tonemap(COLORS / 2, curve=curve, exposure=2.0), expected, rtol=1e-12, atol=1e-15)
    in_jax = tonemap(jnp.asarray(COLORS, jnp.float32), curve=curve)
    assert in_jax.dtype == np.float32
    np.testing.assert_allclose(in_jax, expected, atol=1e-6)


@ALL
def test_there_and_back(curve):
    shown = tonemap(COLORS, curve=curve)
    whole = ((shown > 0) & (shown < 1)).all(-1)
    assert whole.mean() > 0.3
    np.testing.assert_allclose(untonemap(shown, curve=curve)[whole], COLORS[whole], rtol=1e-9)
    dark = tonemap(COLORS, curve=curve, exposure=0.5)
    whole = ((dark > 0) & (dark < 1)).all(-1)
    np.testing.assert_allclose(untonemap(dark, curve=curve, exposure=0.5)[whole], COLORS[whole], rtol=1e-9)


@ALL
def test_brighter_is_brighter_and_nothing_breaks_a_curve(curve):
    grey = np.repeat(np.concatenate([[-1.0, 0.0], np.geomspace(1e-6, 1e30, 300), [np.inf]])[:, None], 3, 1)
    for dtype in (np.float32, np.float64):
        shown = tonemap(grey.astype(dtype), curve=curve)
        assert (np.diff(shown, axis=0) >= -1e-6).all()
        assert (shown[:2] == 0).all()
        assert shown[-1] == pytest.approx(1.0, abs=1e-6)
        assert np.isfinite(untonemap(shown, curve=curve)).all()


@ALL
def test_gradients_are_finite(curve):
    x = jnp.asarray([[-1.0, 0.0, 1e-8], [0.0031308, 1.0, 4.0], [7.3, 1e4, 1e30]], jnp.float32)
    there = jax.grad(lambda x: encode_srgb(tonemap(x, curve=curve)).sum())(x)
    back = jax.grad(lambda y: untonemap(decode_srgb(y), curve=curve).sum())(jnp.clip(x, 0, 1))
    assert np.isfinite(there).all()
    assert np.isfinite(back).all()


def test_srgb():
    code = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(encode_srgb(decode_srgb(code)), code, atol=1e-6)
    np.testing.assert_allclose(encode_srgb(np.array([0.0, 0.18, 1.0])), [0.0, 0.461356, 1.0], atol=1e-6)
    assert encode_srgb(jnp.float32([0.5])).dtype == np.float32


def test_metrics_look_at_reinhards_curve():
    x = np.array([[-1.0, 0.0, 1.0, np.inf, np.nan]])
    np.testing.assert_array_equal(metrics.display(x), [[0, 0, 0.5, 1, np.nan]])


def test_an_unknown_curve_is_named_and_the_command_line_knows_all():
    with pytest.raises(SvgfError, match="no tone curve 'filmic'; there are reinhard-extended, reinhard, aces"):
        tonemap(COLORS, curve="filmic")
    assert get_args(Tonemap) == tuple(CURVES)


@pytest.mark.parametrize("exposure", [0, -1, np.inf, np.nan])
def test_an_exposure_that_means_nothing_is_refused(exposure):
    for function in (tonemap, untonemap):
        with pytest.raises(SvgfError, match="wanted a finite number above 0"):
            function(COLORS, exposure=exposure)


@pytest.mark.parametrize("function", [tonemap, untonemap, encode_srgb, decode_srgb])
def test_lists_are_taken_and_whole_numbers_refused(function):
    np.testing.assert_array_equal(function([[0, 0.25, 1]]), function(np.array([[0, 0.25, 1]])))
    for whole in (np.zeros((2, 3), np.uint8), jnp.zeros((2, 3), jnp.int32)):
        with pytest.raises(SvgfError, match=f"Got a color of {whole.dtype}; wanted floats"):
            function(whole)
    with pytest.raises(SvgfError, match="Got a list as a color"):
        function([[0.0], [1.0, 2.0]])
    assert np.isnan(function(np.array([[0.5, 0.5, np.nan]]))).tolist() == [[False, False, True]]


def test_hills_curve_wants_three_channels_and_is_darker_than_narkowiczs():
    with pytest.raises(SvgfError, match=r"Got a color of shape \(200, 2\)"):
        tonemap(COLORS[:, :2], curve="aces-hill")
    grey = [[0.18] * 3, [1.0] * 3]
    np.testing.assert_allclose(tonemap(grey, curve="aces-hill")[0], 0.106, atol=5e-4)
    there, here = tonemap(grey, curve="aces-hill", exposure=2.0), tonemap(grey, curve="aces-narkowicz")
    np.testing.assert_allclose(there, here, atol=0.005)
