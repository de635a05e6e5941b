"""What the command line answers at once: its help, and errors that are plain and leave nothing behind."""

import json
import os
import re
import subprocess
import sys

import pytest
from calling import COMMANDS, SEARCHED, observed, seconds_to_import
from shots import write_frame, write_shot

from svgf_jax import exr


@pytest.mark.parametrize("arguments", [["--help"], ["denoise", "--help"], ["ablate", "--help"], ["--version"]])
def test_help_is_quick_and_imports_nothing_heavy(arguments):
    for _ in range(3):  # a busy machine is given another chance
        code, _, seconds, modules = observed(*arguments)
        assert code == 0
        assert not modules & {"jax", "jaxlib", "numpy"}
        least = seconds_to_import("cyclopts")  # the help takes four times that
        if seconds < 6 * least:
            break
    assert seconds < 6 * least


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    """Several small sequences, good and bad, that no test changes."""
    folder = tmp_path_factory.mktemp("shots")
    write_shot(folder / "good", [1, 2, 3])
    write_shot(folder / "gap", [1, 3])
    write_shot(folder / "resized", [1, 2])
    write_frame(folder / "resized" / "shot.0003.exr", 3, size=(9, 9))
    write_shot(folder / "cut", [1, 2])
    first = folder / "cut" / "shot.0001.exr"
    first.write_bytes(first.read_bytes()[:3000])
    write_shot(folder / "empty_file", [1])
    (folder / "empty_file" / "shot.0001.exr").write_bytes(b"")
    write_shot(folder / "renamed", [1])
    path = folder / "renamed" / "shot.0001.exr"
    image = exr.read(path)
    exr.write(path, image._replace(channels={k.replace("albedo", "[red]albdo"): v for k, v in image.channels.items()}))
    (folder / "nothing").mkdir()
    (folder / "file").write_text("")
    return folder


ERRORS = {
    "no command": (["denoize", "x"], "denoise"),
    "no output": (["denoise", "good"], "--out"),
    "unknown flag": (["denoise", "good", "-o", "out", "--pngs"], "--png"),
    "wrong choice": (["denoise", "good", "-o", "out", "--missing", "skip"], "hold"),
    "no such folder": (["denoise", "god", "-o", "out"], "good"),
    "nothing inside": (["denoise", "nothing", "-o", "out"], "this one holds nothing"),
    "missing frame": (["denoise", "gap", "-o", "out"], "--missing hold|reset"),
    "bad range": (["denoise", "good", "-o", "out", "--frames", "one"], "1-100x2"),
    "cut off": (["denoise", "cut", "-o", "out"], "cut off"),
    "zero bytes": (["denoise", "empty_file", "-o", "out"], "empty"),
    "channel not there": (
        ["denoise", "renamed", "-o", "out", "--channel", "albedo=albdo.R,albdo.G,albdo.B"],
        "[red]albdo",
    ),
    "bad channel option": (["denoise", "good", "-o", "out", "--channel", "albedo"], "albedo=foo.R,foo.G,foo.B"),
    "no such role": (["denoise", "good", "-o", "out", "--channel", "albdo=a,b,c"], "albedo"),
    "unknown preset": (["denoise", "good", "-o", "out", "--preset", "papr"], "paper"),
    "unknown parameter": (["denoise", "good", "-o", "out", "--set", "sigma_norml=3"], "sigma_normal"),
    "not a number": (["denoise", "good", "-o", "out", "--set", "alpha=much"], "wanted a number"),
    "not whole": (["denoise", "good", "-o", "out", "--set", "levels=2.5"], "whole number"),
    "out of range": (["denoise", "good", "-o", "out", "--set", "alpha=7"], "alpha"),
    "too few per level": (["denoise", "good", "-o", "out", "--set", "sigma_normal=1,2"], "sigma_normal"),
    "two parameter sets": (["denoise", "good", "-o", "out", "--preset", "paper", "--params", "a.toml"], "one of them"),
    "no parameter file": (["denoise", "good", "-o", "out", "--params", "a.toml"], "a.toml"),
    "output is a file": (["denoise", "good", "-o", "file"], "wanted a folder"),
    "output under a file": (["denoise", "good", "-o", "file/out"], "Cannot write into the output folder"),
    "output over input": (["denoise", "good", "-o", "good"], "would replace an input"),
    "resume and overwrite": (["denoise", "good", "-o", "out", "--resume", "--overwrite"], "Choose one"),
    "bad fps": (["denoise", "good", "-o", "out", "--fps", "fast"], "fps"),
    "zero fps": (["denoise", "good", "-o", "out", "--fps", "0"], "from 0.1 to 1000"),
    "negative exposure": (["denoise", "good", "-o", "out", "--exposure", "-1"], "above 0"),
    "no exposure": (["denoise", "good", "-o", "out", "--png", "--exposure", "nan"], "above 0"),
    "nothing to compare": (["compare", "god", "good"], "good"),
    "scores into nowhere": (["compare", "good", "good", "--csv", "file/a.csv"], "Could not write file/a.csv: Not a"),
    "scores over a folder": (["compare", "good", "good", "--json", "nothing", "--overwrite"], "Is a directory"),
    "different sizes": (["compare", "resized", "good"], "pixels"),
    "unknown shown preset": (["params", "show", "papr"], "paper"),
}


@pytest.fixture(scope="module")
def refused(shots):
    """What each of ERRORS said, one after another in one process: text, (exit code, seconds, heavy modules, files).

    Before it, the files that were there and the seconds that are quick: an idle machine needs a third, and all swell on a busy one.
    """
    quick = 8 * seconds_to_import("cyclopts")
    before = sorted(str(path.relative_to(shots)) for path in shots.rglob("*"))
    environment = os.environ | {"PYTHONPATH": SEARCHED}
    given = json.dumps([arguments for arguments, _ in ERRORS.values()])
    call = [sys.executable, "-c", COMMANDS]
    done = subprocess.run(call, cwd=shots, env=environment, input=given, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    parts = re.split(r"^TELL (.*)\n", done.stderr, flags=re.MULTILINE)
    told = zip(parts[::2], map(json.loads, parts[1::2]), strict=False)  # nothing is said after the last
    return before, quick, dict(zip(ERRORS, told, strict=True))


@pytest.mark.parametrize("case", ERRORS)
def test_errors_are_plain_quick_and_leave_nothing(refused, case):
    before, quick, told = refused
    error, (code, seconds, modules, found) = told[case]
    assert code == 2
    assert ERRORS[case][1] in error
    assert "Traceback" not in error
    assert not modules
    assert seconds < quick
    assert found == before


@pytest.mark.parametrize("case", ["no command", "cut off"])
def test_an_error_is_quick_from_the_start(shots, case):
    code, error, seconds, modules = observed(*ERRORS[case][0], cwd=shots)
    assert code == 2
    assert ERRORS[case][1] in error
    assert not modules & {"jax", "jaxlib"}
    assert seconds < 8 * seconds_to_import("cyclopts")
