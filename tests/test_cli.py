import csv
import json
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from calling import ROOT, SEARCHED, command
from shots import write_shot

from svgf_jax import exr
from svgf_jax.cli import main
from svgf_jax.commands import terminal
from svgf_jax.types import Rejected

# Denoising for real


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    """A small sequence in `good`, that no test changes."""
    folder = tmp_path_factory.mktemp("shots")
    write_shot(folder / "good", [1, 2, 3])
    return folder


@pytest.fixture(scope="module")
def denoised(shots, tmp_path_factory):
    """(finished process, output folder) of a run with most options."""
    out = tmp_path_factory.mktemp("denoised") / "a" / "b"
    done = command(
        *("denoise", "good", "-o", out, "--preset", "falcor", "--set", "sigma_normal=64", "--set", "levels=2"),
        *("--diagnostics", "--float", "--compression", "zips", "--png", "--json", "-v"),
        cwd=shots,
    )
    return done, out


def test_denoise_writes_frames_and_tells_what_it_does(denoised, shots):
    done, out = denoised
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in out.glob("*.*") if path.is_file()) == [
        f"shot.000{i}.{kind}" for i in (1, 2, 3) for kind in ("exr", "png")
    ]
    for number in (1, 2, 3):
        assert re.search(rf"^frame {number}: filtered -> .*shot\.000{number}\.exr", done.stderr, re.M)
    assert "albedo    albedo.RGB (native name)" in done.stderr
    assert "3 frames (3 filtered) in" in done.stderr
    summary = json.loads(done.stdout)
    assert summary["frames"] == 3
    assert summary["preset"] == "falcor sigma_normal=64 levels=2"
    assert summary["parameters"]["sigma_normal"] == 64
    assert summary["config"]["levels"] == 2
    image = exr.read(out / "shot.0003.exr")
    assert image.channels["R"].dtype == np.float32
    assert image.channels["svgf.history_length"].max() == 3
    assert image.channels["svgf.effective_history.direct"].max() == pytest.approx(3)  # they weigh the same
    assert image.attributes["svgf_jax:preset"] == "falcor sigma_normal=64 levels=2"


def test_denoise_is_less_noisy_than_its_input(denoised, shots):
    out = denoised[1]
    channels = exr.read(out / "shot.0003.exr").channels
    noisy, clean = channels["direct.G"] + channels["indirect.G"], channels["G"]
    assert clean[:, 4:].astype(float).std() < 0.5 * noisy[:, 4:].astype(float).std()


def test_a_terminal_gets_a_progress_bar(shots, tmp_path):
    pty = pytest.importorskip("pty")
    reading, writing = pty.openpty()
    call = [sys.executable, "-m", "svgf_jax", "denoise", "good", "-o", str(tmp_path / "out"), "--set", "levels=1"]
    environment = os.environ | {"PYTHONPATH": SEARCHED, "TERM": "xterm", "COLUMNS": "120"}
    process = subprocess.Popen(call, cwd=shots, env=environment, stderr=writing, stdout=subprocess.DEVNULL)
    os.close(writing)
    shown = b""
    while True:
        try:
            chunk = os.read(reading, 4096)
        except OSError:  # the other end is closed
            break
        if not chunk:
            break
        shown += chunk
    os.close(reading)
    assert process.wait(60) == 0
    assert b"frames/s" in shown
    assert b"3/3" in shown


def test_every_count_is_told_in_words():
    read = {"excess", "rest", "changed", "guides", "normal"}
    assert terminal.REPAIRS.keys() == read | set(Rejected._fields) | {"clipped", "not_finite"}
    assert terminal.repairs({"negative": 1, "radiance": 2}) == [
        "1 pixel with negative radiance: set to 0",
        "2 pixels with non-finite radiance: set to 0",
    ]


def test_repairs_are_told_per_frame_and_at_the_end(tmp_path):
    write_shot(tmp_path / "in", [1, 2])
    for path in (tmp_path / "in").glob("*.exr"):
        image = exr.read(path)
        image.channels["direct.R"][3, 4:6] = np.nan
        exr.write(path, image)
    done = command("denoise", "in", "-o", "out", "--set", "levels=1", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert re.search(r"^frame 1: filtered -> .*; 2 pixels with non-finite radiance: set to 0$", done.stderr, re.M)
    assert "warning: 4 pixels with non-finite radiance: set to 0\n" in done.stderr


LONG = ["denoise", "in", "--set", "levels=0", "--checkpoint-every", "5", "-o"]


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    """A folder with a longer sequence in `in`, and in `whole` what an uninterrupted run makes of it."""
    folder = tmp_path_factory.mktemp("long")
    write_shot(folder / "in", range(1, 41), layers=False)
    assert command(*LONG, "whole", cwd=folder).returncode == 0
    return folder


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_command_resumes_to_the_same_bits(long, number, monkeypatch, capsys):
    out = long / f"out{number}"
    call = [sys.executable, "-m", "svgf_jax", *LONG, out.name]
    environment = os.environ | {"PYTHONPATH": SEARCHED}
    process = subprocess.Popen(call, cwd=long, env=environment, stderr=subprocess.PIPE, text=True)
    while "frame 2:" not in process.stderr.readline():
        assert process.poll() is None
    process.send_signal(number)
    with process.stderr:
        told = process.stderr.read()  # not communicate(): it would miss what readline() has read ahead
    assert process.wait(60) == 128 + number
    assert "Traceback" not in told
    assert f"Continue with: svgf-jax {' '.join(LONG)} {out.name} --resume" in told
    assert not list(out.glob(".*.tmp"))
    files = sorted(out.glob("*.exr"))
    assert 2 <= len(files) < 40
    for path in files:
        exr.read(path)
    assert command(*LONG, out.name, "--resume", cwd=long).returncode == 0
    for path in (long / "whole").glob("*.exr"):
        assert (out / path.name).read_bytes() == path.read_bytes()
    monkeypatch.chdir(long)
    with pytest.raises(SystemExit) as end:
        main([*LONG, out.name, "--resume"])
    assert end.value.code == 0
    assert "nothing to do" in capsys.readouterr().err


KILLED = """
import sys
sys.path.insert(0, sys.argv[3])
from shots import init, step
from svgf_jax import streaming
from svgf_jax.frames import open_source
from svgf_jax.outputs import WriteOptions
streaming.run(open_source(sys.argv[1]), sys.argv[2], pipeline=(init, step), resume=True, checkpoint_every=3,
              options=WriteOptions(png=True, diagnostics=True), on_frame=lambda told: print(told.number, flush=True))
"""


def test_killed_at_any_moment_resumes_to_the_same_bits(tmp_path):
    """kill -9 at random moments. SVGF_KILLS says how often, SVGF_SEED which."""
    rng = np.random.default_rng(int(os.environ.get("SVGF_SEED", "0")))
    write_shot(tmp_path / "in", range(1, 61))
    environment = os.environ | {"PYTHONPATH": SEARCHED}

    def start(out):
        call = [sys.executable, "-c", KILLED, str(tmp_path / "in"), str(tmp_path / out), str(ROOT / "tests")]
        return subprocess.Popen(call, env=environment, stdout=subprocess.PIPE, text=True)

    process = start("whole")
    process.stdout.readline()
    began = time.monotonic()
    with process.stdout:  # not communicate(): it would miss what readline() has read ahead
        assert len(process.stdout.read().split()) == 59
    assert process.wait(120) == 0
    took = time.monotonic() - began
    wanted = {path.name: path.read_bytes() for path in (tmp_path / "whole").glob("*.*") if path.is_file()}
    landed = []
    for i in range(int(os.environ.get("SVGF_KILLS", "2"))):
        process = start(f"out{i}")
        process.stdout.readline()  # the first frame is done
        time.sleep(rng.uniform(0, 0.6 * took))
        process.kill()
        process.stdout.close()
        process.wait()
        landed.append(len(list((tmp_path / f"out{i}").glob("*.exr"))))
        process = start(f"out{i}")
        with process.stdout:
            process.stdout.read()
        assert process.wait(120) == 0
        got = {path.name: path.read_bytes() for path in (tmp_path / f"out{i}").glob("*.*") if path.is_file()}
        assert got == wanted
    assert any(1 <= count < 60 for count in landed), landed


def test_a_disk_that_is_full_is_a_clear_error(shots, tmp_path):
    small_files = ("sh", "-c", 'ulimit -f 8; exec "$@"', "sh")
    done = command("denoise", "good", "-o", tmp_path / "out", "--set", "levels=1", cwd=shots, under=small_files)
    assert done.returncode == 2, done.stderr
    assert "cannot be written" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list((tmp_path / "out").glob("*.exr"))
    assert not list((tmp_path / "out").glob(".*.tmp"))


def test_text_from_files_is_never_markup(tmp_path):
    write_shot(tmp_path / "in", [1])
    path = tmp_path / "in" / "shot.0001.exr"
    image = exr.read(path)
    channels = image.channels | {"[bold red]x[reset].R": image.channels["direct.R"]}
    exr.write(tmp_path / "in" / "[blink]a[reset].0001.exr", image._replace(channels=channels))
    path.unlink()
    done = command("denoise", "in", "-o", "out", "--set", "levels=1", "-v", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "[blink]a[reset].0001.exr" in done.stderr


# Comparing


@pytest.fixture(scope="module")
def references(shots, tmp_path_factory):
    """References of the sequence `good` and one frame more."""
    folder = tmp_path_factory.mktemp("references")
    write_shot(folder, [1, 2, 3, 4])
    return folder


def test_compare_prints_and_saves_all_scores(denoised, references, tmp_path):
    out = denoised[1]
    done = command("compare", out, references, "--json", tmp_path / "a.json", "--csv", tmp_path / "a.csv")
    assert done.returncode == 0, done.stderr
    assert "frames 4 are in only one of the sequences" in done.stderr
    for word in ("PSNR", "relMSE", "SSIM", "temporal", "mean"):
        assert word in done.stdout
    report = json.loads((tmp_path / "a.json").read_text())
    assert [row["frame"] for row in report["frames"]] == [1, 2, 3]
    assert report["frames"][0]["temporal"] is None
    assert report["frames"][1]["temporal"] > 0
    assert report["mean"]["psnr"] == pytest.approx(np.mean([row["psnr"] for row in report["frames"]]))
    with (tmp_path / "a.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["frame"] for row in rows] == ["1", "2", "3", "mean"]
    assert float(rows[-1]["psnr"]) == pytest.approx(report["mean"]["psnr"])
    done = command("compare", out, references, "--json", tmp_path / "a.json")
    assert done.returncode == 2
    assert "--overwrite" in done.stderr


def test_compare_shows_and_tells_of_broken_frames(references, tmp_path):
    write_shot(tmp_path / "out", [2, 3, 4])
    path = tmp_path / "out" / "shot.0003.exr"
    image = exr.read(path)
    image.channels["direct.R"][2, 3:5] = np.nan
    exr.write(path, image)
    done = command("compare", "out", references, "--frames", "2-6", "--csv", "a.csv", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "frame 3: 2 pixels not finite" in done.stderr
    assert "frames 5-6 are in neither of the sequences" in done.stderr
    with (tmp_path / "a.csv").open() as file:
        rows = {row["frame"]: row for row in csv.DictReader(file)}
    assert [rows[i]["psnr"] for i in ("3", "mean")] == ["nan", "nan"]
    assert [rows[i]["temporal"] for i in "234"] == ["", "nan", "nan"]
    assert float(rows["4"]["relmse"]) == 0
    assert "flip" in rows["2"]
    assert "FLIP" not in done.stdout
    table = {line.split()[0]: line.split() for line in done.stdout.splitlines() if line.strip()}
    assert table["3"] == ["3", *["nan"] * 4]
    assert table["mean"] == ["mean", *["nan"] * 4]


def test_compare_with_itself_is_perfect(references):
    pytest.importorskip("flip_evaluator")
    done = command("compare", references, references, "--frames", "1-2", "--flip")
    assert done.returncode == 0, done.stderr
    assert "inf" in done.stdout
    assert "HDR-FLIP" in done.stdout


# Parameters


def test_params_list_and_show(tmp_path):
    done = command("params", "list")
    assert done.returncode == 0, done.stderr
    for word in ("paper", "falcor", "sigma_normal", "feedback_level", "128"):
        assert word in done.stdout
    for line in done.stdout.splitlines():
        assert len(line) <= 100
    assert "…" not in done.stdout
    done = command("params", "show", "falcor", "--set", "sigma_luminance=4,3,2,1")
    assert done.returncode == 0, done.stderr
    (tmp_path / "mine.toml").write_text(done.stdout)
    again = command("params", "show", tmp_path / "mine.toml")
    assert again.stdout == done.stdout
    assert "sigma_luminance" in done.stdout
