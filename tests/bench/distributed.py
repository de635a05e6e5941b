"""Real processes that share the work of `svgf-jax denoise --distributed` and `svgf-tune --distributed`, some of them killed.

    python tests/bench/distributed.py [denoise] [tune]

denoise: two shots in ranges by one, two and three processes; then by three of which one, and process 0, are killed on the way. The
    pictures must be those of one process, byte for byte.
tune: two sequences fitted by one process and by two; then by two of which one is killed, and resumed.

Prints Markdown tables. CPU only; each process gets one thread.
"""

import argparse
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

ALONE = {"JAX_PLATFORMS": "cpu", "OMP_NUM_THREADS": "1", "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false"}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def start(module: str, arguments: list, count: int, folder: Path) -> list[subprocess.Popen]:
    """`count` processes of one job; what process i says goes to `i.log`."""
    port, started = free_port(), []
    for i in range(count):
        meeting = ["--distributed", "--coordinator", f"127.0.0.1:{port}", "--processes", count, "--process", i]
        command = [sys.executable, "-m", module, *arguments, *meeting]
        with open(folder / f"{i}.log", "w") as log:
            started.append(
                subprocess.Popen(list(map(str, command)), stderr=log, stdout=log, env={**os.environ, **ALONE})
            )
    return started


def ended(started: list[subprocess.Popen], within: float = 600) -> list[int]:
    return [process.wait(within) for process in started]


def wait_for(path: Path, pattern: str, within: float = 300) -> None:
    """Until a log says so."""
    until = time.monotonic() + within
    while not re.search(pattern, path.read_text()):
        if time.monotonic() > until:
            raise SystemExit(f"{path} never said {pattern}:\n{path.read_text()}")
        time.sleep(0.02)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*.exr"))}


def bench_denoise(folder: Path) -> list[str]:
    from shots import write_shot

    for name, frames in (("one", 40), ("two", 25)):
        write_shot(folder / name, range(1, frames + 1), size=(120, 160))
    task = ["denoise", folder / "one", folder / "two", "--split", 10, "--warmup", 3, "--checkpoint-every", 2]
    task += ["--set", "levels=2"]
    whole = folder / "whole"
    subprocess.run(
        [sys.executable, "-m", "svgf_jax", *map(str, task), "-o", str(whole)], check=True, capture_output=True
    )
    lines = [
        "| processes | killed | exit codes | s | pictures as by one process | then, by one with --resume |",
        "|---|---|---|---|---|---|",
    ]
    for count, killed in ((2, None), (3, None), (3, 2), (3, 0)):
        out = folder / f"out-{count}-{killed}"
        began = time.monotonic()
        started = start("svgf_jax", [*task, "-o", out], count, folder)
        if killed is not None:
            wait_for(folder / f"{killed}.log", r"frame \d+: filtered")
            started[killed].send_signal(signal.SIGKILL)
        codes = ended(started)
        seconds, same = time.monotonic() - began, contents(out) == contents(whole)
        again = subprocess.run(
            [sys.executable, "-m", "svgf_jax", *map(str, task), "-o", str(out), "--resume"], capture_output=True
        )
        then = "the same" if contents(out) == contents(whole) and again.returncode == 0 else "DIFFER"
        lines.append(
            f"| {count} | {killed} | {codes} | {seconds:.0f} | {'all' if same else len(contents(out))} | {then} |"
        )
    return lines


def numbers(path: Path) -> list[float]:
    from svgf_jax import load_params

    return [float(value) for value in load_params(path)[0]]


def bench_tune(folder: Path) -> list[str]:
    import numpy as np

    from svgf_jax import exr
    from svgf_jax.demo import sample

    for name, left in (("one", 30), ("two", 90)):
        (folder / name).mkdir()
        for path in sorted(sample().glob("*.exr")):
            image = exr.read(path)
            channels = {
                key: np.ascontiguousarray(plane[20:68, left : left + 64]) for key, plane in image.channels.items()
            }
            exr.write(folder / name / path.name, exr.new_image(channels))
    shots = [folder / "one", folder / "two"]
    task = [
        *shots,
        "--reference",
        *shots,
        "--set",
        "levels=1",
        "--tune",
        "sigma_luminance,alpha,sigma_normal",
        "--max-steps",
        12,
    ]
    subprocess.run(
        [sys.executable, "-m", "tune", *map(str, task), "-o", str(folder / "one.toml")], check=True, capture_output=True
    )
    wanted = np.array(numbers(folder / "one.toml"))
    lines = ["| processes | killed | exit codes | largest relative difference of a number |", "|---|---|---|---|"]
    for killed in (None, 1, 0):
        out = folder / f"{killed}.toml"
        started = start("tune", [*task, "-o", out], 2, folder)
        if killed is not None:
            wait_for(folder / "0.log", r"0\.2 ")
            started[killed].send_signal(signal.SIGKILL)
            codes = ended(started)
            print(
                f"killed {killed}, {codes}; the other said:",
                (folder / f"{1 - killed}.log").read_text()[-700:],
                file=sys.stderr,
            )
            resumed = start("tune", [*task, "-o", out, "--resume"], 2, folder)
            codes += ended(resumed)
        else:
            codes = ended(started)
        off = np.abs(np.array(numbers(out)) / wanted - 1).max()
        lines.append(f"| 2 | {killed} | {codes} | {off:.1e} |")
    return lines


BENCHES = {"denoise": bench_denoise, "tune": bench_tune}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("benches", nargs="*", choices=[[], *BENCHES], default=[])
    for name in parser.parse_args().benches or BENCHES:
        with tempfile.TemporaryDirectory() as folder:
            try:
                print("\n".join(BENCHES[name](Path(folder))), "\n", flush=True)
            except BaseException:
                for log in sorted(Path(folder).glob("*.log")):
                    print(f"--- {log.name}\n{log.read_text()[-3000:]}", file=sys.stderr)
                raise


if __name__ == "__main__":
    sys.exit(main())
