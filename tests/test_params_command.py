"""`svgf-jax params`: what it lists, shows and compares."""

import tomllib

import pytest

import svgf_jax as sj
from svgf_jax.cli import main
from svgf_jax.commands.params import _meanings
from svgf_jax.methods import METHODS, Games202Params, MethodConfig


def said(capsys, monkeypatch, *arguments, width=140):
    """(exit code, standard output, standard error) of `svgf-jax params`."""
    monkeypatch.setenv("COLUMNS", str(width))
    with pytest.raises(SystemExit) as end:
        main(["params", *map(str, arguments)])
    return end.value.code, *capsys.readouterr()


def test_the_methods_are_listed_with_what_each_has(capsys, monkeypatch):
    _, out, _ = said(capsys, monkeypatch, "list", "methods")
    assert all(name in out for name in METHODS)
    _, out, _ = said(capsys, monkeypatch, "list", "games202")
    assert "how far normals may turn" in out
    known = _meanings(MethodConfig) | _meanings(Games202Params)
    assert all(known[name] for method in METHODS.values() for name in (*method.params._fields, *method.choices))
    assert all(name in _meanings(sj.Params) | _meanings(sj.Config) for name in (*sj.Params._fields, *sj.Config._fields))


def test_a_method_is_shown_as_toml_with_changes(capsys, monkeypatch):
    _, out, _ = said(capsys, monkeypatch, "show", "games202", "--set", "radius=4")
    values = tomllib.loads(out)
    assert (values["radius"], values["sigma_color"]) == (4, 0.6)


def test_a_shown_file_keeps_its_provenance_until_it_is_changed(tmp_path, capsys, monkeypatch):
    path = tmp_path / "p.toml"
    sj.save_params(path, *sj.preset("falcor"), provenance={"tuned on": ["box"], "scores": {"psnr": 40.5}})
    _, out, _ = said(capsys, monkeypatch, "show", path)
    assert tomllib.loads(out) == tomllib.loads(path.read_text())
    assert tomllib.loads(out)["schema"] == 1
    _, out, _ = said(capsys, monkeypatch, "show", path, "--set", "alpha=0.5")
    assert "provenance" not in tomllib.loads(out)


def test_diff_tells_what_differs_and_only_that(tmp_path, capsys, monkeypatch):
    code, out, _ = said(capsys, monkeypatch, "diff", "paper", "falcor")
    names = [line.split()[0] for line in out.splitlines() if line.strip()][2:]
    assert (code, names) == (1, ["alpha", "sigma_luminance", "short_history_boost", "levels", "feedback_level"])
    assert said(capsys, monkeypatch, "diff", "paper", "paper")[0] == 0
    sj.save_params(tmp_path / "p.toml", sj.Params(alpha=0.2 + 1e-9))
    code, out, _ = said(capsys, monkeypatch, "diff", "paper", tmp_path / "p.toml")
    assert code == 1
    assert "0.200000001" in out
    assert "sigma_space" in said(capsys, monkeypatch, "diff", "games202", "accumulate")[1]


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["show", "games20"], "Did you mean games202?"),
        (["diff", "paper", "falcr"], "Did you mean falcor?"),
        (["list", "method"], "Did you mean methods?"),
        (["show", "games202", "--set", "sigma_luminance=3"], "it belongs to svgf"),
    ],
)
def test_a_wrong_name_is_answered_with_the_closest(arguments, hint, capsys, monkeypatch):
    code, _, error = said(capsys, monkeypatch, *arguments)
    assert code == 2
    assert hint in error
