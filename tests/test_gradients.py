"""Gradients: forward = reverse = finite differences for every parameter through four frames, and finite everywhere."""

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
import scenes
from bridge import to_config, to_frames, to_params

from svgf_jax.atrous import _add_tap
from svgf_jax.pipeline import denoise
from svgf_jax.types import Params

SIZE = (9, 11)
LEVELS, SIGNALS = 2, 1  # compile time goes with the signals
CONFIG = to_config({"levels": LEVELS, "feedback_level": 0})
# Away from every kink: alpha above 1/3, max_history a cap that bites (its 1/h below alpha), a boost above h.
PARAMS = oracle.PAPER | {
    "alpha": 0.45,
    "alpha_moments": 0.4,
    "sigma_normal": 32.0,
    "short_history_boost": 4.0,
    "max_history": 2.75,
    "albedo_floor": 2e-3,
    "depth_epsilon": 2e-2,
    "luminance_epsilon": 1e-2,
}
del PARAMS["clamp_sigma"]  # unread without a clamp
NO_EFFECT = {"reproject_depth", "reproject_normal"}  # thresholds: their gradient is 0, as it is almost everywhere
FIRST_ENTRY = {"alpha", "alpha_moments", "short_history_boost", "max_history", "albedo_floor"} | NO_EFFECT
INPUTS = ("radiance", "albedo", "emission", "normal", "depth", "prev_depth", "motion")


def sequence(dirty=False, ties=False):
    """Four frames with disocclusion, zero variance, black albedo and background; checked below."""
    frames = scenes.synthetic(4, *SIZE, signals=SIGNALS, frames=4, dirty=dirty)
    rng = np.random.default_rng(1)
    for frame in frames:
        background = frame["object_id"] == -1
        frame["radiance"] = frame["radiance"] + np.where(background, 0, 0.01)[None, :, :, None]
        if not ties:  # the gradient of a tie is a matter of taste, and of no finite difference
            frame["depth"] = np.where(background, 0, frame["depth"] + rng.uniform(0, 0.01, SIZE))
            frame["radiance"] = frame["radiance"] * rng.uniform(0.99, 1.01, (SIGNALS, *SIZE, 1))
        still = frame["object_id"] == 15  # every frame the same: the variance is zero
        frame["radiance"] = np.where(
            still[None, :, :, None], 0.5 * np.maximum(frame["albedo"], 2e-3), frame["radiance"]
        )
    return frames


PAPER_PER_LEVEL = to_params({k: np.full(LEVELS, oracle.PAPER[k]) for k in PARAMS})
WEIGHTS = np.random.default_rng(2).normal(size=(4, *SIZE, 3))


def loss(params, frames):
    """One number that sees every pixel of every frame, its variance, and the history."""
    history, output = denoise(frames, params=params, config=CONFIG)
    weights = jnp.asarray(WEIGHTS, output.image.dtype)
    per_signal = weights[:, None]  # [T, S, H, W, 3]
    return (
        jnp.mean(weights * output.image**2)
        + jnp.mean(per_signal[..., 0] * output.variance_filtered)
        + jnp.mean(per_signal[..., 1] * jnp.sqrt(output.variance + 0.1))
        + jnp.mean(per_signal[-1] * history.illumination)
    )


def loss_of_inputs(params, inputs, frames):
    return loss(params, frames._replace(**inputs))


value = jax.jit(loss)
forward = jax.jit(jax.jacfwd(loss))
reverse = jax.jit(jax.grad(loss_of_inputs, argnums=(0, 1)))  # with respect to parameters and inputs


def inputs_of(frames):
    return {name: getattr(frames, name) for name in INPUTS}


@pytest.fixture(scope="module")
def frames():
    return to_frames(sequence())


def per_level(factor=1.1):
    """The parameters as one number per level, each `factor` times the one before."""
    factors = factor ** np.arange(LEVELS)
    return to_params({k: np.full(LEVELS, v) if k in NO_EFFECT else v * factors for k, v in PARAMS.items()})


def finite_differences(params, frames):
    """d loss / d entries of each leaf."""
    slopes = {name: [] for name in PARAMS}
    for name in PARAMS:
        leaf = getattr(params, name)
        for level in range(LEVELS):
            delta = np.zeros(LEVELS)
            delta[level] = 1e-5 * leaf[0]
            ahead, behind = (value(params._replace(**{name: leaf + sign * delta}), frames) for sign in (1, -1))
            slopes[name].append(float(ahead - behind) / (2e-5 * leaf[0]))
    return Params(**{name: np.array(slope) for name, slope in slopes.items()})


@pytest.fixture(scope="module")
def gradients(frames):
    """(parameters, reverse gradient, forward gradient, finite differences), each leaf with a number per level."""
    params = per_level()
    differences = finite_differences(params, frames)
    return params, reverse(params, inputs_of(frames), frames)[0], forward(params, frames), differences


def test_the_data_hold_what_gradients_trip_over():
    frames = sequence()
    outputs = oracle.denoise(frames, PARAMS, CONFIG._asdict())
    surface = frames[-1]["object_id"] != -1
    assert (~surface).any(), "background"
    assert (surface & ~outputs[-1]["valid"]).any(), "disocclusion"
    assert (surface & outputs[-1]["valid"]).any(), "history"
    assert (frames[-1]["albedo"][0, surface] == 0).any(), "black albedo"
    assert (outputs[-1]["variance"][:, surface] < 1e-15).any(), "zero variance"


@pytest.mark.parametrize("name", PARAMS)
def test_forward_is_reverse_is_finite_differences(gradients, name):
    params, back, ahead, differences = (getattr(g, name) for g in gradients)
    assert np.isfinite(back).all()
    np.testing.assert_allclose(ahead, back, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(back, differences, rtol=2e-5, atol=1e-8 / params.min())
    if name in NO_EFFECT:
        assert not back.any()
    else:
        assert np.abs(back[0]) > 1e-6, "this parameter should matter here"
    if name in FIRST_ENTRY:
        assert not back[1:].any()
    else:
        assert (np.abs(back) > 1e-6).all()


def test_one_number_for_all_levels_has_the_sum_of_their_slopes(frames):
    """Compared in float32, whose reverse mode is compiled for scalars."""
    single = to_frames(sequence(), np.float32)
    scalars = reverse(to_params(PARAMS, np.float32), inputs_of(single), single)[0]
    levels = reverse(per_level(1.0), inputs_of(frames), frames)[0]
    for name in PARAMS:
        slopes = getattr(levels, name)
        np.testing.assert_allclose(getattr(scalars, name), slopes.sum(), rtol=2e-3, atol=1e-3 * np.abs(slopes).max())


def test_the_oracle_has_the_same_slopes(frames):
    """Finite differences of the plain loops, which know nothing of the library."""
    gradient = reverse(per_level(1.0), inputs_of(frames), frames)[0]
    signs = WEIGHTS[:, None]

    def oracle_loss(params):
        outputs = oracle.denoise(sequence(), params, CONFIG._asdict())
        image, variance, filtered = (
            np.stack([o[k] for o in outputs]) for k in ("image", "variance", "variance_filtered")
        )
        return (
            np.mean(WEIGHTS * image**2)
            + np.mean(signs[..., 0] * filtered)
            + np.mean(signs[..., 1] * np.sqrt(variance + 0.1))
            + np.mean(signs[-1] * outputs[-1]["history"]["illumination"])
        )

    for name in ("alpha", "sigma_luminance", "sigma_normal", "depth_epsilon", "albedo_floor"):
        ahead, behind = (oracle_loss(PARAMS | {name: PARAMS[name] * (1 + sign * 1e-5)}) for sign in (1, -1))
        slope = (ahead - behind) / (2e-5 * PARAMS[name])
        np.testing.assert_allclose(getattr(gradient, name).sum(), slope, rtol=1e-4, atol=1e-8 / PARAMS[name])


@pytest.mark.parametrize("name", ["radiance", "albedo", "emission", "normal", "depth"])
def test_gradient_of_the_inputs_is_finite_differences(frames, name):
    """Along a random direction in all pixels of all frames at once."""
    params, leaf = per_level(1.0), getattr(frames, name)
    surface = frames.object_id != -1
    direction = np.random.default_rng(3).normal(size=leaf.shape)
    direction *= {3: surface, 4: surface[..., None], 5: surface[:, None, ..., None]}[leaf.ndim]
    direction *= leaf > 0.01 if name in ("albedo", "radiance") else 1
    gradient = reverse(params, inputs_of(frames), frames)[1][name]
    delta = 1e-7
    ahead, behind = (value(params, frames._replace(**{name: leaf + sign * delta * direction})) for sign in (1, -1))
    np.testing.assert_allclose(np.sum(gradient * direction), (ahead - behind) / (2 * delta), rtol=1e-4, atol=1e-8)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("dirty", [False, True])
def test_no_gradient_is_nan(dtype, dirty):
    """With exact ties, equal neighbours, zero variance, NaN, Inf and negative pixels, at the preset's parameters."""
    frames = to_frames(sequence(dirty=dirty, ties=True), dtype)
    params = PAPER_PER_LEVEL if dtype == np.float64 else to_params(oracle.PAPER, dtype)  # what is compiled above
    for leaf in jax.tree.leaves(reverse(params, inputs_of(frames), frames)):
        assert leaf.dtype == dtype
        assert np.isfinite(leaf).all()
        assert np.abs(leaf).max() < 1e4, "no huge derivative of a root or a quotient either"


def test_no_gradient_is_nan_beside_an_albedo_that_is_none():
    """What is spread there would be multiplied by it, and its derivative divided by the square of an albedo nearby."""
    frames = to_frames(sequence(ties=True), np.float32)
    frames.albedo[:, :, 4, 5] = 3e38
    for leaf in jax.tree.leaves(reverse(to_params(oracle.PAPER, np.float32), inputs_of(frames), frames)):
        assert np.isfinite(leaf).all()


def test_the_derivative_of_what_an_edge_lets_through_of_a_large_variance_is_finite():
    """Of the deviation w sqrt(V), where that of w^2 V times V is beyond float32."""

    def deviation(weight):
        _, _, variance = _add_tap((0.0, (0.0,) * 3, 0.0), weight, (1.0,) * 3, 1e26)
        return 1e10 * jnp.sqrt(variance)

    np.testing.assert_allclose(jax.grad(deviation)(jnp.float32(1e-18)), 1e23, rtol=1e-5)


def test_no_forward_gradient_is_nan():
    frames = to_frames(sequence(dirty=True, ties=True))
    for leaf in forward(PAPER_PER_LEVEL, frames):
        assert np.isfinite(leaf).all()


def test_gradient_of_a_sequence_without_any_surface_is_zero():
    frames = sequence()
    for frame in frames:
        frame["object_id"][:] = -1
    frames = to_frames(frames)
    params, inputs = reverse(PAPER_PER_LEVEL, inputs_of(frames), frames)
    for leaf in params:
        np.testing.assert_array_equal(leaf, 0)
    assert all(np.isfinite(leaf).all() for leaf in inputs.values())
