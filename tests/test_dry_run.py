"""`svgf-jax denoise --dry-run`, and what is checked and told before any run."""

import json
import re

import numpy as np
import pytest
from shots import SIZE, write_frame, write_shot

from svgf_jax import exr
from svgf_jax.cli import main
from svgf_jax.commands import terminal
from svgf_jax.estimates import estimate
from svgf_jax.frames import open_source
from svgf_jax.methods import METHODS, override_method
from svgf_jax.scan import samples_per_pixel, scan_files
from svgf_jax.types import Config


def run(capsys, *arguments):
    """(exit code, standard output, standard error) of the command line."""
    with pytest.raises(SystemExit) as stopped:
        main([str(argument) for argument in arguments])
    return stopped.value.code, *capsys.readouterr()


@pytest.fixture
def shot(tmp_path):
    write_shot(tmp_path / "in", [1, 2, 3])
    return tmp_path / "in"


def test_a_dry_run_tells_everything_and_writes_nothing(shot, tmp_path, capsys):
    before = sorted(tmp_path.rglob("*"))
    code, out, error = run(capsys, "denoise", shot, "-o", tmp_path / "a" / "out", "--dry-run", "--png", "--json")
    assert code == 0, error
    assert sorted(tmp_path.rglob("*")) == before
    assert f"3 frames (1-3), {SIZE[1]} x {SIZE[0]}" in error
    assert "albedo    albedo.RGB (native name)" in error
    assert "would filter 3 frames and write 6 files" in error
    assert re.search(r"about \d+ s on two cores after compiling .* of memory, at most .* of disk", error)
    assert "nothing was written" in error
    told = json.loads(out)
    assert [name.rsplit("/", 1)[1] for name in told["files"][:2]] == ["shot.0001.exr", "shot.0001.png"]
    assert told["frames"] == 3
    assert told["disk"] > 3 * SIZE[0] * SIZE[1] * 6
    assert told["preset"] == "paper"


@pytest.mark.parametrize("method", METHODS)
def test_a_dry_run_knows_every_method(shot, tmp_path, capsys, method):
    scan = scan_files(open_source(shot))
    config = override_method(method, {})[1]
    assert 0 < estimate(scan, pixels=1000, signals=2, config=config).seconds < 1
    if method == "accumulate":
        code, _, error = run(capsys, "denoise", shot, "-o", tmp_path / "out", "--dry-run", "--method", method)
        assert code == 0, error
        assert "nothing was written" in error


def test_following_the_light_takes_longer(shot):
    scan = scan_files(open_source(shot))
    plain, light = (estimate(scan, pixels=1000, signals=2, config=Config(light_cell=cell)).seconds for cell in (0, 4))
    assert 1.1 < light / plain < 1.3


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["-o", "in"], "would replace an input"),
        (["-o", "in/shot.0001.exr/out"], "not a folder"),
        (["-o", "done"], "exists already"),
        (["-o", "out", "--fps", "0"], "from 0.1 to 1000"),
        (["-o", "out", "--resume", "--overwrite"], "Choose one"),
        (["-o", "out", "--tev-address", "localhost"], "wanted HOST:PORT"),
    ],
)
def test_a_dry_run_finds_what_the_run_would(shot, tmp_path, capsys, monkeypatch, arguments, hint):
    monkeypatch.chdir(tmp_path)
    write_shot(tmp_path / "done", [2])
    code, _, error = run(capsys, "denoise", "in", *arguments, "--dry-run")
    assert code == 2
    assert hint in error


def test_a_disk_too_small_is_told_before(shot, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda path: type("Usage", (), {"free": 1000}))
    code, _, error = run(capsys, "denoise", shot, "-o", tmp_path / "out", "--dry-run")
    assert code == 2
    assert "only 1 kB are free" in error


@pytest.mark.parametrize("dry", [True, False])
def test_every_damaged_file_is_told_before_the_first_frame(shot, tmp_path, capsys, dry):
    write_frame(shot / "shot.0002.exr", 2, size=(9, 9))
    third = shot / "shot.0003.exr"
    third.write_bytes(third.read_bytes()[:3000])
    code, _, error = run(capsys, "denoise", shot, "-o", tmp_path / "out", *["--dry-run"] * dry)
    assert code == 2
    assert "shot.0002.exr: data window" in error
    assert "shot.0003.exr: the pixel data is cut off" in error
    assert not (tmp_path / "out").exists()


def test_a_scan_tells_what_headers_say(shot, tmp_path):
    (shot / "shot.0002.exr").unlink()
    scan = scan_files(open_source(shot, missing="hold"))
    assert (scan.there, scan.missing, scan.checked, scan.damaged) == ((1, 3), (2,), 2, {})
    assert scan.compression == "zip"
    assert scan.unused == ("crypto.R",)
    assert scan.types["direct"] == "half"
    assert scan.types["depth"] == "float"
    assert scan.stored == sum(path.stat().st_size for path in shot.glob("*.exr"))
    assert scan.attributes["shot"] == 7
    image = exr.read(shot / "shot.0001.exr")
    assert scan.pixels == 2 * sum(plane.nbytes for plane in image.channels.values())
    assert scan_files(open_source(shot, missing="hold"), most=1).checked == 1


def test_a_scan_finds_a_channel_that_is_gone(shot):
    path = shot / "shot.0002.exr"
    image = exr.read(path)
    exr.write(path, image._replace(channels={name: p for name, p in image.channels.items() if name != "depth.Z"}))
    assert "no channel 'depth.Z'" in scan_files(open_source(shot)).damaged[2]


@pytest.mark.parametrize(
    ("attributes", "samples"),
    [
        ({"cycles.ViewLayer.samples": "64", "x": 1}, ("cycles.ViewLayer.samples", 64)),
        ({"samplesPerPixel": 16}, ("samplesPerPixel", 16)),
        ({"spp": np.float32(4)}, ("spp", 4)),
        ({"samples": "many", "AA_samples": 3}, ("AA_samples", 3)),
        ({"resamples": 3, "spp": 0}, None),
    ],
)
def test_samples_per_pixel_as_renderers_write_them(attributes, samples):
    assert samples_per_pixel(attributes) == samples


def test_samples_are_those_of_the_layer():
    attributes = {"cycles.Other.samples": "2", "cycles.ViewLayer.samples": "64"}
    assert samples_per_pixel(attributes, like="ViewLayer") == ("cycles.ViewLayer.samples", 64)
    assert samples_per_pixel(attributes, like="R") == ("cycles.Other.samples", 2)


def test_amounts_are_short_and_plain():
    assert [terminal.size(n) for n in (0, 999, 5_230, 123_456_789, 2.5e12)] == [
        "0 bytes",
        "999 bytes",
        "5.23 kB",
        "123 MB",
        "2.5 TB",
    ]
    assert [terminal.duration(s) for s in (0.1, 80, 130, 7500)] == ["1 s", "80 s", "2 min", "2 h 5 min"]
