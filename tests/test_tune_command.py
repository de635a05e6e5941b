"""`svgf-tune` as its users meet it: files in, a parameter file and a page out, and what it says when something is wrong."""

import json
import os
import re
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from browser import opened

from svgf_jax import Config, Params, exr, load_params
from svgf_jax.demo import sample
from tune.__main__ import main

ROOT = Path(__file__).parents[1]
SEARCHED = f"{ROOT}{os.pathsep}{ROOT / 'tests' / 'offline'}"  # without a network


def command(*arguments, cwd=None, **options):
    environment = os.environ | {"PYTHONPATH": SEARCHED, "COLUMNS": "160"}
    call = [sys.executable, "-m", "tune", *map(str, arguments)]
    return subprocess.run(call, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300, **options)


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    """A crop of the bundled sample, small enough to tune on within seconds."""
    folder = tmp_path_factory.mktemp("shots")
    for path in sorted(sample().glob("*.exr")):
        image = exr.read(path)
        channels = {name: np.ascontiguousarray(plane[20:56, 30:78]) for name, plane in image.channels.items()}
        exr.write(folder / path.name, exr.new_image(channels))
    return folder


def test_help_and_errors_answer_without_jax(tmp_path):
    prelude = "import sys, tune.__main__ as m\ntry: m.main({!r})\nfinally: print('jax' in sys.modules)"
    for arguments in (["--help"], ["x"], ["x", "-o", "y.toml"]):
        environment = os.environ | {"PYTHONPATH": SEARCHED}
        done = subprocess.run(
            [sys.executable, "-c", prelude.format(arguments)],
            env=environment,
            capture_output=True,
            text=True,
            cwd=tmp_path,
        )
        assert done.stdout.strip().endswith("False"), done.stderr
        assert done.returncode == (0 if arguments == ["--help"] else 2)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["noisy", "-o", "t.toml"], "neither --reference nor --second"),
        (["a", "b", "--reference", "r", "-o", "t.toml"], "2 sequences and 1 of --reference"),
        (["a", "--reference", "r", "-o", "nowhere/t.toml"], "no folder"),
        (["a", "--second", "r", "--robust", "huber", "-o", "t.toml"], "biased"),
        (["a", "--reference", "r", "--process", "1", "-o", "t.toml"], "without --distributed"),
        (["a", "--reference", "r", "--validate", "v", "-o", "t.toml"], "wanted one for each"),
        (["a", "--reference", "r", "-o", "t.toml"], "no such"),
    ],
)
def test_what_is_wrong_is_said(arguments, said, tmp_path):
    done = command(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert said in done.stderr
    assert "Traceback" not in done.stderr


def test_references_of_another_size_and_missing_ones(shots, tmp_path):
    refs = tmp_path / "refs"
    refs.mkdir()
    for path in sorted(shots.glob("ref_*.exr"))[:3]:
        image = exr.read(path)
        exr.write(refs / path.name, exr.new_image({n: np.ascontiguousarray(p[:-2]) for n, p in image.channels.items()}))
    done = command(shots, "--reference", refs, "-o", tmp_path / "t.toml", "--set", "levels=1")
    assert done.returncode == 2
    assert "references of the same size" in done.stderr
    assert "lacks frames" in done.stderr
    assert not (tmp_path / "t.toml").exists()


@pytest.fixture(scope="module")
def tuned(shots, tmp_path_factory):
    """A few steps on the first frames, validated on the rest: (the finished command, its folder).

    What it is validated against is noise, so a good fit looks worse.
    """
    folder = tmp_path_factory.mktemp("tuned")
    what = ["--tune", "alpha,sigma_luminance,max_history", "--set", "levels=1", "--frames", "0-5", "--max-steps", "2"]
    held = ["--validate", shots, "--validate-reference", shots / "frame_####.exr", "--validate-frames", "6-9", "--json"]
    files = ["-o", folder / "tuned.toml", "--report", folder / "report.html", "--maps", folder / "maps", "--profiles"]
    done = command(shots, "--reference", shots, *files, *what, *held)
    assert done.returncode in (0, 1), done.stderr
    return done, folder


def test_tunes_validates_reports(shots, tuned):
    """The file, the numbers, the page, the maps."""
    done, folder = tuned
    assert "loss" in done.stderr
    params, config = load_params(folder / "tuned.toml")
    assert config == Config(levels=1)
    assert params.alpha != Params().alpha
    result = json.loads(done.stdout)
    assert result["parameters"]["alpha"]["value"] == pytest.approx(params.alpha)
    assert [s["role"] for s in result["scores"]] == ["tuned", "validation"]
    assert result["loss"] < 1
    assert "max_history" in result["undetermined"]
    assert len(result["profiles"]) == 3
    maps = exr.read(folder / "maps" / "sensitivity.exr")
    assert set(maps.channels) == {"error", "slope.alpha", "slope.sigma_luminance", "slope.max_history"}
    html = (folder / "report.html").read_text()
    assert "http:" not in html.replace("http://www.w3.org", "")  # self-contained
    assert "https:" not in html
    for word in ("Loss", "Parameters", "undetermined", "Before and after", "Frame by frame", "Profiles", "<svg"):
        assert word in html
    assert not list(folder.glob(".*progress*"))
    again = command(shots, "--reference", shots, "-o", folder / "tuned.toml")
    assert again.returncode == 2
    assert "exists already" in again.stderr


def test_the_page_works_in_a_browser(tuned, tmp_path):
    """Headless Chromium draws its pictures, its slider moves them, and its console stays silent."""
    script = """
        const images = [...document.images], range = document.querySelector('input[type=range]');
        range.value = 20;
        range.dispatchEvent(new Event('input'));
        Promise.all(images.map(i => i.decode())).then(() => document.title =
            `${images.length} of ${images.filter(i => i.naturalWidth > 0).length} ${images[1].style.clipPath}`);
    """
    dom = opened(tuned[1] / "report.html", tmp_path, script=script)
    count, drawn, clip = re.search(r"<title>(\d+) of (\d+) (.*?)</title>", dom).groups()
    assert int(count) == int(drawn) >= 2 + 1 + 3  # two pictures, a difference, three slopes
    assert clip.startswith("inset(0px 80% 0px 0px")
    assert "<polyline" in dom


def test_worse_validation_is_an_error_and_loses_nothing(tuned):
    done, folder = tuned
    assert done.returncode == 1
    assert "VALIDATION GOT WORSE" in done.stderr
    assert "Validation got worse" in (folder / "report.html").read_text()
    assert json.loads(done.stdout)["worse"]
    assert (folder / "tuned.toml").exists()


@pytest.mark.parametrize(
    ("accept", "worse", "diverged", "code"),
    [([], 1, False, 1), (["--accept"], 1, False, 0), ([], 0, True, 1), (["--accept"], 0, True, 1)],
)
def test_worse_validation_can_be_accepted_a_lost_solver_not(
    accept, worse, diverged, code, shots, tmp_path, monkeypatch
):
    found = types.SimpleNamespace(result="converged", diverged=diverged)
    monkeypatch.setattr("tune.fitting.fit", lambda *_, **__: found)
    monkeypatch.setattr("tune.telling.conclude", lambda *_, **__: worse)
    with pytest.raises(SystemExit) as left:
        main([str(shots), "--reference", str(shots), "-o", str(tmp_path / "t.toml"), *accept])
    assert left.value.code == code


def test_an_interrupted_fit_says_its_doubts_again(shots, tmp_path, monkeypatch, capsys):
    found = types.SimpleNamespace(result="interrupted", diverged=False)
    monkeypatch.setattr("tune.fitting.fit", lambda *_, **__: found)
    monkeypatch.setattr("tune.telling.conclude", lambda *_, **__: 0)
    monkeypatch.setattr("tune.targets.with_doubts", lambda shot: shot._replace(notes=("of another shot?",)))
    with pytest.raises(SystemExit) as left:
        main([str(shots), "--reference", str(shots), "-o", str(tmp_path / "t.toml")])
    assert left.value.code == 130
    *_, doubt, last = capsys.readouterr().err.splitlines()
    assert doubt == "warning: of another shot? (as said before the fit)"
    assert "--resume" in last


def test_a_fit_that_is_done_is_not_resumed(shots, tmp_path, capsys):
    (tmp_path / "t.toml").touch()
    with pytest.raises(SystemExit) as left:
        main([str(shots), "--reference", str(shots), "-o", str(tmp_path / "t.toml"), "--cameras", "none", "--resume"])
    assert left.value.code == 2
    assert "t.toml" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--validate", "{}/frame_####.exr", "--validate-reference", "{}"], "both tuned and validated"),
        (["--second", "{}/frame_####.exr"], "independent render"),
        (["--reference", "{}", "--robust-width", "0"], "above 0"),
        (["--reference", "{}", "--prior", "-3"], "0 or more"),
        (["--reference", "{}", "--max-steps", "0"], "at least 1"),
        (["--reference", "{}", "--maps", "{}/cameras.json"], "wanted a folder"),
        (["--reference", "{}", "--report", "t.toml"], "two files"),
    ],
)
def test_what_would_mislead_is_refused(options, said, shots, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (shots / "cameras.json").touch()
    options = [option.format(shots) for option in options]
    if "--second" not in options and "--reference" not in options:
        options += ["--reference", str(shots)]
    with pytest.raises(SystemExit) as left:
        main([str(shots), "-o", "t.toml", "--cameras", "none", *options])
    assert left.value.code == 2
    assert said in capsys.readouterr().err
    (shots / "cameras.json").unlink()
