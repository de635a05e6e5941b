"""Memory, overlap and start of `svgf-jax denoise`, run as a person runs it, on files of a few frames that are linked many times.

    python tests/bench/long_runs.py [memory] [overlap] [start] [endless] [drift] [same] [restarts] [--rounds 3] [--minutes 60]

memory: peak resident set at 1920x1080 and 3840x2160 with two signals, for ten frames and (at 1920x1080) for --long of them.
overlap: wall time of a run at 1920x1080, ZIP, beside the larger of reading and writing alone, and filtering alone; and what share
of the cores it keeps busy.
start: seconds from the command to the first written frame at 480x270, compiling and with what was compiled before.
endless: resident memory, open files and threads over --endless frames of 240x135 (1.6 GB of disk; Linux).
drift: float32 against float64 over --endless frames on arrays: the variance from the accumulated moments, by how much larger
the mean is than the deviation; and the whole filter with alpha = 0 and a history without end.
same: run after run, with 1 to 4 threads, checkpoints at other frames, and over two devices: whether the bits are the same.
restarts: SIGINT, SIGTERM and kill -9 at random moments of runs that are resumed until they are done, for --minutes (see faults.py).

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


def denoise(folder: Path, out: Path, *options: str, caches: Path | None = None) -> tuple[float, float, float]:
    """(seconds, peak resident set in GB, seconds of all cores) of a run in a process of its own.

    It compiles, unless what was compiled before is kept in `caches`.
    """
    command = [sys.executable, "-m", "svgf_jax", "denoise", str(folder), "-o", str(out), *options]
    kept = {"JAX_ENABLE_COMPILATION_CACHE": "false"} if caches is None else {"XDG_CACHE_HOME": str(caches)}
    began = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=os.environ | kept)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)} failed")
    return time.monotonic() - began, used.ru_maxrss * 1024 / 1e9, used.ru_utime + used.ru_stime


def bench_memory(folder: Path, options: argparse.Namespace) -> list[str]:
    lines = ["| denoise | frames | peak resident set, GB |", "|---|---|---|"]
    for height, width, frames in ((1080, 1920, 10), (1080, 1920, options.long), (2160, 3840, 10)):
        shot = folder / f"{width}-{frames}"
        write_sequence(shot, height, width, frames)
        _, peak, _ = denoise(shot, folder / f"clean-{width}-{frames}")
        lines.append(f"| {width}x{height} | {frames} | {peak:.2f} |")
    return lines


def bench_overlap(folder: Path, options: argparse.Namespace) -> list[str]:
    """Reading alone, writing alone and filtering alone are timed in this process, the run in its own, its first frame left out."""
    import jax

    import svgf_jax as sj

    shot, frames = folder / "overlap", 12
    write_sequence(shot, 1080, 1920, frames)
    source = sj.open_source(shot)
    params, config = sj.preset("paper")
    spent, busy = {"reading and writing": [], "filtering": [], "run": []}, []
    for i in range(options.rounds):
        one, _, one_used = denoise(shot, folder / f"one-{i}", "--frames", "0-1")
        whole, _, whole_used = denoise(shot, folder / f"all-{i}")
        spent["run"].append((whole - one) / (frames - 2))
        busy.append((whole_used - one_used) / (whole - one) / len(os.sched_getaffinity(0)))
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
        "",
        f"Of the cores, the run keeps {np.median(busy):.0%} busy.",
    ]


def bench_start(folder: Path, options: argparse.Namespace) -> list[str]:
    shot, caches = folder / "start", folder / "caches"
    write_sequence(shot, 270, 480, 1)
    spent = [denoise(shot, folder / f"started-{i}")[0] for i in range(options.rounds)]
    denoise(shot, folder / "compiled", caches=caches)
    kept = [denoise(shot, folder / f"again-{i}", caches=caches)[0] for i in range(options.rounds)]
    return [
        f"Command to first written frame, 480x270: {np.median(spent):.1f} s, and {np.median(kept):.1f} s where what was compiled "
        "before was kept."
    ]


def bench_endless(folder: Path, options: argparse.Namespace) -> list[str]:
    write_sequence(folder / "shot", 135, 240, options.endless)
    command = [
        sys.executable,
        "-m",
        "svgf_jax",
        "denoise",
        str(folder / "shot"),
        "-o",
        str(folder / "out"),
        "--only-denoised",
    ]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    samples = []
    for line in process.stderr:
        if line.startswith("frame ") and int(line.split()[1].rstrip(":")) % 100 == 50:
            status = Path(f"/proc/{process.pid}/status").read_text().splitlines()
            figures = {
                name: int(rest.split()[0]) for name, _, rest in (line.partition(":") for line in status) if name in KEPT
            }
            files = len(os.listdir(f"/proc/{process.pid}/fd"))
            frame = int(line.split()[1].rstrip(":"))
            samples.append((frame, figures["VmRSS"] / 1e3, files, figures["Threads"]))
            print(samples[-1], file=sys.stderr, flush=True)
    if process.wait():
        raise SystemExit(f"{' '.join(command)} failed")
    frames, memory = (np.array([sample[k] for sample in samples[len(samples) // 5 :]]) for k in (0, 1))
    growth = np.polyfit(frames, memory, 1)[0] * 1000
    shown = [samples[round(part * (len(samples) - 1))] for part in (0, 0.2, 0.4, 0.6, 0.8, 1)]
    return [
        "| frame | resident, MB | open files | threads |",
        "|---|---|---|---|",
        *(f"| {frame} | {size:.0f} | {files} | {threads} |" for frame, size, files, threads in shown),
        "",
        f"Growth after the first fifth: {growth:+.2f} MB in 1000 frames; at most {max(s[2] for s in samples)} open files and "
        f"{max(s[3] for s in samples)} threads.",
    ]


def bench_drift(folder: Path, options: argparse.Namespace) -> list[str]:
    """Still pictures of noise around a mean; the float64 run sees the very same float32 numbers."""
    import jax
    import jax.numpy as jnp

    import svgf_jax as sj

    jax.config.update("jax_enable_x64", True)
    height, width = 16, 16
    still = jax.tree.map(lambda a: a.astype(jnp.float64) if a.dtype == jnp.float32 else a, some_frame(height, width, 1))
    still = still._replace(motion=still.motion * 0, object_id=still.object_id * 0, albedo=still.albedo * 0 + 1)

    def picture(key, ratio):
        noise = jax.random.normal(key, (1, height, width, 1), jnp.float32)
        return jnp.maximum(1 + noise / jnp.sqrt(ratio).astype(jnp.float32), 0) * jnp.ones(3, jnp.float32)

    def frame(key, ratio, dtype):
        made = still._replace(radiance=picture(key, ratio).astype(jnp.float64))
        return jax.tree.map(lambda a: a.astype(dtype) if a.dtype == jnp.float64 else a, made)

    def both(alpha, most):
        """At each frame the largest relative error of the variance over the picture, with one ratio."""
        config = sj.Config()
        params = sj.Params(alpha=alpha, alpha_moments=alpha, max_history=most)

        def variance(history, made):
            previous = sj.reproject(history, made, params=params, config=config)
            blended = sj.accumulate(made.radiance, previous, made, params=params, config=config)
            history = history._replace(
                illumination=blended.illumination, moments=blended.moments, history_length=blended.history_length,
                depth=made.depth, normal=made.normal, object_id=made.object_id,
            )  # fmt: skip
            first, second = blended.moments[..., 0], blended.moments[..., 1]
            return history, jnp.maximum(second - first * first, 0)

        def go(histories, key_and_ratio):
            frames = [frame(*key_and_ratio, dtype) for dtype in (jnp.float32, jnp.float64)]
            pairs = [variance(history, made) for history, made in zip(histories, frames, strict=True)]
            (small, low), (large, high) = pairs
            return (small, large), jnp.median(jnp.abs(low.astype(jnp.float64) - high) / high)

        @jax.jit
        def run(ratio):
            keys = jax.random.split(jax.random.key(0), options.endless)
            first = tuple(sj.init(frame(keys[0], ratio, dtype)) for dtype in (jnp.float32, jnp.float64))
            return jax.lax.scan(lambda h, key: go(h, (key, ratio)), first, keys)[1]

        return run

    lines = [
        "| mean^2 / variance | alpha_moments .2: frame 100 | last frame | 0, all frames alike: frame 100 | last frame |"
    ]
    lines.append("|---|---|---|---|---|")
    runs = (both(0.2, 32.0), both(0.0, 1e9))
    for ratio in (1.0, 1e2, 1e4, 1e6):
        errors = [np.asarray(run(jnp.float64(ratio))) for run in runs]
        cells = [f"{value:.1e}" for error in errors for value in (np.median(error[50:150]), np.median(error[-100:]))]
        lines.append(f"| {ratio:.0e} | {' | '.join(cells)} |")

    single = jax.tree.map(lambda a: a.astype(jnp.float32) if a.dtype == jnp.float64 else a, still)
    params, config = sj.Params(alpha=0.0, alpha_moments=0.0, max_history=1e9), sj.Config()

    @jax.jit
    def forever(key):
        def go(history, key):
            noisy = single._replace(radiance=jax.random.exponential(key, single.radiance.shape, jnp.float32) ** 4)
            history, output = sj.step(history, noisy, params=params, config=config)
            finite = [jnp.isfinite(leaf).all() for leaf in jax.tree.leaves((history, output))]
            return history, (jnp.stack(finite).all(), output.image.mean())

        return jax.lax.scan(go, sj.init(single), jax.random.split(key, options.endless))

    history, (finite, mean) = forever(jax.random.key(1))
    told = "all finite" if np.asarray(finite).all() else "NOT FINITE"
    lines += [
        "",
        f"alpha = alpha_moments = 0, max_history = 1e9, {options.endless} frames of noise of mean 24 with a long tail: {told}, "
        f"history length at the end {float(history.history_length.min()):.0f}, mean of the picture {float(mean[-1]):.3f}.",
    ]
    return lines


def bench_same(folder: Path, options: argparse.Namespace) -> list[str]:
    """Run after run in one process each, with the real filter."""
    from struck_runs import FRAMES, write_shot

    shot = write_shot(folder / "shot")
    runs = [{"again": i} for i in range(3)] + [{"threads": n} for n in (1, 2, 3, 4)]
    runs += [{"checkpoint_every": n} for n in (1, 5, 24)] + [{"devices": 2}]
    images = {}
    for k, chosen in enumerate(runs):
        given = {"preset": "adaptive", **{name: value for name, value in chosen.items() if name != "again"}}
        code = (
            "import svgf_jax as sj; from svgf_jax import streaming; from svgf_jax.outputs import WriteOptions\n"
            f"params, config = sj.preset('adaptive'); streaming.run(sj.open_source({str(shot)!r}), {str(folder / str(k))!r},"
            f" params=params, config=config, options=WriteOptions(full_float=True, diagnostics=True), **{given})"
        )
        subprocess.run([sys.executable, "-c", code], check=True)
        images[k] = [exr.read(path) for path in sorted((folder / str(k)).glob("*.exr"))]
    lines = [
        f"| {FRAMES} frames, `adaptive`, 32-bit | the first run's bits | else largest difference of a pixel |",
        "|---|---|---|",
    ]
    for k, chosen in enumerate(runs[1:], 1):
        same = all(
            (folder / str(k) / path.name).read_bytes() == path.read_bytes() for path in (folder / "0").glob("*.exr")
        )
        pairs = zip(images[k], images[0], strict=True)
        largest = max(
            float((np.abs(a.channels[c] - b.channels[c]) / (np.abs(b.channels[c]) + 1e-3 * b.channels[c].max())).max())
            for a, b in pairs
            for c in "RGB"
        )
        name = ", ".join(f"{key} {value}" for key, value in chosen.items())
        lines.append(f"| {name} | {'yes' if same else 'no'} | {'' if same else f'{largest:.1e}'} |")
    return lines


def bench_restarts(folder: Path, options: argparse.Namespace) -> list[str]:
    import random

    from struck_runs import FRAMES, prepare, stopped_until_done

    place = prepare(folder, random.Random(options.seed))
    ends = time.monotonic() + 60 * options.minutes
    began, runs, stops = time.monotonic(), 0, {"SIGINT": 0, "SIGTERM": 0, "SIGKILL": 0}
    while time.monotonic() < ends:
        enough = lambda: time.monotonic() > ends  # noqa: E731
        counts = stopped_until_done(place, folder / f"restarted-{runs}", list(stops), enough)
        stops = {name: count + counts[name] for name, count in stops.items()}
        runs += 1
        print(f"{runs} runs, {stops}", file=sys.stderr, flush=True)
    minutes = (time.monotonic() - began) / 60
    told = ", ".join(f"{count} {name}" for name, count in stops.items())
    return [
        f"{minutes:.0f} minutes, {runs} runs of {FRAMES} frames, {told}: every run ended with the bytes of the undisturbed one."
    ]


KEPT = ("VmRSS", "Threads")
BENCHES = {
    "memory": bench_memory,
    "overlap": bench_overlap,
    "start": bench_start,
    "endless": bench_endless,
    "drift": bench_drift,
    "same": bench_same,
    "restarts": bench_restarts,
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("benches", nargs="*", choices=[[], *BENCHES], default=[])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--long", type=int, default=1000, help="frames of the long run")
    parser.add_argument("--endless", type=int, default=10_000, help="frames of the run without end")
    parser.add_argument("--minutes", type=float, default=60, help="of restarts")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for name in options.benches or BENCHES:
        with tempfile.TemporaryDirectory() as folder:
            print("\n".join(BENCHES[name](Path(folder), options)), "\n", flush=True)


if __name__ == "__main__":
    sys.exit(main())
