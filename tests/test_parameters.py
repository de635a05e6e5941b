"""Presets and parameter files: what is written is read back, what is wrong is named."""

import numpy as np
import pytest

import svgf_jax as sj
from svgf_jax.parameters import PRESETS, override


def test_presets_are_those_of_the_paper_and_of_falcor():
    params, config = sj.preset("paper")
    assert (params.alpha, params.sigma_luminance, config.levels, config.feedback_level) == (0.2, 4.0, 5, 0)
    params, config = sj.preset("falcor")
    assert (params.alpha, params.sigma_luminance, params.short_history_boost) == (0.05, 10.0, 4.0)
    assert (config.levels, config.feedback_level) == (4, 1)


def test_a_file_reads_back_to_the_same_numbers(tmp_path):
    params = sj.Params(alpha=1 / 3, sigma_luminance=np.array([4.0, 3.0, 2.5, 1.0, 0.1]))
    sj.save_params(
        tmp_path / "p.toml", params, sj.Config(feedback_level=1, variance="spatial"), provenance={"on": "a sequence"}
    )
    loaded, config = sj.load_params(tmp_path / "p.toml")
    assert config == sj.Config(feedback_level=1, variance="spatial")
    for got, wanted in zip(loaded, params, strict=True):
        np.testing.assert_array_equal(got, wanted)
    assert [p.name for p in tmp_path.iterdir()] == ["p.toml"]


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_keeps_to_its_bounds_and_reads_back(name, tmp_path):
    params, config = override(*sj.preset(name), {})
    sj.save_params(tmp_path / "p.toml", params, config)
    loaded, again = sj.load_params(tmp_path / "p.toml")
    assert again == config
    for got, wanted in zip(loaded, params, strict=True):
        np.testing.assert_array_equal(got, wanted)


def test_a_file_may_build_on_a_preset(tmp_path):
    (tmp_path / "p.toml").write_text('preset = "falcor"\n[params]\nalpha = 0.5\n')
    params, config = sj.load_params(tmp_path / "p.toml")
    assert (params.alpha, params.sigma_luminance, config.levels) == (0.5, 10.0, 4)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[params]\nalhpa = 0.5", "p.toml:2: no 'alhpa' in [params]. Did you mean alpha? There are alpha, alpha_m"),
        ("[params]\nlevels = 4", "p.toml:2: no 'levels' in [params]; it belongs into [config]"),
        ("# note\n\n[params]\nsigma_luminance = [\n1,2,\n3,4,5]\n# two\nalpha = 1.5 # here", "p.toml:8: alpha = 1.5"),
        ("preset = 'tuned'\n[config]\nlevels = 4", "p.toml:3: sigma_normal has 5 values"),
        ("schema = 2", "p.toml:1: schema = 2; wanted 1"),
        ("[params]\nalpha = ", "p.toml:2: not TOML: Invalid value. Got 'alpha ='"),
        ("[params]\nalpha = 1.5", "alpha = 1.5"),
        ("[params]\nalpha = nan", "alpha = nan"),
        ("[params]\nalpha = true", "alpha = True"),
        ("[params]\nalpha = 'a'", "alpha = 'a'"),
        ("[params]\nsigma_normal = [1.0, 2.0]", "5 levels"),
        ("[config]\nlevels = 2.5", "levels = 2.5"),
        ("[config]\nlevels = 400", "levels = 400"),
        ("[config]\nlevels = true", "levels = True"),
        ("[config]\nvariance = 'spacial'", "wanted svgf or temporal or spatial"),
        ("preset = 'paperr'", "Did you mean paper"),
        ("params = 3", "wanted a table"),
        ("pramas = 3", "unknown key 'pramas'"),
        ("not toml", "not TOML"),
        ("preset = 3", "no preset"),
    ],
)
def test_a_wrong_file_is_refused_by_name(tmp_path, text, complaint):
    (tmp_path / "p.toml").write_text(text)
    with pytest.raises(sj.SvgfError, match="p.toml") as error:
        sj.load_params(tmp_path / "p.toml")
    assert complaint in str(error.value)


def test_a_missing_file_and_a_missing_folder_are_named(tmp_path):
    with pytest.raises(sj.SvgfError, match="no such parameter file"):
        sj.load_params(tmp_path / "p.toml")
    with pytest.raises(sj.SvgfError, match="can't write"):
        sj.save_params(tmp_path / "no" / "p.toml", sj.Params())


def test_fewer_levels_do_not_silently_drop_per_level_values():
    params, config = override(*sj.preset("paper"), {"sigma_normal": [1.0, 2.0, 3.0, 4.0, 5.0]})
    with pytest.raises(sj.SvgfError, match="4 levels"):
        override(params, config, {"levels": 4})


def test_a_file_cut_off_within_a_number_is_not_taken_for_whole(tmp_path):
    whole, cut = tmp_path / "whole.toml", tmp_path / "cut.toml"
    sj.save_params(whole, sj.Params(sigma_depth=12.5))
    cut.write_text(whole.read_text().partition("12.5")[0] + "1")
    with pytest.raises(sj.SvgfError, match=r"cut.toml: the file is cut off.* ends with 'sigma_depth = 1'"):
        sj.load_params(cut)
    cut.write_text("[params]\nsigma_depth = 1")  # written by hand
    assert sj.load_params(cut)[0].sigma_depth == 1
