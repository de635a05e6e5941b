"""What is said of a frame's noise, against noise that is known."""

import numpy as np
import pytest
from rooms import SIZE, room

from svgf_jax import noise
from svgf_jax.types import Frame


def frame_of(planes):
    ids = planes["id"][..., 0].astype(np.int32)
    depth = planes["depth"][..., 0]
    light = planes["radiance"][None]
    return Frame(
        light, planes["albedo"][None], np.zeros_like(light[0]), planes["normal"], depth, depth, planes["motion"], ids
    )


@pytest.fixture(scope="module")
def frame():
    return frame_of(room(0))


def white(strength=1.0, seed=0):
    """Light of mean 1 whose relative noise is `strength`."""
    return np.random.default_rng(seed).gamma(strength**-2, strength**2, SIZE)


def blurred(light, sigma):
    taps = np.exp(-0.5 * (np.arange(-3, 4) / sigma) ** 2)
    for axis in (0, 1):
        light = sum(tap / taps.sum() * np.roll(light, at - 3, axis) for at, tap in enumerate(taps))
    return light


@pytest.mark.parametrize("strength", [0.05, 0.3, 1.0, 1.5])
def test_relative_noise_is_that_put_in(frame, strength):
    got = noise.relative_noise(3 * white(strength), noise.uniform(frame))
    assert got == pytest.approx(strength, rel=0.12)


def test_slopes_and_edges_between_objects_are_no_noise(frame):
    ramp = 1 + 0.05 * np.arange(SIZE[1])[None] + 0.02 * np.arange(SIZE[0])[:, None]
    steps = ramp * (1.0 + np.asarray(frame.object_id))
    assert noise.relative_noise(steps, noise.uniform(frame)) < 1e-6


def test_without_light_nothing_is_said(frame):
    assert noise.relative_noise(np.zeros(SIZE), noise.uniform(frame)) is None
    assert noise.relative_noise(white(), np.zeros(SIZE, bool)) is None
    assert noise.neighbours(np.ones(SIZE), frame) == (0, None)
    assert noise.neighbours(white(), frame._replace(object_id=np.full(SIZE, -1))) == (0, None)
    where, none = noise.uniform(frame), np.zeros(SIZE, bool)
    assert noise.repeated_noise(np.ones(SIZE), np.ones(SIZE), where, none) is None
    assert noise.repeated_noise(np.zeros(SIZE), np.zeros(SIZE), none, where) is None
    assert noise.repeated_noise(white(), white(), none, none) is None
    assert noise.expected_psnr(np.ones((*SIZE, 3)), np.zeros(SIZE, bool), 0.0) is None
    assert noise.fireflies(np.zeros(SIZE), np.zeros(SIZE, bool)) == (0, 0)


def test_the_psnr_is_that_against_the_noise_free_picture(frame):
    noisy = np.clip(0.5 + 0.05 * np.random.default_rng(1).standard_normal((*SIZE, 3)), 0, 1)
    truth = -10 * np.log10(np.mean((noisy - 0.5) ** 2))
    assert noise.expected_psnr(noisy, noise.uniform(frame), 1.0) == pytest.approx(truth, abs=0.3)
    assert noise.expected_psnr(noisy, noise.uniform(frame), 0.5) == pytest.approx(truth + 3.01, abs=0.3)


@pytest.mark.parametrize(("sigma", "least", "most"), [(None, -0.05, 0.05), (0.5, 0.2, 0.5), (1.0, 0.6, 0.95)])
def test_neighbours_are_correlated_as_the_filter_makes_them(frame, sigma, least, most):
    """Of a Gaussian filter of standard deviation s, neighbours have exp(-1 / 4 s^2): 0.37 and 0.78."""
    light = white() if sigma is None else blurred(white(), sigma)
    surface = np.asarray(frame.object_id) != -1
    slope = 1 + 0.3 * np.sin(0.1 * np.arange(SIZE[1]))
    assert least < noise.neighbours(noise.bounded(light * slope, surface), frame).correlation < most


def test_one_firefly_does_not_decide_the_correlation(frame):
    light = white()
    light[30, 40:42] = 1e5
    values = noise.bounded(light, np.asarray(frame.object_id) != -1)
    assert abs(noise.neighbours(values, frame).correlation) < 0.05


@pytest.mark.parametrize("filtered", [None, 0.6])
def test_texture_is_no_correlated_noise(filtered):
    """Frames of a strong texture with little noise, which moves as the motion says."""
    before, now = frame_of(room(2)), frame_of(room(3))
    lights = []
    for number in (2, 3):
        position, noisy = room(number)["position"], white(0.25, seed=number)
        texture = np.prod(2 + np.sin(9 * position), -1)
        lights.append(texture * (noisy if filtered is None else blurred(noisy, filtered)))
    plain = noise.neighbours(noise.bounded(lights[1], np.asarray(now.object_id) != -1), now).correlation
    changed = noise.neighbours(*noise.change(lights[1], lights[0], now, before)).correlation
    assert plain > 0.3
    assert -0.05 < changed < 0.12 if filtered is None else changed > 0.3


def test_noise_of_one_seed_is_recognised(frame):
    where, none = noise.uniform(frame), np.zeros(SIZE, bool)
    assert noise.repeated_noise(white(seed=1), white(seed=2), where, none) == pytest.approx(0, abs=0.08)
    assert noise.repeated_noise(white(seed=1), white(seed=1), where, none) == pytest.approx(1)
    assert noise.repeated_noise(white(seed=1), 0.5 * white(seed=1) + 0.5 * white(seed=2), where, none) > 0.4


def test_of_what_stands_still_only_equal_values_count(frame):
    where, none = noise.uniform(frame), np.zeros(SIZE, bool)
    texture = 2 + np.sin(np.arange(SIZE[1]) * 2.0) * np.ones(SIZE)
    assert noise.repeated_noise(white(0.1, seed=1) * texture, white(0.1, seed=2) * texture, none, where) == 0
    assert noise.repeated_noise(white(seed=1), white(seed=1), none, where) == 1


def test_fireflies_are_counted_with_their_light():
    surface = np.ones(SIZE, bool)
    surface[:10] = False
    light = 1 + 0.1 * np.random.default_rng(0).random(SIZE)
    assert noise.fireflies(light, surface) == (0, 0)
    light[20, 30] = light[40, 50] = 1000
    light[5, 5] = 1e6  # nothing is there
    found = noise.fireflies(light, surface)
    assert found.pixels == pytest.approx(2 / surface.sum())
    assert found.light == pytest.approx(2000 / light[surface].sum())


def test_a_dense_spread_of_bright_pixels_is_no_firefly():
    light = np.where(np.random.default_rng(0).random(SIZE) < 0.2, 20.0, 0.0)
    assert noise.fireflies(light, np.ones(SIZE, bool)).pixels < 0.001


def test_illumination_is_repaired_as_the_filter_does():
    planes = room(0)
    planes["radiance"][20, 30:33] = [[np.nan, 0, 0], [np.inf, 0, 0], [-1, 0, 0]]
    planes["albedo"][20, 33] = 0
    light = noise.illumination(frame_of(planes))
    assert light.shape == (1, *SIZE)
    assert np.isfinite(light).all()
    np.testing.assert_array_equal(light[0, 20, 30:33], 0)


def test_the_border_and_other_surfaces_are_not_alike(frame):
    assert not noise.alike(frame, 1, 0)[:, -1].any()
    assert not noise.alike(frame, 0, -1)[0].any()
    ids = np.asarray(frame.object_id)
    assert not noise.alike(frame, 1, 0)[:, :-1][ids[:, :-1] != ids[:, 1:]].any()
    assert noise.alike(frame, 1, 0)[:, :-1][(ids[:, :-1] == ids[:, 1:]) & (ids[:, 1:] != -1)].all()
    assert not noise.uniform(frame)[:9, :9].any()
