"""Gaussian, bilateral and joint bilateral filters: against loops, what they keep, their derivatives."""

import jax
import numpy as np
import oracle_bilateral as oracle
import pytest
from bridge import QUICK

import svgf_jax as sj
from svgf_jax import joint_bilateral

SIGMAS = {"space": 2.5, "color": 0.7, "normal": 0.6, "plane": 0.4}


def scene(height, width, channels=3, seed=0):
    """An image and its guides: two walls at an angle with a step in depth between them, background, textures, noise."""
    rng = np.random.default_rng(seed)
    y, x = np.meshgrid(np.arange(height) + 0.0, np.arange(width) + 0.0, indexing="ij")
    right = x > width / 2
    slant = 0.3 * rng.normal(size=(height, width, 3)) * (y < 2)[..., None]  # two rows of a rough surface
    normal = np.where(right[..., None], [0.6, 0.0, -0.8], [0.0, 0.0, -1.0]) + slant
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    position = np.stack([0.1 * x, 0.1 * y, 3.0 + right * (0.075 * x - 0.5)], axis=-1)
    position[height // 2, : width // 3] = position[height // 2, 0]  # several pixels of one point
    image = rng.gamma(0.6, 1.0, (height, width, channels))
    image[:, : width // 4] = 0.5  # equal colors
    mask = rng.random((height, width)) > 0.2
    normal[~mask] = 0.0
    return {"image": image, "normal": normal, "position": position, "depth": position[..., 2] ** 2, "mask": mask}


SETTINGS = {
    "gaussian": (sj.gaussian_filter, {"sigma": SIGMAS["space"]}),
    "bilateral": (sj.bilateral_filter, {"sigma_space": SIGMAS["space"], "sigma_color": SIGMAS["color"]}),
    "joint": (sj.joint_bilateral_filter, {f"sigma_{name}": value for name, value in SIGMAS.items()}),
}


def run(name, s, *, mask=None, dtype=np.float64, sigmas=None, **static):
    """The library's filter, jitted, with traced sigmas."""
    function, sigmas = SETTINGS[name][0], SETTINGS[name][1] | (sigmas or {})
    arrays = {k: s[k] for k in ("normal", "position")} | {"guides": [(s["depth"], 2.0)]} if name == "joint" else {}
    values = jax.tree.map(lambda leaf: np.asarray(leaf, dtype), (s["image"], arrays | sigmas))
    call = lambda image, traced, mask: function(image, **traced, mask=mask, **static)  # noqa: E731
    return np.asarray(jax.jit(call, compiler_options=dict(QUICK))(*values, mask))


def by_loops(name, s, *, radius, **options):
    guides = (
        {"normal": s["normal"], "position": s["position"], "others": [(s["depth"], 2.0)]} if name == "joint" else {}
    )
    used = {"gaussian": ["space"], "bilateral": ["space", "color"], "joint": list(SIGMAS)}[name]
    return oracle.joint_bilateral(s["image"], guides, {k: SIGMAS[k] for k in used}, radius, **options)


@pytest.mark.parametrize("footprint", joint_bilateral.FOOTPRINTS)
@pytest.mark.parametrize("name", SETTINGS)
def test_filters_are_their_formulas(name, footprint):
    s = scene(10, 13)
    options = {"radius": 4, "footprint": footprint, "mask": s["mask"], "last_pass": footprint == "atrous"}
    got = run(name, s, **options)
    np.testing.assert_allclose(got, by_loops(name, s, **options), rtol=1e-11, atol=1e-11)
    np.testing.assert_array_equal(got[~s["mask"]], s["image"][~s["mask"]])
    assert np.abs(got - s["image"]).max() > 0.3


@pytest.mark.parametrize(("size", "channels"), [((1, 1), 1), ((1, 7), 2), ((5, 1), 4)])
def test_images_smaller_than_the_window(size, channels):
    s = scene(*size, channels)
    np.testing.assert_allclose(run("joint", s, radius=6), by_loops("joint", s, radius=6), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_zero_sum_of_weights_gives_the_input_pixel(dtype):
    """Without a normal the clamped dot product is 0, a right angle, even of a pixel with itself: exp(-123) at 0.1 radians."""
    s = scene(6, 7)
    s["normal"] = np.where((np.arange(7) < 3)[None, :, None], 0.0, s["normal"])
    s["image"] = s["image"].astype(dtype)
    got = run("joint", s, radius=3, dtype=dtype, sigmas={"sigma_normal": 0.1})
    np.testing.assert_array_equal(got[:, :3], s["image"][:, :3])
