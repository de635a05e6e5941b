"""The conventions of the public API, held for every name of it."""

import inspect
import subprocess
import sys

import pytest

import svgf_jax

FUNCTIONS = [name for name in svgf_jax.__all__ if inspect.isfunction(inspect.unwrap(getattr(svgf_jax, name)))]


def test_the_public_names_are_these():
    assert set(svgf_jax.__all__) == {
        *("Config", "Frame", "History", "Output", "Params", "Rejected", "Reprojected", "SvgfError"),
        *("init", "step", "denoise"),
        *(
            "sanitise",
            "demodulate",
            "remodulate",
            "modulate",
            "reproject",
            "accumulate",
            "estimate_variance",
            "edge_weight",
        ),
        *("atrous_level", "atrous_filter", "luminance", "tonemap"),
        *("preset", "load_params", "save_params"),
        *("open_source", "read_frame", "load_sequence", "load_reference", "read_radiance", "sample"),
    }


@pytest.mark.parametrize("name", svgf_jax.__all__)
def test_everything_public_is_documented(name):
    assert inspect.getdoc(getattr(svgf_jax, name))


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
