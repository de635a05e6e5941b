"""Memory, overlap and start of `svgf-jax denoise`, run as a person runs it, on files of a few frames that are linked many times.

    python tests/bench/long_runs.py [memory] [overlap] [start] [--rounds 3]

memory: peak resident set at 1920x1080 and 3840x2160 with two signals, for ten frames and (at 1920x1080) for --long of them.
overlap: wall time of a run at 1920x1080, ZIP, beside the larger of reading and writing alone, and filtering alone.
start: seconds from the command to the first written frame at 480x270.

Prints Markdown tables.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from svgf_jax import exr

sys.path.insert(0, str(Path(__file__).parent))
from speed import some_frame

DISTINCT = 3


def write_sequence(folder: Path, height: int, width: int, frames: int) -> None:
    folder.mkdir(parents=True)
    frame = some_frame(height, width)
    rng = np.random.default_rng(1)
    for i in range(frames):
        path = folder / f"frame_{i:05d}.exr"
        if i >= DISTINCT:
            os.link(folder / f"frame_{i % DISTINCT:05d}.exr", path)
            continue
        channels = {
            f"{signal}.{c}": rng.random((height, width), np.float32) for signal in ("direct", "indirect") for c in "RGB"
        }
        channels |= {f"albedo.{c}": np.asarray(frame.albedo[0, ..., k]) for k, c in enumerate("RGB")}
        channels |= {f"normal.{c}": np.asarray(frame.normal[..., k]) for k, c in enumerate("XYZ")}
        channels |= {f"motion.{c}": np.asarray(frame.motion[..., k]) for k, c in enumerate("XY")}
        channels |= {"depth.Z": np.asarray(frame.depth), "id.I": np.asarray(frame.object_id, np.float32)}
        exr.write(path, exr.new_image({name: np.ascontiguousarray(plane) for name, plane in channels.items()}))


def denoise(folder: Path, out: Path, *options: str) -> tuple[float, float]:
    """(seconds, peak resident set in GB) of a run in a process of its own."""
    command = [sys.executable, "-m", "svgf_jax", "denoise", str(folder), "-o", str(out), *options]
    began = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)} failed")
    return time.monotonic() - began, used.ru_maxrss / 1e6


def bench_memory(folder: Path, long: int, rounds: int) -> list[str]:
    lines = ["| denoise | frames | peak resident set, GB |", "|---|---|---|"]
    for height, width, frames in ((1080, 1920, 10), (1080, 1920, long), (2160, 3840, 10)):
        shot = folder / f"{width}-{frames}"
        write_sequence(shot, height, width, frames)
        _, peak = denoise(shot, folder / f"clean-{width}-{frames}")
        lines.append(f"| {width}x{height} | {frames} | {peak:.2f} |")
    return lines


def bench_overlap(folder: Path, long: int, rounds: int) -> list[str]:
    """Reading alone, writing alone and filtering alone are timed in this process, the run in its own, its first frame left out."""
    import jax

    import svgf_jax as sj

    shot, frames = folder / "overlap", 12
    write_sequence(shot, 1080, 1920, frames)
    source = sj.open_source(shot)
    params, config = sj.preset("paper")
    spent = {"reading and writing": [], "filtering": [], "run": []}
    for i in range(rounds):
        one, _ = denoise(shot, folder / f"one-{i}", "--frames", "0-1")
        whole, _ = denoise(shot, folder / f"all-{i}")
        spent["run"].append((whole - one) / (frames - 2))
        began = time.monotonic()
        loaded = [sj.read_frame(source, k) for k in range(3)]
        image = exr.read(folder / f"one-{i}" / "frame_00000.exr")
        read = (time.monotonic() - began) / 3
        began = time.monotonic()
        exr.write(folder / "alone.exr", image)
        spent["reading and writing"].append(read + time.monotonic() - began)
        history = sj.init(loaded[0].frame, config=config)
        for k in range(6):
            began = time.monotonic() if k == 2 else began
            history, _ = jax.block_until_ready(sj.step(history, loaded[k % 3].frame, params=params, config=config))
        spent["filtering"].append((time.monotonic() - began) / 4)
    median = {name: float(np.median(times)) for name, times in spent.items()}
    larger = max(median["reading and writing"], median["filtering"])
    return [
        "| a frame of 1920x1080 | / the larger part |",
        "|---|---|",
        *(f"| {name} | {seconds / larger:.2f} |" for name, seconds in median.items()),
    ]


def bench_start(folder: Path, long: int, rounds: int) -> list[str]:
    write_sequence(folder / "start", 270, 480, 1)
    spent = [denoise(folder / "start", folder / f"started-{i}")[0] for i in range(rounds)]
    return [f"Command to first written frame, 480x270: {np.median(spent):.1f} s."]


BENCHES = {"memory": bench_memory, "overlap": bench_overlap, "start": bench_start}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("benches", nargs="*", choices=[[], *BENCHES], default=[])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--long", type=int, default=1000, help="frames of the long run")
    options = parser.parse_args()
    for name in options.benches or BENCHES:
        with tempfile.TemporaryDirectory() as folder:
            print("\n".join(BENCHES[name](Path(folder), options.long, options.rounds)), "\n", flush=True)


if __name__ == "__main__":
    sys.exit(main())
