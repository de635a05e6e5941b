"""A sequence in parts, as render farms do it: `--frames A-B --warmup N`, one part a task, all into one folder."""

import numpy as np
import pytest
from shots import init, step, write_shot
from test_dry_run import run as command

from svgf_jax import checkpoint, exr, streaming
from svgf_jax.checkpoint import state_folder
from svgf_jax.frames import open_source
from svgf_jax.sequences import find_sequence
from svgf_jax.types import SvgfError


@pytest.fixture
def shot(tmp_path):
    return write_shot(tmp_path / "in", range(1, 10))


def run(shot, out, frames, warmup, missing="error", **options):
    source = open_source(shot, frames=frames, warmup=warmup, missing=missing)
    return streaming.run(source, out, pipeline=(init, step), **options)


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.glob("*.exr")}


def numbers(sequence):
    return [number for number, _ in sequence.files], sequence.warmup


def test_parts_with_the_whole_past_are_the_whole(shot, tmp_path):
    """While one part is held by a process, the others run."""
    run(shot, tmp_path / "whole", None, None)
    out, reports = tmp_path / "parts", []
    with checkpoint.lock(state_folder(out, "1-3")):
        run(shot, out, "4-6", 9, on_frame=reports.append)
        run(shot, out, "7-9", 6)
        with pytest.raises(SvgfError, match=r"Another run is writing into .*parts \(frames 1-3\)"):
            run(shot, out, "1-3", 9)
        with pytest.raises(SvgfError, match="Another run is writing into .*parts "):
            run(shot, out, None, None, overwrite=True)
    run(shot, out, "1-3", 9)
    assert contents(out) == contents(tmp_path / "whole")
    told = [(report.number, report.status, report.path and report.path.name) for report in reports]
    assert told[:3] == [(number, "warm-up", None) for number in (1, 2, 3)]
    assert told[3:] == [(number, "filtered", f"shot.{number:04d}.exr") for number in (4, 5, 6)]
    figures = checkpoint.load_figures(state_folder(out, "4-6"))
    assert [figures[number]["status"] for number in range(1, 7)] == ["warm-up"] * 3 + ["filtered"] * 3
    with checkpoint.lock(state_folder(out)), pytest.raises(SvgfError, match="Another run is writing"):
        run(shot, out, "1-3", 9, overwrite=True)


def test_a_part_forgets_only_what_lies_before_its_warm_up(shot, tmp_path):
    """The running mean's weights of what is left out are at most 0.8^4."""
    run(shot, tmp_path / "whole", None, None)
    run(shot, tmp_path / "short", "9", 4)
    run(shot, tmp_path / "none", "9", 0)
    whole, short, none = (
        exr.read(tmp_path / name / "shot.0009.exr").channels["G"].astype(float) for name in ("whole", "short", "none")
    )
    assert 0 < np.abs(short - whole).mean() < 0.5 * np.abs(none - whole).mean()


@pytest.mark.parametrize("stop_after", [2, 5])
def test_a_part_resumes_in_its_warm_up_and_after(shot, tmp_path, stop_after):
    run(shot, tmp_path / "whole", "5-8", 3)
    out, asked = tmp_path / "out", iter([False] * (stop_after - 1) + [True])
    stopped = run(shot, out, "5-8", 3, stop=lambda: next(asked))
    assert stopped.interrupted
    with pytest.raises(SvgfError, match=r"input frame 1 was \[2, "):
        run(shot, out, "5-8", 2, resume=True)
    run(shot, out, "5-8", 3, resume=True)
    assert contents(out) == contents(tmp_path / "whole")
    assert run(shot, out, "5-8", 3, resume=True).statuses == {}


def test_gaps_before_a_part(tmp_path):
    """The history is held across them or lost, as in the whole run."""
    shot = write_shot(tmp_path / "in", [1, 2, 4, 5, 6])
    for missing in ("hold", "reset"):
        run(shot, tmp_path / missing, None, None, missing=missing)
        run(shot, tmp_path / f"{missing}-part", "5-6", 4, missing=missing)
        assert contents(tmp_path / f"{missing}-part").items() <= contents(tmp_path / missing).items()
    with pytest.raises(SvgfError, match="1 of 5 frames are missing: 3"):
        run(shot, tmp_path / "error", "4-6", 2)
    with pytest.raises(SvgfError, match="Frame 3 is missing, and there is none before"):
        run(shot, tmp_path / "error", "3-6", 2, missing="hold")


def test_which_frames_warm_up(shot):
    assert numbers(find_sequence(shot, frames="4-6")) == ([4, 5, 6], None)
    assert numbers(find_sequence(shot, frames="4-6", warmup=2)) == ([2, 3, 4, 5, 6], 2)
    assert numbers(find_sequence(shot, frames="3-6", warmup=32)) == ([1, 2, 3, 4, 5, 6], 2)
    assert numbers(find_sequence(shot, frames="5-9x2", warmup=2)) == ([1, 3, 5, 7, 9], 2)
    assert numbers(find_sequence(shot, warmup=2))[1] == 0
    one = shot.replace("####", "0007")
    assert numbers(find_sequence(one, warmup=2)) == ([5, 6, 7], 2)
    assert numbers(find_sequence(one, warmup=0)) == ([7], 0)
    with pytest.raises(SvgfError, match="warmup = -1"):
        find_sequence(shot, warmup=-1)


def test_the_command_tells_what_a_part_reads_and_writes(shot, tmp_path, capsys):
    code, _, error = command(
        capsys, "denoise", shot, "-o", tmp_path / "out", "--frames", "5-6", "--warmup", "3", "--video", "--dry-run"
    )
    assert code == 0, error
    assert "5 frames (2-6, of which 2-4 only to warm up)" in error
    assert "would filter 5 frames and write 3 files" in error
    assert "shot.5-6.mp4" in error
