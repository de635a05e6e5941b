"""Faults that strike a run, the short way, with a filter that needs no compiling; the long way is tests/bench/faults.py."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from shots import init, step, write_frame, write_shot

from svgf_jax import checkpoint, preview, streaming
from svgf_jax.checkpoint import state_folder
from svgf_jax.commands.denoise import _until_interrupted
from svgf_jax.frames import open_source
from svgf_jax.types import SvgfError
from tune.command import _terminated_as_interrupted


@pytest.fixture
def shot(tmp_path):
    return write_shot(tmp_path / "in", range(1, 7), layers=False)


@pytest.fixture
def wanted(shot, tmp_path):
    run(shot, tmp_path / "whole")
    return contents(tmp_path / "whole")


def run(source, out, **options):
    return streaming.run(open_source(source), out, pipeline=(init, step), **{"checkpoint_every": 2} | options)


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.glob("[!.]*")}


def at(number, strike):
    """Something that happens once a frame is done."""
    return lambda report: strike() if report.number == number else None


# The output folder


def test_an_output_folder_that_is_removed(shot, wanted, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(SvgfError, match="gone|no folder"):
        run(shot, out, on_frame=at(2, lambda: out.rename(tmp_path / "away")))
    run(shot, out, resume=True)
    assert contents(out) == wanted


def test_an_output_folder_that_another_run_has_by_now(shot, tmp_path):
    """Removed and made again: the first run keeps its hands off it."""
    out = tmp_path / "out"

    def take():
        out.rename(tmp_path / "away")
        state_folder(out).mkdir(parents=True)
        (state_folder(out) / "lock").touch()

    with pytest.raises(SvgfError, match="lock is gone"):
        run(shot, out, on_frame=at(1, take), checkpoint_every=3)
    assert len(contents(out)) <= 1
    assert not (state_folder(out) / "checkpoint.npz").exists()


@pytest.mark.parametrize("how", ["a run", "somebody", "a run, then Ctrl+C"])
def test_a_run_that_fails_removes_nothing_of_another(shot, tmp_path, how):
    out = tmp_path / "out"
    state, another = state_folder(out), contextlib.ExitStack()

    def take():
        shutil.rmtree(out, ignore_errors=True)  # what is being written may come in between
        shutil.rmtree(out, ignore_errors=True)
        if how == "somebody":
            return out.mkdir()
        another.enter_context(checkpoint.lock(state))
        checkpoint.save_run(state, {"frames": []}, complete=False)
        if how != "a run":
            raise KeyboardInterrupt

    with another:
        with pytest.raises(SvgfError if how != "a run, then Ctrl+C" else KeyboardInterrupt, match="lock is gone|^$"):
            run(shot, out, on_frame=at(1, take), threads=1)
        assert out.is_dir()
        if how != "somebody":
            assert {path.name for path in state.iterdir()} == {"lock", "run.json"}
            assert checkpoint.is_held(state)


def test_a_run_that_fails_at_once_leaves_no_folder_of_its_own(shot, tmp_path):
    def fail(frame):
        raise SvgfError("no such filter")

    (tmp_path / "there").mkdir()
    for name in ("out", "there"):
        with pytest.raises(SvgfError, match="no such filter"):
            streaming.run(open_source(shot), tmp_path / name, pipeline=(fail, step))
    assert not (tmp_path / "out").exists()
    assert not list((tmp_path / "there").iterdir())


def test_an_output_folder_that_nobody_may_look_into_any_more(shot, wanted, tmp_path, monkeypatch):
    """As it is with its permissions taken away; root may look everywhere."""
    out, stat, denied = tmp_path / "out", Path.stat, []

    def refused(path, **options):
        if denied and out in path.parents:
            raise PermissionError(13, "Permission denied", str(path))
        return stat(path, **options)

    def full(*_, **__):
        denied.append(True)
        raise SvgfError("Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "stat", refused)
        patch.setattr(checkpoint, "append_figures", full)
        with pytest.raises(SvgfError, match="Permission denied"):
            run(shot, out)
    run(shot, out, resume=True)
    assert contents(out) == wanted


def test_an_output_that_is_removed_is_missed_at_the_end(shot, wanted, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(SvgfError, match=r"Cannot end the run.*shot\.0001\.exr.*gone.*--overwrite"):
        run(shot, out, on_frame=at(4, (out / "shot.0001.exr").unlink))
    run(shot, out, overwrite=True)
    assert contents(out) == wanted


# The input


def test_an_input_that_is_replaced_before_it_is_read(shot, wanted, tmp_path):
    out, path = tmp_path / "out", tmp_path / "in" / "shot.0006.exr"
    summary = run(shot, out, on_frame=at(1, lambda: write_frame(path, 99, layers=False)))
    assert any("shot.0006.exr changed while the run went on" in note for note in summary.notes)
    assert run(shot, out, resume=True).statuses == {}  # complete, with the input as it is
    run(shot, tmp_path / "afresh")
    assert contents(out) == contents(tmp_path / "afresh") != wanted


def test_an_input_that_changes_while_it_is_read(shot, wanted, tmp_path, monkeypatch):
    read = streaming.frames.read_frame

    def reading(source, index):
        frame = read(source, index)
        if index == 4:
            os.utime(frame.path)
        return frame

    with monkeypatch.context() as patch:
        patch.setattr(streaming.frames, "read_frame", reading)
        with pytest.raises(SvgfError, match=r"shot\.0005\.exr.*changed while it was read.*--resume"):
            run(shot, tmp_path / "out")
    assert run(shot, tmp_path / "out", resume=True).resumed_at == 4
    assert contents(tmp_path / "out") == wanted


def test_an_input_that_is_deleted(shot, wanted, tmp_path):
    path, away = tmp_path / "in" / "shot.0006.exr", tmp_path / "away"
    with pytest.raises(SvgfError, match=r"shot\.0006\.exr: No such file.*--resume"):
        run(shot, tmp_path / "out", on_frame=at(1, lambda: path.rename(away)))
    away.rename(path)
    assert run(shot, tmp_path / "out", resume=True).resumed_at == 5
    assert contents(tmp_path / "out") == wanted


# State and locks


def test_a_line_that_was_cut_off_takes_no_other_with_it(tmp_path):
    for number in (1, 2):
        checkpoint.append_figures(tmp_path, {"number": number})
    path = tmp_path / "frames.jsonl"
    path.write_bytes(path.read_bytes()[:-7])
    checkpoint.append_figures(tmp_path, {"number": 3})
    assert list(checkpoint.load_figures(tmp_path)) == [1, 3]


def test_a_lock_file_that_is_removed_between_opening_and_locking(tmp_path, monkeypatch):
    state, lock, removed = state_folder(tmp_path), checkpoint._try_lock, []

    def late(file, *, shared):
        if not removed:
            removed.append((state / "lock").unlink())
        return lock(file, shared=shared)

    monkeypatch.setattr(checkpoint, "_try_lock", late)
    with (
        checkpoint.lock(state),
        pytest.raises(SvgfError, match="Another run is writing"),
        checkpoint.lock(state),
    ):
        pass
    assert removed


def test_a_run_that_comes_second_touches_nothing_of_the_first(shot, tmp_path, monkeypatch):
    """Both began when there was no folder yet."""
    state = state_folder(tmp_path / "out")

    def held(file, *, shared):
        (state / "run.json").write_text("the first one's")
        return False

    monkeypatch.setattr(checkpoint, "_try_lock", held)
    with pytest.raises(SvgfError, match="Another run is writing"):
        run(shot, tmp_path / "out")
    assert (state / "run.json").read_text() == "the first one's"


# The terminal


def shell(line, *arguments):
    """(exit code of the command, standard error) of a shell line with the command in it as "$@"."""
    call = ["bash", "-c", f"{line}; exit ${{PIPESTATUS[0]}}", "-", sys.executable, *arguments]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    done = subprocess.run(call, env=environment, capture_output=True, text=True, timeout=60)
    return done.returncode, done.stderr


PARAMS = ("-m", "svgf_jax", "params", "list")


@pytest.mark.parametrize(
    ("line", "codes", "told"),
    [
        ('"$@" | true', {0, 141}, ""),
        ('"$@" > /dev/full', {2}, "svgf-jax: Could not write the standard output: No space left on device.\n"),
        ('"$@" <&- >&- 2>&-', {0}, ""),
    ],
)
def test_a_standard_output_that_leads_nowhere(line, codes, told):
    code, error = shell(line, *PARAMS)
    assert code in codes
    assert error == told


STOPPED = """
import os, signal, sys
from svgf_jax.commands import denoise, terminal
# Whatever the tests themselves were started under.
signal.signal(signal.SIGHUP, signal.SIG_IGN if len(sys.argv) > 1 else signal.SIG_DFL)
with denoise._until_interrupted() as received:
    os.kill(os.getpid(), signal.SIGHUP)
for _ in range(1000):
    terminal.tell("nobody reads this")
sys.exit(100 + sum(received))
"""


def test_messages_that_nobody_reads_do_not_end_a_run():
    assert shell('"$@" 2>&1 | true', "-c", STOPPED, "nohup") == (100, "")


def test_a_terminal_that_is_closed_stops_the_run_after_its_frame():
    assert shell('"$@"', "-c", STOPPED) == (100 + signal.SIGHUP, "")


def test_sigint_is_heard_where_scripts_start_commands_with_it_ignored():
    """As `command &` in a script does."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with _until_interrupted() as received:
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt), _terminated_as_interrupted():
            signal.raise_signal(signal.SIGINT)
        assert (received, signal.getsignal(signal.SIGINT)) == ([signal.SIGINT], signal.SIG_IGN)
    finally:
        signal.signal(signal.SIGINT, before)


DRAWN = """
import sys, time
from svgf_jax.commands import terminal
with terminal.bar(3) as advance:
    sys.stdin.readline()
    advance("frame 1")
    time.sleep(0.2)
terminal.tell("done")
sys.exit(100)
"""


def test_a_terminal_that_goes_without_a_word_does_not_end_a_run():
    """As after `disown`: no SIGHUP, but what is drawn cannot be."""
    pty = pytest.importorskip("pty")
    reading, writing = pty.openpty()
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1]), "TERM": "xterm"}
    process = subprocess.Popen([sys.executable, "-c", DRAWN], stdin=subprocess.PIPE, stderr=writing, env=environment)
    os.close(writing)
    shown = b""
    while b"compiling" not in shown:
        shown += os.read(reading, 1000)
    os.close(reading)
    process.communicate(b"\n", timeout=60)
    assert process.returncode == 100


def test_a_video_has_the_same_bytes_every_time(tmp_path):
    pytest.importorskip("av")
    import numpy as np

    pictures = np.random.default_rng(0).integers(0, 255, (9, 4, 7, 3), np.uint8).repeat(16, 1).repeat(16, 2)
    for i in range(4):
        preview.write_video(tmp_path / f"{i}.mp4", iter(pictures))
    assert len({(tmp_path / f"{i}.mp4").read_bytes() for i in range(4)}) == 1
