"""Many shots, and ranges of long ones, by one process or by several that share the output folder.

What is to be done is divided into tasks by the command line alone, not by who does it. Each task is a run with a state folder and a
lock of its own: a process takes one that is neither complete nor held, its own share first. The lock of one that dies is free, and
another process goes on where its last checkpoint is.
"""

import os
import re
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

from svgf_jax.commands import terminal
from svgf_jax.types import SvgfError

WARMUP = 32
ASK_EVERY = 2.0  # seconds: whether a task that another process had is free or complete


class Task(NamedTuple):
    """A run: its input, its output folder, the range of frames with those that warm up, and where its state is kept."""

    shot: str
    out: Path
    frames: str | None
    warmup: int | None
    state: Path
    written: int

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.out.name} {self.frames}" if self.frames else self.out.name


def plan_tasks(
    shots: Sequence[str], out: Path, *, frames: str | None, warmup: int | None, split: int | None, **options: Any
) -> list[Task]:
    """The tasks, in order; `options` are of `open_source`. Raises SvgfError: no such files, shots without names of their own."""
    from svgf_jax.checkpoint import state_folder
    from svgf_jax.frames import open_source
    from svgf_jax.plan import part_name
    from svgf_jax.sequences import format_range

    if split is not None and split < 1:
        raise SvgfError(f"Got --split {split}; wanted 1 frame or more.")
    folders = [out] if len(shots) == 1 else [out / name for name in shot_names(shots)]
    if split is not None and warmup is None:
        warmup = WARMUP
    tasks = []
    for shot, folder in zip(shots, folders, strict=True):
        files = open_source(shot, frames=frames, **options).sequence.files
        length = split or len(files)
        for first in range(0, len(files), length):
            some = files[first : first + length]
            chosen = frames if split is None else format_range([number for number, _ in some])
            state = state_folder(folder, part_name(some, None if warmup is None else 0))
            tasks.append(Task(shot, folder, chosen, warmup, state, len(some)))
    return tasks


def shot_names(shots: Sequence[str]) -> list[str]:
    """What each shot's output folder is called: as the folder it lies in, or as its files where that tells them not apart."""
    by_folder = [
        Path(shot).resolve().name if os.path.isdir(shot) else Path(shot).resolve().parent.name for shot in shots
    ]
    by_files = [re.sub(r"[._-]*(#+|@+|%\d*d|\$F\d*|\d+)$", "", Path(shot).stem) for shot in shots]
    for names in (by_folder, by_files):
        if len(set(names)) == len(shots) and all(names):
            return names
    raise SvgfError(
        f"Got {', '.join(shots)}, whose outputs would have one name in the output folder; wanted folders or files of different "
        "names. Denoise them one by one, each with an --out of its own."
    )


def deal(tasks: Sequence[Task], run: Callable[[Task], int], *, rank: int = 0, size: int = 1, locks: bool = True) -> int:
    """Run what this process of several should: the exit code.

    `locks`: whether those of one process are seen by all, so that it may take over what another left. Process 0 waits until all is
    done or nobody does it any more, and tells what came of it.
    """
    from svgf_jax.checkpoint import Busy, is_held

    failed: dict[str, str] = {}
    done_before = {task for task in tasks if _complete(task)}  # which their runs look at, and say so
    mine = list(tasks[rank::size])
    todo = mine + [task for task in tasks if task not in mine] if locks else mine
    first = True
    while todo:
        held = []
        for task in todo:
            if _complete(task) and not (task in mine and task in done_before):
                continue
            if (task not in mine or not first) and is_held(task.state):
                held.append(task)
                continue
            terminal.tell(f"process {rank}: {task.name}" if size > 1 else task.name)
            try:
                code = run(task)
            except Busy:
                held.append(task)
                continue
            except SvgfError as error:
                terminal.tell(f"svgf-jax: {error}")
                failed[task.name] = str(error)
                continue
            if code:
                return code
        if rank and not first:
            break
        if held and first:
            terminal.tell(f"waiting for {', '.join(task.name for task in held)}: other processes have them")
        todo, first = held, False
        if todo:
            time.sleep(ASK_EVERY)
    if rank == 0:
        failed |= _report(tasks, failed)
    return 2 if failed else 0


def _complete(task: Task) -> bool:
    """A record that cannot be read says nothing: the run that needs it tells why, and fails alone."""
    from svgf_jax.checkpoint import load_run

    try:
        record = load_run(task.state)
    except SvgfError:
        return False
    return record is not None and record[1]


def _report(tasks: Sequence[Task], failed: dict[str, str]) -> dict[str, str]:
    """Tell what became of each task, and by whom; those that are not complete, by name."""
    from svgf_jax.checkpoint import holder, load_figures

    missing: dict[str, str] = {}
    for task in tasks:
        figures = load_figures(task.state)
        who = f", {name}" if (name := holder(task.state)) else ""
        if _complete(task):
            seconds = sum(float(one.get("seconds", 0.0)) for one in figures.values())
            terminal.tell(f"{task.name}: complete, {terminal.count(task.written, 'frame')}, {seconds:.0f} s{who}")
        else:
            done = sum(one.get("path") is not None for one in figures.values())
            missing[task.name] = failed.get(task.name, "not complete")
            why = "failed" if task.name in failed else "not complete"
            terminal.tell(f"{task.name}: {why}, {done} of {terminal.count(task.written, 'frame')}{who}")
    told = f"{len(tasks) - len(missing)} of {terminal.count(len(tasks), 'task')} complete"
    terminal.tell(f"{told}; the same command with --resume goes on" if missing else told)
    return missing


def locks_reach(folder: Path, me: Any) -> bool:
    """Whether a lock that one process takes in `folder` is seen by the others, on their machines."""
    from svgf_jax.checkpoint import is_held, lock, remove_state
    from svgf_jax.processes import gather

    probe = folder / ".svgf-jax" / "meeting"
    with ExitStack() as stack:
        if me.rank == 0:
            stack.enter_context(lock(probe))
        gather(me, "probe", b"held")
        seen = me.rank == 0 or is_held(probe)
        told = gather(me, "seen", b"1" if seen else b"0")
        if me.rank == 0:
            remove_state(probe)
        return all(one == b"1" for one in told)
