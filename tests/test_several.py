"""Many shots and ranges by several processes: who takes what, and what becomes of what a dead one had."""

import os
import re
import subprocess
import sys
import types
from pathlib import Path

import pytest
from shots import write_shot
from test_dry_run import run as command

from svgf_jax import checkpoint, processes
from svgf_jax.checkpoint import Busy, lock, save_run
from svgf_jax.commands import several
from svgf_jax.types import SvgfError


def tasks_in(out, count):
    names = [f"{10 * i + 1}-{10 * i + 10}" for i in range(count)]
    return [several.Task("shot", out, name, 2, checkpoint.state_folder(out, name), 10) for name in names]


def runner(done):
    def run(task):
        with lock(task.state):
            done.append(task.frames)
            save_run(task.state, {"frames": []}, complete=True)
        return 0

    return run


def test_parts_depend_on_the_command_alone(tmp_path):
    shots = [write_shot(tmp_path / name, range(1, frames + 1)) for name, frames in (("one", 5), ("two", 2))]
    tasks = several.plan_tasks(shots, tmp_path / "out", frames=None, warmup=None, split=2)
    assert [(task.name, task.warmup, task.written) for task in tasks] == [
        ("one 1-2", 32, 2),
        ("one 3-4", 32, 2),
        ("one 5", 32, 1),
        ("two 1-2", 32, 2),
    ]
    assert tasks[1].state == tmp_path / "out" / "one" / ".svgf-jax" / "3-4"
    (whole,) = several.plan_tasks(shots[:1], tmp_path / "out", frames="2-4", warmup=None, split=None)
    assert (whole.out, whole.frames, whole.warmup, whole.written) == (tmp_path / "out", "2-4", None, 3)
    assert whole.state == tmp_path / "out" / ".svgf-jax"


def test_shots_get_folders_of_their_own(tmp_path):
    assert several.shot_names(["r/a/f_####.exr", "r/b/f_####.exr"]) == ["a", "b"]
    assert several.shot_names(["r/a_####.exr", "r/b.%04d.exr"]) == ["a", "b"]
    with pytest.raises(SvgfError, match=r"would have one name"):
        several.shot_names(["x/r/a_##.exr", "y/r/a_##.exr"])


def test_a_process_takes_its_share_and_then_what_is_free(tmp_path, monkeypatch, capsys):
    """What another holds is left to it; once its lock is free without the task being complete, process 0 goes on with it."""
    tasks, done = tasks_in(tmp_path, 5), []
    held = lock(tasks[1].state)
    held.__enter__()
    monkeypatch.setattr(several.time, "sleep", lambda seconds: held.__exit__(None, None, None))  # it died
    assert several.deal(tasks, runner(done), rank=0, size=2) == 0
    assert done == ["1-10", "21-30", "41-50", "31-40", "11-20"]
    told = capsys.readouterr().err
    assert "waiting for" in told
    assert "5 of 5 tasks complete" in told
    assert f"process {os.getpid()}" in told


def test_without_locks_each_does_its_own_share(tmp_path, capsys):
    tasks, done = tasks_in(tmp_path, 4), []
    assert several.deal(tasks, runner(done), rank=1, size=2, locks=False) == 0
    assert done == ["11-20", "31-40"]
    assert several.deal(tasks, runner(done), rank=0, size=3, locks=False) == 2
    assert "21-30: not complete, 0 of 10 frames" in capsys.readouterr().err


def test_one_bad_task_keeps_nobody_from_the_others(tmp_path, capsys):
    tasks, done = tasks_in(tmp_path, 3), []

    def run(task):
        if task is tasks[1]:
            raise SvgfError("frame 13 is damaged")
        return runner(done)(task)

    assert several.deal(tasks, run) == 2
    assert done == ["1-10", "21-30"]
    told = capsys.readouterr().err
    assert "frame 13 is damaged" in told
    assert "2 of 3 tasks complete; the same command with --resume goes on" in told
    assert several.deal(tasks, lambda task: 143) == 143


def test_a_damaged_record_stops_its_own_task_only(tmp_path, capsys):
    tasks, done = tasks_in(tmp_path, 3), []
    tasks[1].state.mkdir(parents=True)
    (tasks[1].state / "run.json").write_text("{")

    def run(task):
        checkpoint.load_run(task.state)  # as --resume does
        return runner(done)(task)

    assert several.deal(tasks, run) == 2
    assert done == ["1-10", "21-30"]
    told = capsys.readouterr().err
    assert told.count("run.json: it is damaged") == 1
    assert "11-20: failed, 0 of 10 frames" in told
    assert "2 of 3 tasks complete" in told


def test_who_holds_a_folder(tmp_path):
    state = checkpoint.state_folder(tmp_path, "1-5")
    state.mkdir(parents=True)
    assert not checkpoint.is_held(state)
    assert checkpoint.holder(state) == ""
    assert list(state.iterdir()) == []  # to ask leaves nothing behind
    with lock(state):
        assert checkpoint.is_held(state)
        with pytest.raises(Busy):
            lock(state).__enter__()
    assert not checkpoint.is_held(state)
    assert checkpoint.holder(state).startswith(f"process {os.getpid()} on ")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--process", "1"], r"or --process without --distributed"),
        (["--distributed", "--process", "1"], r"wanted all three"),
        (["--distributed", "--coordinator", "h:1", "--processes", "2", "--process", "2"], r"wanted 0 to 1"),
        (["--distributed", "--coordinator", "h", "--processes", "2", "--process", "0"], r"wanted HOST:PORT"),
        (["--distributed", "--overwrite"], r"Got --distributed and --overwrite"),
        (["--split", "0"], r"Got --split 0"),
        (["--split", "2", "--json"], r"Got --json for several runs"),
    ],
)
def test_what_can_not_be_meant_is_said_before_any_work(tmp_path, capsys, options, message):
    code, _, error = command(capsys, "denoise", write_shot(tmp_path / "in", [1]), "-o", tmp_path / "out", *options)
    assert code == 2
    assert re.search(message, error)
    assert not (tmp_path / "out").exists()


MEETING = """
import os, sys
from pathlib import Path
from svgf_jax import processes
from svgf_jax.commands import several
from svgf_jax.types import SvgfError

port, out, i = int(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
me = processes.meet(f"127.0.0.1:{port}", 3, i, dead_after=2)
assert several.locks_reach(out, me)
print(processes.gather(me, "names", b"%d" % i))
if i == 2:
    os._exit(9)
try:
    processes.gather(me, "never", b"")
except SvgfError as error:
    print(error)
processes.leave(me)
import jax
assert jax.process_count() == 1 and jax.process_index() == 0
print(jax.numpy.ones(3).sum())
"""


def test_processes_meet_and_outlive_one_another(tmp_path):
    """Three real ones; one dies."""
    sys.path.insert(0, str(Path(__file__).parent / "bench"))
    from distributed import ALONE, free_port

    port, environment = free_port(), {**os.environ, **ALONE}
    started = [
        subprocess.Popen(
            [sys.executable, "-c", MEETING, str(port), str(tmp_path / "out"), str(i)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        for i in range(3)
    ]
    said = [process.communicate(timeout=120) for process in started]
    assert [process.returncode for process in started] == [0, 0, 9], said
    for i, (out, _) in enumerate(said[:2]):
        assert out.startswith("[b'0', b'1', b'2']")
        assert f"Process 2 of 3 (counted from 0) has ended before its work was done, so process {i} ends too" in out
        assert out.endswith("3.0\n")


def test_processes_that_never_meet(monkeypatch):
    import jax

    def fails(*arguments, **options):
        raise RuntimeError("DEADLINE_EXCEEDED: Barrier timed out")

    monkeypatch.setattr(jax.distributed, "initialize", fails)
    with pytest.raises(SvgfError, match=r"did not all meet at .* within 5 s"):
        processes.meet("127.0.0.1:1", 2, 1, within=5)
    monkeypatch.undo()
    assert processes.gather(processes.Process(), "alone", b"x") == [b"x"]


def test_a_jax_that_keeps_its_runtime_elsewhere_is_told(monkeypatch):
    state = types.SimpleNamespace(client=None, process_id=0, num_processes=None, coordinator_address=None)
    for target, value, said in [
        ("global_state", state, "SimpleNamespace has no service"),
        ("global_state", None, "NoneType has no client, service"),
        (None, None, "distributed"),
    ]:
        with monkeypatch.context() as patch:
            if target:
                patch.setattr(f"jax._src.distributed.{target}", value)
            else:
                patch.setitem(sys.modules, "jax._src.distributed", None)
            with pytest.raises(SvgfError, match=f"cannot meet by JAX .*{said}.*0.10 to 0.12.*--frames"):
                processes.meet("127.0.0.1:1", 2, 1)
    with monkeypatch.context() as patch:
        patch.setattr("jax.distributed.initialize", lambda *args: None)  # knows no such options
        with pytest.raises(SvgfError, match=r"cannot meet by JAX .*unexpected keyword"):
            processes.meet("127.0.0.1:1", 2, 1)
