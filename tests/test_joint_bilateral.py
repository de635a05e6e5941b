"""Gaussian, bilateral and joint bilateral filters: against loops, what they keep, their derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracle_classic as oracle
import pytest
from compiling import AS_USERS
from hypothesis import given, settings
from hypothesis import strategies as st

from svgf_jax import joint_bilateral
from svgf_jax.types import SvgfError

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
    "gaussian": ("gaussian_filter", {"sigma": SIGMAS["space"]}),
    "bilateral": ("bilateral_filter", {"sigma_space": SIGMAS["space"], "sigma_color": SIGMAS["color"]}),
    "joint": ("joint_bilateral_filter", {f"sigma_{name}": value for name, value in SIGMAS.items()}),
}


def arguments(name, s, sigmas=None, dtype=np.float64):
    """What the filter takes besides the image and is traced: guides and sigmas."""
    arrays = {k: s[k] for k in ("normal", "position")} | {"guides": [(s["depth"], 2.0)]} if name == "joint" else {}
    return jax.tree.map(lambda leaf: np.asarray(leaf, dtype), arrays | SETTINGS[name][1] | (sigmas or {}))


def run(name, s, *, mask=None, dtype=np.float64, sigmas=None, **static):
    """The library's filter, jitted; read from its module when it runs, so that `test_mutants` can put a broken one there."""
    function = getattr(joint_bilateral, SETTINGS[name][0])
    call = lambda image, traced, mask: function(image, **traced, mask=mask, **static)  # noqa: E731
    jitted = jax.jit(call)
    return np.asarray(jitted(s["image"].astype(dtype), arguments(name, s, sigmas, dtype), mask))


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
    np.testing.assert_allclose(got, by_loops(name, s, **options), rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(got[~s["mask"]], s["image"][~s["mask"]])
    assert np.abs(got - s["image"]).max() > 0.3


@pytest.mark.parametrize(("size", "channels"), [((1, 1), 1), ((5, 1), 4)])
def test_images_smaller_than_the_window(size, channels):
    s = scene(*size, channels)
    np.testing.assert_allclose(run("joint", s, radius=6), by_loops("joint", s, radius=6), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("footprint", joint_bilateral.FOOTPRINTS)
@pytest.mark.parametrize("name", ["joint", "gaussian"])
def test_a_broken_pixel_becomes_the_mean_of_the_others(name, footprint):
    """Values and both derivatives are finite; a NaN in a guide is as if the mask left the pixel out."""
    s = scene(8, 9)
    s["image"][2:4, 3:6, 1] = [[np.nan, np.inf, -np.inf]] * 2
    options = {"radius": 2, "footprint": footprint}
    got = run(name, s, mask=s["mask"], **options)
    np.testing.assert_allclose(got, by_loops(name, s, mask=s["mask"], **options), rtol=1e-10, atol=1e-10)
    assert np.isfinite(got[s["mask"]]).all()
    assert (got[2:4, 3:6][s["mask"][2:4, 3:6]] > 0.0).all()
    if (name, footprint) == ("joint", "separable"):
        left_out = s["mask"] & (np.arange(9) != 7)
        holes = dict(s, depth=np.where(np.arange(9) == 7, np.nan, s["depth"]))
        np.testing.assert_array_equal(
            run(name, holes, mask=s["mask"], **options), run(name, s, mask=left_out, **options)
        )
    if (name, footprint) != ("joint", "full"):
        return  # derivatives take long to compile
    function = functools.partial(getattr(joint_bilateral, SETTINGS[name][0]), mask=s["mask"], **options)
    value = lambda inputs: jnp.where(s["mask"][..., None], function(inputs[0], **inputs[1]), 0.0).sum()  # noqa: E731
    inputs = (s["image"], arguments(name, s))
    slopes = lambda x: (jax.grad(value)(x), jax.jvp(value, (x,), (jax.tree.map(jnp.ones_like, x),)))  # noqa: E731
    found = jax.jit(slopes)(inputs)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


def test_an_image_without_a_finite_pixel_becomes_black():
    got = joint_bilateral.gaussian_filter(np.full((3, 4, 3), np.nan, np.float32), sigma=1.0, radius=1)
    np.testing.assert_array_equal(got, np.zeros((3, 4, 3)))


def test_a_zero_sum_of_weights_gives_the_input_pixel():
    """Without a normal the clamped dot product is 0, a right angle, even of a pixel with itself: exp(-123) at 0.1 radians."""
    s = scene(6, 7)
    s["normal"] = np.where((np.arange(7) < 3)[None, :, None], 0.0, s["normal"])
    got = run("joint", s, radius=3, sigmas={"sigma_normal": 0.1})
    np.testing.assert_array_equal(got[:, :3], s["image"][:, :3])


def test_a_gaussian_is_separable():
    """To rounding; at borders and around a mask too."""
    s = scene(9, 11)
    full, separable = (run("gaussian", s, radius=3, mask=s["mask"], footprint=f) for f in ("full", "separable"))
    np.testing.assert_allclose(separable, full, rtol=1e-12)


@pytest.mark.parametrize("last_pass", [False, True])
def test_an_atrous_gaussian_is_as_wide_as_the_window(last_pass):
    """The response to an impulse has the window's variance, be the window cut off or wide."""
    blur = jax.jit(
        lambda image, sigma: joint_bilateral.gaussian_filter(
            image, sigma=sigma, radius=8, footprint="atrous", last_pass=last_pass
        ),
    )
    impulse = np.eye(1, 81, 40)[..., None]
    distance = np.arange(81) - 40
    for sigma in (1.0, 4.0, 32.0, np.inf):
        response = np.asarray(blur(impulse, sigma))[0, :, 0]
        bell = np.exp(-(np.arange(-8, 9) ** 2) / (2 * sigma**2))
        np.testing.assert_allclose(response.sum(), 1.0, rtol=1e-12)
        wanted = (bell * np.arange(-8, 9) ** 2).sum() / bell.sum()
        np.testing.assert_allclose((response * distance**2).sum(), wanted, rtol=1e-9)


@functools.cache
def property_case(footprint):
    s = scene(6, 8, channels=2)
    function = lambda image, traced, mask: joint_bilateral.joint_bilateral_filter(  # noqa: E731
        image, **traced, mask=mask, radius=3, footprint=footprint
    )
    return s, jax.jit(function)


@pytest.mark.parametrize("footprint", joint_bilateral.FOOTPRINTS)
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**31), sigma=st.sampled_from([0.0, 0.05, 1.0, 1e4]), power=st.integers(-3, 6))
def test_claims(footprint, seed, sigma, power):
    """A constant stays, results lie in the range of what counts, flips and permutations of channels commute."""
    s, filtered = property_case(footprint)
    rng = np.random.default_rng(seed)
    sigmas = {f"sigma_{name}": sigma * 10.0 ** rng.uniform(-1, 1) for name in SIGMAS}
    mask = rng.random((6, 8)) > rng.uniform()
    image = 10.0**power * rng.gamma(0.5, 1.0, s["image"].shape)
    traced = arguments("joint", s, sigmas)
    got = np.asarray(filtered(image, traced, mask))
    np.testing.assert_array_equal(got[~mask], image[~mask])
    if mask.any():
        least, most = image[mask].min(0), image[mask].max(0)
        assert (got[mask] >= least * (1 - 1e-12)).all()
        assert (got[mask] <= most * (1 + 1e-12)).all()
    constant = np.broadcast_to(image[:1, :1], image.shape)
    np.testing.assert_allclose(filtered(constant, traced, mask), constant, rtol=1e-12)
    np.testing.assert_allclose(filtered(image[..., ::-1], traced, mask), got[..., ::-1], rtol=1e-12)
    flip = lambda a: a[::-1, ::-1] if np.ndim(a) > 1 else a  # noqa: E731
    np.testing.assert_allclose(filtered(*jax.tree.map(flip, (image, traced, mask))), flip(got), rtol=1e-9)


WEIGHTS = np.random.default_rng(3).normal(size=(6, 9, 1))
PARTS = {"joint": "full", "gaussian": "atrous"}


def compiled_slopes(name, mask, options=()):
    """(value and forward derivative along a direction, reverse gradient), jitted, of a number that sees every pixel that counts."""
    function = functools.partial(
        getattr(joint_bilateral, SETTINGS[name][0]), mask=mask, radius=3, footprint=PARTS[name]
    )

    def value(inputs):
        filtered = jnp.where(mask[..., None], function(inputs[0], **inputs[1]), 0.0)
        return jnp.sum(jnp.asarray(WEIGHTS, filtered.dtype) * jnp.tanh(filtered))

    jit = functools.partial(jax.jit, compiler_options=dict(options))
    return jit(lambda inputs, along: jax.jvp(value, (inputs,), (along,))), jit(jax.grad(value))


@pytest.mark.parametrize("name", PARTS)
def test_forward_and_reverse_gradients_are_finite_differences(name):
    """With equal colors, normals and positions in the window, where arccos and the distance have no slope."""
    s, rng = scene(6, 9, 1), np.random.default_rng(4)
    inputs = (s["image"], arguments(name, s))
    forward, reverse = compiled_slopes(name, s["mask"])
    gradient = reverse(inputs)
    along = jax.tree.map(lambda a: rng.normal(size=np.shape(a)), inputs)
    if name == "joint":
        tangent = along[1]["normal"]  # normals stay unit vectors
        along[1]["normal"] = tangent - s["normal"] * (tangent * s["normal"]).sum(-1, keepdims=True)
        along[1]["position"][3, :3] = along[1]["position"][3, 0]  # what is one point remains one: D_plane jumps there
    for part in ("image", *inputs[1]):
        zero = jax.tree.map(np.zeros_like, along)
        only = (along[0], zero[1]) if part == "image" else (zero[0], zero[1] | {part: along[1][part]})
        ahead, behind = (jax.tree.map(lambda v, d, s=step: v + s * d, inputs, only) for step in (1e-6, -1e-6))
        difference = float(forward(ahead, only)[0] - forward(behind, only)[0]) / 2e-6
        slope = float(forward(inputs, only)[1])
        np.testing.assert_allclose(slope, difference, rtol=1e-5, atol=1e-8, err_msg=part)
        back = sum(jax.tree.leaves(jax.tree.map(lambda g, d: float((g * d).sum()), gradient, only)))
        np.testing.assert_allclose(back, slope, rtol=1e-9, atol=1e-12, err_msg=part)
        assert slope != 0.0


def test_no_nan_leaves_it():
    """Extreme sigmas and values, NaN where the mask leaves a pixel out: values, forward and reverse gradients are finite."""
    s = scene(6, 9, 1)
    forward, reverse = compiled_slopes("joint", s["mask"], AS_USERS)
    for sigma in (0.0, 1e-30, 0.1, 1e30, np.inf):
        for size in (1.0, 1e-30, 1e20, 1e37):
            case = dict(s, position=s["position"] * size, depth=s["depth"] * size)
            image = np.where(s["mask"][..., None], s["image"] * size, np.nan).astype(np.float32)
            traced = arguments("joint", case, dict.fromkeys([f"sigma_{n}" for n in SIGMAS], sigma), np.float32)
            inputs = (image, traced)
            results = (reverse(inputs), forward(inputs, jax.tree.map(np.ones_like, inputs)))
            assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(results)), (sigma, size)


@pytest.mark.parametrize("degrees", [0.0, 1e-5, 1.0, 89.0, 90.0, 91.0, 179.0, 180.0])
def test_squared_angle(degrees):
    cosine = np.cos(np.radians(degrees))
    for dtype, tolerance in ((np.float64, 1e-12), (np.float32, 5e-6)):
        got = joint_bilateral.squared_angle(dtype(cosine))
        assert got.dtype == dtype
        np.testing.assert_allclose(got, np.arccos(np.float64(dtype(cosine))) ** 2, rtol=tolerance, atol=1e-15)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"footprint": "ful"}, "no footprint 'ful'; there are full, separable, atrous"),
        ({"radius": -1}, "radius = -1"),
        ({"radius": 2.5}, "radius = 2.5, levels = None; wanted whole numbers"),
        ({"levels": True, "footprint": "atrous"}, "levels = True; wanted whole numbers"),
        ({"last_pass": True}, "footprint 'full' has no levels and no last_pass"),
        ({"levels": 2, "footprint": "separable"}, "footprint 'separable' has no levels"),
        ({"guides": [np.zeros((4, 5))]}, "a guide is a ndarray; wanted pairs"),
        ({"guides": (np.zeros((4, 5)), 0.1)}, "a guide is a ndarray; wanted pairs"),
        ({"position": np.zeros((4, 5, 3))}, "give the normal too"),
        ({"normal": np.zeros((4, 4, 3))}, r"normal has shape \(4, 4, 3\); the image is \(4, 5, 3\)"),
        ({"guides": [(np.zeros((3, 5)), 1.0)]}, r"a guide has shape \(3, 5\)"),
        ({"mask": np.zeros((4, 5, 1), bool)}, r"mask has shape \(4, 5, 1\)"),
    ],
)
def test_misuse_is_told(options, complaint):
    with pytest.raises(SvgfError, match=complaint):
        joint_bilateral.joint_bilateral_filter(np.zeros((4, 5, 3), np.float32), **options)
