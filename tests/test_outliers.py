"""Outlier removal: against loops, in the pipeline, its derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import oracle_classic as oracle
import pytest
import scenes
from bridge import to_config, to_frame, to_params

from svgf_jax import outliers, pipeline
from svgf_jax.types import Config, SvgfError

CONFIG = {"levels": 0, "feedback_level": 0}


def scene(height=10, width=13):
    """A frame, and a signal of noise with fireflies, lone pixels between background among them."""
    rng = np.random.default_rng(1)
    frame = scenes.flat(height, width)
    frame["object_id"] = np.where(rng.random((height, width)) < 0.2, -1, frame["object_id"])
    frame["object_id"][:4, :4] = -1
    frame["object_id"][0, 0] = 0  # alone, in any window of 3 x 3
    light = rng.gamma(0.5, 2.0, (1, height, width, 3))
    light[rng.random(light.shape) < 0.03] *= 300.0
    light[:, :, -3:] = 1.0  # no deviation at all
    return frame, light


def removed(light, frame, sigma, radius, dtype=np.float64, **options):
    """The library's, jitted; read from its module when it runs, so that `test_mutants` can put a broken one there."""
    config = to_config(CONFIG | {"outlier_radius": radius})
    call = lambda light, frame, params: outliers.remove_outliers(light, frame, params=params, config=config, **options)  # noqa: E731
    params = to_params({"outlier_sigma": [sigma, 99.0]}, dtype)
    return np.asarray(jax.jit(call)(light.astype(dtype), to_frame(frame, dtype), params))


@pytest.mark.parametrize(("radius", "sigma"), [(1, 0.5), (3, 3.0)])
def test_remove_outliers(radius, sigma):
    frame, light = scene()
    got = removed(light, frame, sigma, radius)
    wanted = np.stack([oracle.remove_outliers(s, frame["object_id"] != -1, radius, sigma) for s in light])
    np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-9)
    assert (np.abs(got - light).max((1, 2, 3)) > 10).all()
    np.testing.assert_array_equal(got[:, frame["object_id"] == -1], light[:, frame["object_id"] == -1])


def test_an_image_alone():
    """As the stage does it; what is not finite outside the mask stays, inside nothing but numbers comes out."""
    frame, light = scene()
    mask, image = frame["object_id"] != -1, np.where((frame["object_id"] == -1)[..., None], np.nan, light[0])
    function = lambda i: outliers.clamp_outliers(i, radius=1, sigma=0.5, mask=mask)  # noqa: E731
    clamped = jax.jit(function)
    wanted = oracle.remove_outliers(light[0], mask, 1, 0.5)
    np.testing.assert_allclose(clamped(image)[mask], wanted[mask], rtol=1e-9, atol=1e-9)
    assert np.isnan(clamped(image)[~mask]).all()
    image[mask] = np.where(np.arange(3) == 0, np.nan, np.where(np.arange(3) == 1, np.inf, image[mask]))
    assert np.isfinite(clamped(image)[mask]).all()
    total = lambda i: jnp.where(mask[..., None], function(i), 0.0).sum()  # noqa: E731
    assert np.isfinite(jax.jit(jax.grad(total))(image)).all()


@pytest.mark.parametrize(
    ("options", "complaint"),
    [({"radius": 2.5}, "radius = 2.5; wanted a whole"), ({"mask": np.ones((3, 5), bool)}, r"mask has shape \(3, 5\)")],
)
def test_misuse_of_an_image_alone_is_told(options, complaint):
    with pytest.raises(SvgfError, match=complaint):
        outliers.clamp_outliers(np.zeros((4, 5, 3), np.float32), **options)


def test_fireflies_far_brighter_than_float32_can_average():
    frame, light = scene()
    light = np.minimum(light, 3.0)
    sizes = {(2, 2): 1e4, (2, 10): 1e8, (8, 6): 1e30}  # out of each other's windows
    frame["object_id"][...] = 0
    for at, size in sizes.items():
        light[0][at] = size
    got = removed(light, frame, 3.0, 3, np.float32)
    assert np.isfinite(got).all()
    for at, size in sizes.items():
        assert got[0][at].max() < size * 2e-3 + 10.0


def test_fireflies_do_not_enter_the_history():
    """A frame is filtered as if its illumination had been cleaned before it came in."""
    frame, light = scene()
    surface = frame["object_id"] != -1
    cleaned = np.stack([oracle.remove_outliers(s, surface, 2, 3.0) for s in light])
    config = Config(levels=0, outlier_radius=2)
    step = jax.jit(lambda *a, params: pipeline.step(*a, params=params, config=config))
    results = []
    for sigma, radiance in ((3.0, light), (1e9, cleaned), (1e9, light)):
        this = to_frame(frame | {"radiance": radiance})
        results.append(
            jax.tree.map(np.asarray, step(pipeline.init(this), this, params=to_params({"outlier_sigma": sigma})))
        )
    (history, output), (wanted_history, wanted), (untreated, _) = results
    np.testing.assert_allclose(history.illumination, wanted_history.illumination, rtol=1e-9)
    np.testing.assert_allclose(history.moments, wanted_history.moments, rtol=1e-9)
    np.testing.assert_allclose(output.image[surface], wanted.image[surface], rtol=1e-9)
    assert np.abs(untreated.illumination - history.illumination).max() > 100.0


def test_gradients():
    """Forward = reverse = finite differences; finite where nothing deviates and at a sigma of 0."""
    frame, light = scene(7, 8)
    rng = np.random.default_rng(2)
    weights, along = rng.normal(size=light.shape), rng.normal(size=light.shape)
    frame, config = to_frame(frame), to_config(CONFIG | {"outlier_radius": 2})

    def value(light, sigma):
        params = to_params({})._replace(outlier_sigma=sigma)
        cleaned = outliers.remove_outliers(light, frame, params=params, config=config)
        return jnp.sum(weights * jnp.tanh(cleaned))

    forward = jax.jit(lambda l, s, dl, ds: jax.jvp(value, (l, s), (dl, ds)))
    reverse = jax.jit(jax.grad(value, argnums=(0, 1)))
    light[:, :, -3:] += 0.1 * rng.random(light[:, :, -3:].shape)  # a difference across a kink is no derivative
    one = np.float64(1.5)
    back = reverse(light, one)
    for dl, ds in ((along, 0 * one), (0 * along, one)):
        slope = float(forward(light, one, dl, ds)[1])
        ahead, behind = (float(forward(light + s * dl, one + s * ds, dl, ds)[0]) for s in (1e-6, -1e-6))
        np.testing.assert_allclose(slope, (ahead - behind) / 2e-6, rtol=1e-5)
        np.testing.assert_allclose(slope, (back[0] * dl).sum() + back[1] * ds, rtol=1e-9)
    for still in (np.ones_like(light), light * 0):
        for sigma in (0.0, 3.0):
            results = reverse(still, np.float64(sigma)), forward(still, np.float64(sigma), along, one)
            assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(results))


def test_off_by_default_and_a_constant_stays():
    frame, light = scene()
    params = to_params({})
    assert outliers.remove_outliers(light, to_frame(frame), params=params, config=Config()) is light
    constant = np.full_like(light, 0.1)
    np.testing.assert_allclose(removed(constant, frame, 0.0, 3, np.float32), constant, rtol=1e-6)
