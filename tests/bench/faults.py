"""What becomes of `svgf-jax denoise` under faults, injected for real: a process killed, a full disk, files that vanish, ...

    python tests/bench/faults.py [kill] [disk] [files] ... [--kills 200] [--seed 0] [--folder KEPT]

Every fault strikes a run over 24 small frames (the bundled sample's) in a process of its own. A row of the table tells how often
it was tried, what the command said, and its exit code. It holds only if each file with a final name was, byte for byte, that of
the undisturbed run (under `kill`: at every moment), and if `--resume` afterwards gives all of them. Prints a Markdown table, and
exits with 1 if anything did not hold. Needs bash and Linux; a full disk needs root, to mount one.
"""

import argparse
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parent))
from struck_runs import (
    ROOT,
    Place,
    call,
    check_resumes,
    check_told,
    check_whole,
    denoise,
    environment,
    finish,
    go_on,
    outputs,
    prepare,
    require,
    run,
    start,
    stopped_after,
    stopped_until_done,
    write_shot,
)


class Row(NamedTuple):
    """A line of the table: the fault, how often it was tried, what the command said."""

    fault: str
    times: int
    told: str


class Unfit(Exception):
    """A fault that cannot be injected here, and why."""


def kill(place: Place) -> Iterator[Row]:
    """Killed at random moments until it is done, over and over."""
    counts: Counter[str] = Counter()
    while (left := place.kills - counts["SIGKILL"]) > 0:
        here = Counter()
        enough = lambda: here.update(asked=1) or here["asked"] > left  # noqa: B023, E731 (called in this round only)
        counts += stopped_until_done(place, place.folder / f"killed-{counts['runs']}", ["SIGKILL"], enough)
    told = f"{counts['runs']} runs killed until they were done; {counts['before the first output']} kills before the first "
    yield Row("kill -9 at a random moment", counts["SIGKILL"], f"{told}output; {counts['seen whole']} files seen whole")


def signals(place: Place) -> Iterator[Row]:
    heard = lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL)  # noqa: E731 (this one may run under nohup)
    for name, number in (("SIGTERM", 15), ("Ctrl-C", 2), ("SIGHUP, the terminal closed", 1)):
        for frame in (2, 12):
            out = place.folder / f"{number}-{frame}"
            process = stopped_after(place, frame, denoise(place, out), preexec_fn=heard)
            process.send_signal(number)
            code, said = go_on(process)
            words = ("interrupted", "Continue with", "--resume") if number != 1 else ()
            told = check_told(code, said, 128 + number, *words)
            check_whole(place, out)
            check_resumes(place, out)
        yield Row(name, 2, told.replace(str(place.folder), ""))
    out = place.folder / "twice"
    process = stopped_after(place, 5, denoise(place, out))
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGCONT)
    for line in process.stderr:
        if "Ctrl-C again" in line:
            process.send_signal(signal.SIGINT)
    code = process.wait()
    require(code == 130, code)
    check_whole(place, out)
    check_resumes(place, out)
    yield Row("Ctrl-C twice", 1, f"ends at once ({code})")


def disk(place: Place) -> Iterator[Row]:
    """A small file system of its own for the output, filled at every place that a run writes; then made larger."""
    if os.geteuid():
        raise Unfit("mounting needs root")
    told: Counter[str] = Counter()
    sizes = (8, 64, 440, 700, 3300, 6000, 9000, 11500, 12100)
    for size in sizes:
        mounted = place.folder / f"disk-{size}"
        mounted.mkdir()
        done = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", mounted], capture_output=True)
        if done.returncode:
            raise Unfit(f"mounting is not allowed: {done.stderr.decode().strip()}")
        try:
            out = mounted / "out"
            code, said = run(place, denoise(place, out))
            told[re.sub(r"\S*/", "", check_told(code, said, 2, "No space left")).replace("svgf-jax: ", "")] += 1
            check_whole(place, out)
            subprocess.run(["mount", "-o", "remount,size=64m", mounted], check=True)
            check_resumes(place, out)
        finally:
            subprocess.run(["umount", mounted], check=True)
    yield Row("disk full, at one place after another", len(sizes), "; ".join(sorted(told)[:3]))


def quota(place: Place) -> Iterator[Row]:
    """No quota is to be had everywhere; a limit on the size of a file fails the same calls, with another errno."""
    sizes = (1, 40, 300, 500)
    for size in sizes:  # of 1024 bytes: run.json, a PNG, the video, an EXR, a checkpoint do not fit any more
        out = place.folder / f"limit-{size}"
        code, said = run(place, ["bash", "-c", f'ulimit -f {size}; exec "$@"', "-", *denoise(place, out)])
        told = check_told(code, said, 2, "File too large")
        check_whole(place, out) if out.exists() else None
        check_resumes(place, out)
    yield Row("a quota (stand-in: RLIMIT_FSIZE)", len(sizes), re.sub(r"\S*/", "", told))


def folders(place: Place) -> Iterator[Row]:
    """The output folder, or parts of it, removed while a run goes on."""

    def all_of_it(out: Path) -> None:
        shutil.rmtree(out)

    def moved(out: Path) -> None:
        out.rename(out.with_name(f"{out.name} elsewhere"))

    def its_state(out: Path) -> None:
        shutil.rmtree(out / ".svgf-jax")

    def made_anew(out: Path) -> None:
        shutil.rmtree(out)
        (out / ".svgf-jax").mkdir(parents=True)
        (out / ".svgf-jax" / "lock").touch()

    for strike in (all_of_it, moved, its_state, made_anew):
        for frame in (2, 11):
            out = place.folder / f"{strike.__name__}-{frame}"
            process = stopped_after(place, frame, denoise(place, out))
            strike(out)
            told = check_told(*go_on(process), 2, "gone", str(out))
            check_whole(place, out) if out.exists() else None
            for left in out.glob("[!.]*"):  # a run whose record is gone is not resumed: it would replace files unasked
                left.unlink()
            check_resumes(place, out)
        yield Row(f"output folder, {strike.__name__.replace('_', ' ')}", 2, re.sub(r"/\S*/", "", told))
    out = place.folder / "one-output"
    process = stopped_after(place, 5, denoise(place, out))
    (out / "frame_0002.exr").unlink()
    told = check_told(*go_on(process), 2, "frame_0002.exr", "gone", "--overwrite")
    code, said = run(place, denoise(place, out, "--overwrite"))
    require((code, outputs(out)) == (0, place.wanted), said)
    yield Row("an output removed", 1, re.sub(r"/\S*/", "", told))


def inputs(place: Place) -> Iterator[Row]:
    """An input that is still to come, or is read already, cut off, deleted or replaced while a run goes on."""

    def cut_off(path: Path) -> None:
        path.write_bytes(path.read_bytes()[:100_000])

    def deleted(path: Path) -> None:
        path.unlink()

    def emptied(path: Path) -> None:
        path.write_bytes(b"")

    def a_folder_in_its_place(path: Path) -> None:
        path.unlink()
        path.mkdir()

    for strike in (cut_off, deleted, emptied, a_folder_in_its_place):
        for frame in (1, 12):
            out = place.folder / f"{strike.__name__}-{frame}"
            process = stopped_after(place, frame, denoise(place, out))
            path = place.shot / f"frame_{frame + 9:04d}.exr"
            good, times = path.read_bytes(), path.stat()
            strike(path)
            told = check_told(*go_on(process), 2, path.name)
            check_whole(place, out)
            require((out / f"frame_{frame + 8:04d}.exr").exists(), "the frames before are not all there")
            path.rmdir() if path.is_dir() else None
            path.write_bytes(good)
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
            check_resumes(place, out)
        yield Row(f"an input {strike.__name__.replace('_', ' ')}", 2, re.sub(r"/\S*/", "", told))

    here = place._replace(shot=write_shot(place.folder / "in-replaced"))
    process = stopped_after(place, 3, denoise(here, place.folder / "replaced"))
    shutil.copy(here.shot / "frame_0003.exr", here.shot / "new")
    (here.shot / "new").replace(here.shot / "frame_0020.exr")
    code, said = go_on(process)
    require(code == 0 and "frame_0020.exr changed while the run went on" in said, code, said)
    code, fresh = run(here, denoise(here, place.folder / "afresh"))
    require(outputs(place.folder / "replaced") == outputs(place.folder / "afresh"), fresh)
    code, again = run(here, denoise(here, place.folder / "replaced", "--resume"))
    require(code == 0 and "nothing to do" in again, again)
    yield Row("an input replaced before it is read", 1, "the new one is taken, and a warning says so (0)")


def rights(place: Place) -> Iterator[Row]:
    """Rights that are taken away while a run goes on; no home to write into. Root runs these without its right to everything."""
    under: list[str] = []
    if os.geteuid() == 0:
        if shutil.which("setpriv") is None:
            raise Unfit("as root it needs setpriv")
        under = ["setpriv", "--bounding-set=-dac_override,-dac_read_search"]
    home = place.folder / "home"
    home.mkdir(mode=0o555)
    bare = {name: value for name, value in environment(place).items() if not name.startswith(("XDG_", "JAX_"))}
    homeless = {"env": bare | {"HOME": str(home)}, "cwd": home}

    def strike(name: str, path: Callable[[Path], Path], mode: int, *words: str) -> Row:
        out = place.folder / name
        process = stopped_after(place, 5, [*under, *denoise(place, out)], **homeless)
        before = path(out).stat().st_mode
        path(out).chmod(mode)
        told = check_told(*go_on(process), 2, *words)
        path(out).chmod(before)
        check_whole(place, out)
        code, said = run(place, [*under, *denoise(place, out, "--resume")], **homeless)
        require((code, outputs(out)) == (0, place.wanted), said)
        return Row(f"permission lost: {name}", 1, re.sub(r"/\S*/", "", told))

    yield strike("output folder", lambda out: out, 0o555, "Permission denied", "output folder")
    yield strike("output folder altogether", lambda out: out, 0o000, "Permission denied", "altogether")
    yield strike("state folder", lambda out: out / ".svgf-jax", 0o555, "Permission denied", ".svgf-jax")
    yield strike("an input", lambda out: place.shot / "frame_0015.exr", 0o000, "ermission denied", "frame_0015.exr")
    out = place.folder / "output folder"
    for path in (out, out / ".svgf-jax"):
        path.chmod(0o555)
    code, said = run(place, [*under, *denoise(place, out, "--overwrite")], **homeless)
    require(outputs(out) == place.wanted, "something was overwritten")
    yield Row(
        "an output folder that is read-only",
        1,
        re.sub(r"/\S*/", "", check_told(code, said, 2, "Permission denied", "output folder")),
    )
    yield Row("a home and a current folder that are read-only", 9, "nothing: none of the runs above needed them (0)")


def locks(place: Place) -> Iterator[Row]:
    out = place.folder / "two"
    process = stopped_after(place, 5, denoise(place, out))
    for options in ((), ("--resume",), ("--overwrite",)):
        told = check_told(
            *run(place, denoise(place, out, *options)), 2, "Another run is writing into", str(process.pid)
        )
    code, said = go_on(process)
    require((code, outputs(out)) == (0, place.wanted), said)
    yield Row("a second run into the folder", 3, re.sub(r"/\S*/", "", told))
    times = 6
    for i in range(times):
        out = place.folder / f"together-{i}"
        pair = [start(place, denoise(place, out)) for _ in range(2)]
        ends = sorted(finish(process) for process in pair)
        require([code for code, _ in ends] == [0, 2] and "is writing into" in ends[1][1], ends)
        require(outputs(out) == place.wanted and (out / ".svgf-jax" / "run.json").exists(), "other bytes")
    yield Row("two runs begun together in a new folder", times, "one does it all (0), the other is kept out (2)")
    out = place.folder / "left"
    process = stopped_after(place, 5, denoise(place, out))
    process.kill()
    process.wait()
    (out / ".svgf-jax" / "lock").write_text(f"process {os.getpid()} on {os.uname().nodename}\n")
    check_resumes(place, out)
    yield Row(
        "a lock left by a killed run, its process id another's by now", 1, "nothing: the lock died with its process (0)"
    )


def clock(place: Place) -> Iterator[Row]:
    """A clock that jumps back an hour whenever it is read; files from the future and from 1970."""
    patch = place.folder / "patch"
    patch.mkdir()
    (patch / "sitecustomize.py").write_text(
        "import itertools, time\n_real, _reads = time.time, itertools.count(1)\n"
        "time.time = lambda: _real() - 3600 * next(_reads)\ntime.time_ns = lambda: int(time.time() * 1e9)\n"
    )
    backwards = environment(place, PYTHONPATH=f"{patch}{os.pathsep}{ROOT}")
    out = place.folder / "backwards"
    process = stopped_after(place, 7, denoise(place, out), env=backwards)
    process.kill()
    process.wait()
    check_resumes(place, out, env=backwards)
    yield Row("a clock that runs backwards (time.time), killed and resumed", 1, "nothing (0)")
    for i, path in enumerate(sorted(place.shot.iterdir())):
        os.utime(path, (0, (4e9, 0)[i % 2]))
    process = stopped_after(place, 7, denoise(place, place.folder / "times"))
    process.kill()
    process.wait()
    check_resumes(place, place.folder / "times")
    yield Row("inputs from 2096 and from 1970, killed and resumed", 1, "nothing (0)")


def streams(place: Place) -> Iterator[Row]:
    """No terminal, and standard streams that are closed, read no further, or full."""
    piped = {"stderr": subprocess.PIPE, "stdout": subprocess.PIPE}

    def shell(line: str, *words: str, out: Path | None = None, code: tuple[int, ...] = (0,)) -> None:
        command = ["bash", "-c", f"{line}; exit ${{PIPESTATUS[0]}}", "-", *words]
        done = start(place, command, **piped, start_new_session=True)
        said, errors = done.communicate(timeout=300)
        require(done.returncode in code, line, words, done.returncode, said, errors)
        require("Traceback" not in errors and "Exception ignored" not in errors, line, errors)
        if out is not None:
            require(outputs(out) == place.wanted, line, "other bytes", errors)

    lines = ('"$@" 2>&1 | head -1', '"$@" --json | head -1', '"$@" --json | true', '"$@" <&- >&- 2>&-', '"$@" 2>&-')
    lines += ('"$@" 2> /dev/full', '"$@" </dev/null 2>/dev/null')
    for i, line in enumerate(lines):
        out = place.folder / f"out-{i}"
        shell(line, *denoise(place, out), out=out)
        yield Row(f"denoise {line[5:]}", 1, "nothing: the run goes on to its end (0)")
    shell('"$@" > /dev/full', *denoise(place, place.folder / "full", "--json"), out=place.folder / "full", code=(2,))
    yield Row(
        "denoise --json > /dev/full",
        1,
        "Could not write the standard output: No space left on device. (2), after all frames",
    )
    others = (("inspect", place.shot), ("params", "list"), ("params", "show"), ("completion", "bash"), ("--help",))
    for words in (*others, ("compare", place.shot, place.shot, "--frames", "0-3")):
        shell('"$@" | head -1', *call(*words), code=(0, 141))
        shell('"$@" > /dev/full', *call(*words), code=(2,))
        shell('"$@" >&- 2>&-', *call(*words))
    yield Row(
        "inspect, params, completion, compare, --help: | head, > /dev/full, closed",
        18,
        "nothing (0); with /dev/full: 2",
    )


FAULTS: dict[str, Callable[[Place], Iterator[Row]]] = {
    fault.__name__: fault for fault in (kill, signals, disk, quota, folders, inputs, rights, locks, clock, streams)
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("faults", nargs="*", choices=[[], *FAULTS], default=[])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, help="where to work, and keep everything; a temporary one if not given")
    options = parser.parse_args()
    broken = 0
    with tempfile.TemporaryDirectory() as temporary:
        made = prepare(options.folder or Path(temporary), random.Random(options.seed))
        print("| fault | times | what is told |\n|---|---|---|", flush=True)
        for name in options.faults or FAULTS:
            place = made._replace(folder=made.folder / name, kills=options.kills)
            place.folder.mkdir()
            try:
                for row in FAULTS[name](place):
                    print(f"| {row.fault} | {row.times} | {row.told} |", flush=True)
            except Unfit as reason:
                print(f"| {name} | - | not tried: {reason} |", flush=True)
            except AssertionError as error:
                broken += 1
                told = str(error).replace("\n", " / ")
                print(f"| {name} | - | **does not hold**: {told[:300]} ... {told[-1500:]} |", flush=True)
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
