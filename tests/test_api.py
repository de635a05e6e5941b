"""The conventions of the public API, held for every name of it."""

import functools
import inspect
import subprocess
import sys

import jax
import numpy as np
import pytest

import svgf_jax

FUNCTIONS = [name for name in svgf_jax.__all__ if inspect.isfunction(inspect.unwrap(getattr(svgf_jax, name)))]


def test_the_public_names_are_these():
    assert set(svgf_jax.__all__) == {
        *("Config", "Frame", "History", "Output", "Params", "Rejected", "Reprojected", "SvgfError"),
        *("Accumulated", "Guides", "guides_of", "depth_gradient"),
        *("init", "step", "step_over", "denoise", "taa", "taa_init", "TaaHistory"),
        *("baseline_init", "baseline_step", "baseline_denoise"),
        *("method", "MethodConfig"),
        *("Reflections", "trace_reflections"),
        *(
            "sanitise",
            "demodulate",
            "remodulate",
            "modulate",
            "reproject",
            "reproject_reflections",
            "accumulate",
            "clamp_history",
            "follow_light",
            "estimate_variance",
            "edge_weight",
        ),
        *("gaussian_filter", "bilateral_filter", "joint_bilateral_filter", "clamp_outliers", "remove_outliers"),
        *("atrous_level", "atrous_filter", "luminance", "tonemap", "untonemap", "encode_srgb", "decode_srgb"),
        *("preset", "load_params", "save_params"),
        *("Sums", "Welford", "start_sums", "start_welford", "add_sample", "merge_samples"),
        *("mean_of", "variance_of", "variance_of_mean"),
        *("frame_of", "open_source", "read_frame", "load_sequence", "load_reference", "read_radiance", "sample"),
    }


@pytest.mark.parametrize("name", svgf_jax.__all__)
def test_everything_public_is_documented(name):
    assert inspect.getdoc(getattr(svgf_jax, name))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_everything_public_is_typed(name):
    """Pyright's `--verifytypes` says of whole packages what this says of functions; it takes half a minute."""
    called = inspect.signature(getattr(svgf_jax, name))
    assert called.return_annotation is not called.empty
    assert all(parameter.annotation is not parameter.empty for parameter in called.parameters.values())


@pytest.mark.parametrize("name", FUNCTIONS)
def test_options_are_keyword_only(name):
    for parameter in inspect.signature(getattr(svgf_jax, name)).parameters.values():
        if parameter.default is not parameter.empty:
            assert parameter.kind is parameter.KEYWORD_ONLY or name == "save_params", f"{name}: {parameter.name}"


def test_a_wrong_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'denois'"):
        _ = svgf_jax.denois


def test_names_are_functions_whatever_was_imported_first():
    code = "import svgf_jax.pipeline, svgf_jax; assert all(callable(getattr(svgf_jax, n)) for n in svgf_jax.__all__)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_importing_the_package_does_not_import_jax():
    code = "import sys, svgf_jax, svgf_jax.types, svgf_jax.frames, svgf_jax.cli; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def frame_of_zeros(signals=1, height=3, width=4):
    shapes = dict.fromkeys(svgf_jax.Frame._fields, (height, width))
    shapes |= {"radiance": (signals, height, width, 3), "albedo": (1, height, width, 3), "motion": (height, width, 2)}
    shapes |= {"emission": (height, width, 3), "normal": (height, width, 3), "variance": (signals, height, width)}
    shapes |= {"position": (height, width, 3), "reflected_motion": (signals, height, width, 2)}
    shapes |= dict.fromkeys(("reflected_prev_depth", "longest_history"), (signals, height, width))
    types = {name: np.int32 if name == "object_id" else np.float32 for name in shapes}
    return svgf_jax.Frame(**{name: np.zeros(shape, types[name]) for name, shape in shapes.items()})


@pytest.mark.parametrize(
    ("call", "complaint"),
    [
        (lambda f: svgf_jax.denoise(f), "call step, or add the leading T"),
        (lambda f: svgf_jax.denoise(jax.tree.map(lambda a: a[None][:0], f)), "T >= 1"),
        (lambda f: svgf_jax.init(jax.tree.map(lambda a: a[None], f)), "call denoise, not step"),
        (lambda f: svgf_jax.step(svgf_jax.init(frame_of_zeros(height=5)), f), "start another with init"),
        (lambda f: svgf_jax.step(svgf_jax.init(frame_of_zeros(signals=2)), f), "start another with init"),
        (
            lambda f: svgf_jax.step(svgf_jax.init(f), f, config=svgf_jax.Config(levels=-1)),
            "levels is -1; wanted a whole number from 0 to 12",
        ),
        (
            lambda f: svgf_jax.step(svgf_jax.init(f), f, config=svgf_jax.Config(fallback=1)),
            "fallback is 1; wanted true or false",
        ),
        (
            lambda f: svgf_jax.step(svgf_jax.init(f), f, params=svgf_jax.Params(alpha=np.ones(3))),
            "each of the 5 levels",
        ),
        (lambda f: svgf_jax.step(svgf_jax.init(f), f._replace(depth=f.depth[:2])), r"depth has shape \(2, 4\)"),
        (lambda f: svgf_jax.init(f._replace(variance=f.depth)), r"variance has shape \(3, 4\); wanted \(1, 3, 4\)"),
        (
            lambda f: svgf_jax.step(svgf_jax.init(f), f._replace(depth=f.motion[..., 0].astype(np.int32))),
            "depth is int32",
        ),
    ],
)
def test_misuse_is_told_before_anything_runs(call, complaint):
    with pytest.raises(svgf_jax.SvgfError, match=complaint):
        call(frame_of_zeros())


def test_the_public_edge_weight_is_that_of_the_filter():
    """Between a pixel and itself everything agrees; a pixel without a surface counts for nothing."""
    frame = frame_of_zeros()
    frame = frame._replace(normal=frame.normal + np.float32([0, 0, 1]), depth=frame.depth + np.float32(2))
    guides = svgf_jax.guides_of(frame)
    one = np.ones((3, 4), np.float32)
    options = {"sigma_depth": 1.0, "sigma_normal": 128.0, "sigma_luminance": 4.0, "depth_epsilon": 1e-3}
    weigh = functools.partial(svgf_jax.edge_weight, luminance_epsilon=1e-6, **options)
    np.testing.assert_allclose(weigh(guides, guides, 0 * one, one, one, one), one)
    np.testing.assert_allclose(weigh(guides, guides, 0 * one, one, 5 * one, one), np.exp(-1) * one, rtol=1e-5)
    gone = guides._replace(surface=0 * one)
    np.testing.assert_array_equal(weigh(guides, gone, 0 * one, one, one, one), 0 * one)
