"""Runs of `svgf-jax denoise` in processes of their own, to be struck by faults: started, held, watched, resumed and compared."""

import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

import svgf_jax

ROOT = Path(svgf_jax.__file__).parents[1]
FRAMES = 24
MADE = ("--png", "--video")


class Place(NamedTuple):
    """Where a fault is tried: a folder of its own, the input frames in it, the undisturbed outputs by name, random numbers."""

    folder: Path
    shot: Path
    wanted: dict[str, bytes]
    rng: random.Random
    compiled: Path
    kills: int = 0


def require(condition: object, *what: object) -> None:
    if not condition:
        raise AssertionError(" ".join(map(str, what)))


def write_shot(folder: Path) -> Path:
    folder.mkdir()
    for i in range(FRAMES):
        shutil.copy(svgf_jax.sample() / f"frame_{i % 10:04d}.exr", folder / f"frame_{i:04d}.exr")
    return folder


def environment(place: Place, **more: str) -> dict[str, str]:
    """Compiled programs are kept between runs: what is tried is what comes after."""
    cache = {"JAX_COMPILATION_CACHE_DIR": str(place.compiled), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    return os.environ | cache | {"PYTHONPATH": str(ROOT)} | more


def call(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "svgf_jax", *map(str, arguments)]


def denoise(place: Place, out: Path, *options: object) -> list[str]:
    often = () if "--checkpoint-every" in options else ("--checkpoint-every", 3)
    return call("denoise", place.shot, "-o", out, *MADE, *often, *options)


def start(place: Place, command: list[str], **options) -> subprocess.Popen:
    given = {"env": environment(place), "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, **given | {"text": True, "stdin": subprocess.DEVNULL} | options)


def finish(process: subprocess.Popen) -> tuple[int, str]:
    """(exit code, the rest of the standard error), read by one reader throughout: no line is lost between two."""
    told = process.stderr.read()
    return process.wait(300), told


def run(place: Place, command: list[str], **options) -> tuple[int, str]:
    return finish(start(place, command, **options))


def stopped_after(place: Place, frame: int, command: list[str], **options) -> subprocess.Popen:
    """A run that is held (SIGSTOP) as soon as it says that a frame is done, so that a fault strikes right there."""
    process = start(place, command, **options)
    for line in process.stderr:
        if line.startswith(f"frame {frame}:"):
            process.send_signal(signal.SIGSTOP)
            os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)  # it takes a moment
            return process
    raise AssertionError(f"{' '.join(command)} ended before frame {frame}: {process.wait()}")


def go_on(process: subprocess.Popen) -> tuple[int, str]:
    process.send_signal(signal.SIGCONT)
    return finish(process)


def outputs(out: Path) -> dict[str, bytes]:
    """Every file with a final name."""
    found = {}
    for path in out.glob("[!.]*"):
        try:
            found[path.name] = path.read_bytes()
        except FileNotFoundError:  # replaced just now
            continue
    return found


def check_whole(place: Place, out: Path) -> None:
    """No file with a final name is other than the undisturbed run's."""
    for name, content in outputs(out).items():
        require(content == place.wanted.get(name), name, "is not that of the undisturbed run:", len(content), "bytes")


def check_resumes(place: Place, out: Path, *options: object, **more) -> None:
    """`--resume` gives everything, and leaves nothing else behind."""
    code, told = run(place, denoise(place, out, "--resume", *options), **more)
    require(code == 0, "--resume failed:", code, told)
    require(outputs(out) == place.wanted, "--resume gave other bytes")
    require(not list(out.rglob(".*.tmp")), "temporary files are left")


def check_told(code: int, told: str, wanted: int, *words: str) -> str:
    """The last line, which says what was wrong."""
    require(code == wanted, "exit code", code, "wanted", wanted, told)
    require("Traceback" not in told, told)
    last = told.strip().splitlines()[-1] if told.strip() else ""
    for word in words:
        require(word in last, word, "is not said in:", told)
    return f"{last} ({code})"


@contextmanager
def watched(place: Place, out: Path) -> Iterator[list[int]]:
    """Read every new file over and over while a run goes on; how many versions of files were seen whole."""
    seen: dict[tuple, None] = {}
    wrong: list[str] = []
    count, ended = [0], threading.Event()

    def look() -> None:
        for path in [*out.glob("[!.]*"), *(out / ".svgf-jax").glob("[!.]*")]:
            try:
                status = path.stat()
                mark = (path.name, status.st_ino, status.st_mtime_ns, status.st_size)
                if mark in seen or path.name in ("lock", "frames.jsonl"):
                    continue
                if path.suffix == ".npz":
                    with open(path, "rb") as file, np.load(file) as arrays:
                        whole = all(arrays[name] is not None for name in arrays.files)
                elif path.suffix == ".json":
                    whole = path.read_text().rstrip().endswith("}")
                else:
                    whole = path.read_bytes() == place.wanted.get(path.name)
            except FileNotFoundError:
                continue
            except Exception as error:
                whole = False
                wrong.append(f"{path.name}: {error!r}")
            if not whole:
                wrong.append(path.name)
            seen[mark] = None
            count[0] += 1

    def watch() -> None:
        while not ended.is_set():
            look()
            ended.wait(0.002)
        look()

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield count
    finally:
        ended.set()
        thread.join()
    require(not wrong, "visible under a final name, and not whole:", wrong)


def stopped_until_done(place: Place, out: Path, signals: list[str], enough: Callable[[], bool]) -> Counter:
    """A run that gets a signal at random moments, and is resumed, until it is done; how often which, and what was seen."""
    counts: Counter[str] = Counter()
    with watched(place, out) as seen:
        while True:
            options = ("--resume", "--checkpoint-every", place.rng.choice((1, 2, 3, 8)))
            process = start(place, denoise(place, out, *options))
            told = ""
            if place.rng.random() < 0.25:  # while it starts, reads its checkpoint, compiles
                time.sleep(place.rng.uniform(0, 4))
            else:
                for line in process.stderr:
                    told += line
                    if line.startswith("frame "):
                        break
                time.sleep(place.rng.uniform(0, 0.5))
            if process.poll() is None and not enough():
                name = place.rng.choice(signals)
                process.send_signal(signal.Signals[name])
                counts[name] += 1
                counts["before the first output"] += not list(out.glob("*.exr"))
            code, rest = finish(process)
            require("frame " not in told or "Traceback" not in rest, rest)
            print(f"{dict(counts)}, {len(list(out.glob('*.exr')))} frames there", file=sys.stderr, flush=True)
            if code == 0:
                break
            require(code in (-9, -15, 143, 130), code, told + rest)
    require(outputs(out) == place.wanted, "other bytes in", out)
    require(not list(out.rglob(".*.tmp")), "temporary files are left in", out)
    shutil.rmtree(out)
    return counts + Counter({"seen whole": seen[0], "runs": 1})


def prepare(folder: Path, rng: random.Random) -> Place:
    """The input, and what an undisturbed run makes of it."""
    folder.mkdir(exist_ok=True)
    folder.chmod(0o755)
    place = Place(folder / "whole", write_shot(folder / "in"), {}, rng, folder / "compiled")
    code, told = run(place, denoise(place, place.folder))
    require(code == 0, told)
    return place._replace(folder=folder, wanted=outputs(place.folder))
