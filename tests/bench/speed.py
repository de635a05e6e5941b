"""How fast the filter is, beside what the machine could do: every figure a ratio from one run in which all take turns.

    python tests/bench/speed.py [atrous] [step] [stages] [sizes] [--rounds 5] [--size 1920x1080]

atrous: the a-trous stage beside the same arithmetic by hand (atrous_yardstick.cpp; needs g++), whose result it must equal.
step: a whole frame, with presets `paper` and `adaptive`, beside Intel Open Image Denoise's fast mode for one image (needs pyoidn).
stages: each stage by itself: time, bytes that must be moved at least, operations, and how near these come to the copies and (with
g++) the multiply-adds that the machine is measured to do; an exponential, logarithm, power or root counts as 20 operations.
sizes: a whole frame per pixel, from 480x270 to 3840x2160, and the seconds until the first frame is there.

Without names all of them. Times are medians; "processor" counts the seconds of all cores, which other work on the machine disturbs
least. Prints Markdown tables; adds them to tests/bench/speed.json.
"""

import argparse
import ctypes
import functools
import json
import platform
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxprs_in_params

import svgf_jax as sj
from svgf_jax import accumulation, adaptation, antialiasing, atrous, color, modulation, reprojection, variance
from svgf_jax.compiled import compiler_options
from svgf_jax.edges import depth_gradient
from svgf_jax.types import Config, Frame, Params

RESULTS = Path(__file__).with_suffix(".json")
SOURCE = Path(__file__).with_name("atrous_yardstick.cpp")
BUILD = ["g++", "-O3", "-march=native", "-ffast-math", "-fopenmp", "-mprefer-vector-width=512", "-shared", "-fPIC"]


def some_frame(height: int, width: int, signals: int = 2) -> Frame:
    """Walls with rough normals, a background, noise; everything moves by a third of a pixel."""
    rng = np.random.default_rng(0)
    noise = lambda *shape: rng.random(shape, np.float32)  # noqa: E731
    normal = rng.normal(size=(height, width, 3)).astype(np.float32) * 0.1 + np.array([0, 0, 1], np.float32)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    y, x = np.mgrid[0:height, 0:width]
    depth = (5 + 0.001 * x + 0.002 * y).astype(np.float32)
    frame = Frame(
        radiance=noise(signals, height, width, 3),
        emission=np.zeros((height, width, 3), np.float32),
        albedo=0.2 + noise(1, height, width, 3),
        normal=normal,
        depth=depth,
        prev_depth=depth,
        motion=np.full((height, width, 2), 0.3, np.float32),
        object_id=np.where(x % 200 < 5, -1, x // 200).astype(np.int32),
    )
    return jax.tree.map(jnp.asarray, frame)


def processor() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def take_turns(runs: dict, rounds: int) -> dict[str, tuple[float, float]]:
    """Median (wall, processor) seconds of each; the first round does not count."""
    times = {name: [] for name in runs}
    for _ in range(rounds + 1):
        for name, run in runs.items():
            wall, used = time.monotonic(), processor()
            run()
            times[name].append((time.monotonic() - wall, processor() - used))
    return {name: tuple(np.median(spent[1:], axis=0).tolist()) for name, spent in times.items()}


def as_runs_do() -> dict:
    return compiler_options(jax.devices()[0].platform)


def compiled(function, *args):
    """The function for these arguments, to be called without any, and what compiling it took of the processor."""
    began = processor()
    program = jax.jit(function, compiler_options=as_runs_do()).lower(*args).compile()
    return (lambda: jax.block_until_ready(program(*args))), processor() - began


def numbers(params: Params) -> Params:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), params)


def by_hand() -> ctypes.CDLL | None:
    """The C++, compiled; None without g++."""
    if shutil.which(BUILD[0]) is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([*BUILD, str(SOURCE), "-o", f"{folder}/yardstick.so"], check=True)
        return ctypes.CDLL(f"{folder}/yardstick.so")


def most_operations() -> float | None:
    """Operations a second, two for each multiply-add, on all cores; None without g++."""
    library = by_hand()
    if library is None:
        return None
    library.multiply_adds.restype, library.multiply_adds.argtypes = ctypes.c_double, [ctypes.c_long]
    seconds, turns = [], 10_000_000
    for _ in range(6):
        began = time.monotonic()
        done = library.multiply_adds(turns)
        seconds.append(time.monotonic() - began)
    return 2 * done / float(np.median(seconds[1:]))


COSTS = {"add": 1, "sub": 1, "mul": 1, "div": 1, "max": 1, "min": 1, "abs": 1, "neg": 1, "floor": 1, "integer_pow": 1}
COSTS |= {"select_n": 1, "clamp": 1, "lt": 1, "le": 1, "gt": 1, "ge": 1, "eq": 1, "ne": 1, "and": 1, "or": 1}
COSTS |= dict.fromkeys(("exp", "log", "log1p", "pow", "sqrt", "rsqrt", "cbrt"), 20)


def operations(jaxpr, of_branches) -> int:
    """Of a jaxpr, loops and all; `of_branches` chooses among those of a `lax.cond` (min, max)."""
    total = 0
    for equation in jaxpr.eqns:
        inner = [operations(one, of_branches) for one in jaxprs_in_params(equation.params)]
        if equation.primitive.name == "cond":
            total += of_branches(inner)
        elif inner:
            total += equation.params.get("length", 1) * sum(inner)
        else:
            total += COSTS.get(equation.primitive.name, 0) * equation.outvars[0].aval.size
    return total


def yardstick(library: ctypes.CDLL, light, spread, frame: Frame, params: Params, config: Config):
    """A function that filters by hand and returns (seconds, seconds of the processor, results)."""
    slopes = depth_gradient(frame.depth, frame.object_id)
    names = [
        "sigma_luminance",
        "sigma_normal",
        "sigma_depth",
        "depth_epsilon",
        "luminance_epsilon",
        "kernel_near",
        "kernel_far",
    ]
    sigma = np.array([getattr(params, name) for name in names], np.float32)
    guides = [np.ascontiguousarray(a) for a in (frame.depth, frame.normal, frame.object_id, *slopes)]
    signals, height, width, _ = light.shape

    def run():
        colors, variances = np.array(light), np.array(spread)
        fed_back = np.empty_like(colors)
        arrays = [a.ctypes.data_as(ctypes.c_void_p) for a in (sigma, colors, variances, *guides, fed_back)]
        wall, used = time.monotonic(), processor()
        library.atrous(signals, height, width, config.levels, config.feedback_level, *arrays)
        return time.monotonic() - wall, processor() - used, (colors, variances, fed_back)

    return run


def bench_atrous(height: int, width: int, rounds: int) -> list[str]:
    params, config = sj.preset("paper")
    lines = [
        "| a-trous, five levels | library / by hand, wall | processor | largest difference | compile, s |",
        "|---|---|---|---|---|",
    ]
    made = by_hand()
    if made is None:
        return ["No g++ here: nothing to compare the a-trous stage with."]
    for signals in (1, 2):
        frame = some_frame(height, width, signals)
        spread = 0.1 * frame.radiance[..., 0]
        filter_by_hand = yardstick(made, frame.radiance, spread, frame, params, config)
        library, compile_s = compiled(
            lambda *a: atrous.atrous_filter(*a[:3], params=a[3], config=config),
            *(frame.radiance, spread, frame, numbers(params)),
        )
        # The two agree but where a threshold (no weight at all) falls between their roundings: a pixel in ten thousand.
        off = [np.abs(np.asarray(a) - b).ravel() for a, b in zip(library(), filter_by_hand()[2], strict=True)]
        worst = max(float(np.quantile(error, 0.9999)) for error in off)
        if worst > 1e-4:
            raise SystemExit(f"The yardstick computes something else: {worst}")
        spent = {"library": [], "by hand": []}
        for _ in range(rounds):
            spent["by hand"].append(filter_by_hand()[:2])
            wall, used = time.monotonic(), processor()
            library()
            spent["library"].append((time.monotonic() - wall, processor() - used))
        wall, used = np.median(spent["library"], axis=0) / np.median(spent["by hand"], axis=0)
        size = f"{width}x{height}, {signals} signal{'s' * (signals > 1)}"
        lines.append(f"| {size} | {wall:.2f} | {used:.2f} | {worst:.0e} | {compile_s:.1f} |")
    return lines


def steady(preset: str, height: int, width: int):
    """A step whose history is long everywhere, as runs do it: each takes the memory of the history before it.

    To be called without arguments; and the seconds of its compilation.
    """
    params, config = sj.preset(preset)
    frame, leaves = some_frame(height, width), numbers(params)
    go = lambda history, frame, leaves: sj.step(history, frame, params=leaves, config=config)  # noqa: E731
    history = sj.init(frame, config=config)
    began = processor()
    program = jax.jit(go, donate_argnums=0, compiler_options=as_runs_do()).lower(history, frame, leaves).compile()
    compile_s = processor() - began

    def run() -> None:
        nonlocal history
        history, _ = jax.block_until_ready(program(history, frame, leaves))

    for _ in range(5):
        run()
    return run, compile_s


def oidn_fast(height: int, width: int):
    """One image by Open Image Denoise's own benchmark, fast mode: seconds a frame (it discards the first). None without pyoidn."""
    try:
        import pyoidn
    except ImportError:
        return None
    folder = Path(pyoidn.__file__).parent / "oidn"
    command = [
        str(folder / "bin" / "oidnBenchmark"),
        "-r",
        f"RT.hdr_alb_nrm.{width}x{height}",
        "-q",
        "fast",
        "-d",
        "cpu",
        "-n",
        "2",
    ]

    def run() -> float:
        ran = subprocess.run(
            command, capture_output=True, text=True, env={"LD_LIBRARY_PATH": str(folder / "lib")}, check=True
        )
        return float(re.search(r"([\d.]+) msec/image", ran.stdout)[1]) / 1e3

    return run


def bench_step(height: int, width: int, rounds: int) -> list[str]:
    runs = {name: steady(name, height, width) for name in ("paper", "adaptive")}
    oidn = oidn_fast(height, width)
    times = {name: [] for name in (*runs, "oidn")}
    for _ in range(rounds):
        for name, (run, _) in runs.items():
            wall, used = time.monotonic(), processor()
            run()
            times[name].append((time.monotonic() - wall, processor() - used))
        if oidn is not None:
            times["oidn"].append((oidn(), 0.0))
    median = {name: np.median(spent, axis=0) for name, spent in times.items() if spent}
    lines = [
        "| whole step, two signals | / OIDN fast, wall | / `paper`, wall | / `paper`, processor | processor, s | compile, s |",
        "|---|---|---|---|---|---|",
    ]
    for name, (_, compile_s) in runs.items():
        wall, used = median[name]
        beside = f"{wall / median['oidn'][0]:.2f}" if "oidn" in median else "no pyoidn here"
        ratios = median[name] / median["paper"]
        lines.append(
            f"| {width}x{height}, `{name}` | {beside} | {ratios[0]:.2f} | {ratios[1]:.2f} | {used:.2f} | {compile_s:.1f} |"
        )
    return lines


def bench_stages(height: int, width: int, rounds: int) -> list[str]:
    params, config = sj.preset("paper")
    adaptive, follows = sj.preset("adaptive")
    frame, leaves, numbers_of_light = some_frame(height, width), numbers(params), numbers(adaptive)
    history = sj.init(frame, config=config)
    for _ in range(5):
        history, _ = sj.step(history, frame, params=leaves, config=config)
    light = color.demodulate(frame.radiance, frame.albedo, albedo_floor=jnp.float32(0.01))
    previous = reprojection.reproject(history, frame, params=leaves, config=config)
    now = accumulation.accumulate(light, previous, frame, params=leaves, config=config)
    spread = variance.estimate_variance(now.moments, now.history_length, frame, params=leaves, config=config)
    young = jnp.ones_like(now.history_length)
    stages = {
        "demodulate": (
            lambda r, a: color.demodulate(r, a, albedo_floor=jnp.float32(0.01)),
            (frame.radiance, frame.albedo),
        ),
        "reproject": (functools.partial(reprojection.reproject, params=leaves, config=config), (history, frame)),
        "follow_light (`adaptive`)": (
            functools.partial(adaptation.follow_light, params=numbers_of_light, config=follows),
            (previous, light, frame),
        ),
        "accumulate": (
            functools.partial(accumulation.accumulate, params=leaves, config=config),
            (light, previous, frame),
        ),
        "estimate_variance, long history": (
            functools.partial(variance.estimate_variance, params=leaves, config=config),
            (now.moments, now.history_length, frame),
        ),
        "estimate_variance, 7 x 7 everywhere": (
            functools.partial(variance.estimate_variance, params=leaves, config=config),
            (now.moments, young, frame),
        ),
        "atrous_filter, five levels": (
            functools.partial(atrous.atrous_filter, params=leaves, config=config),
            (now.illumination, spread, frame),
        ),
        "modulate": (
            functools.partial(modulation.modulate, albedo_floor=jnp.float32(0.01)),
            (now.illumination, frame),
        ),
        "taa (by choice)": (
            functools.partial(antialiasing.taa, params=leaves),
            (antialiasing.taa_init(frame.emission), frame.albedo[0], frame.motion, frame.depth),
        ),
    }
    runs, least, work = {}, {}, {}
    for name, (function, args) in stages.items():
        work[name] = operations(jax.make_jaxpr(function)(*args).jaxpr, max if "7 x 7" in name else min)
        runs[name], _ = compiled(function, *args)
        size = lambda tree: sum(leaf.nbytes for leaf in jax.tree.leaves(tree))  # noqa: E731
        least[name] = size(args) + size(runs[name]())
    big = jnp.ones(2**26, jnp.float32)
    runs["copy"], _ = compiled(lambda a: a + jnp.float32(1), big)
    spent = take_turns(runs, rounds)
    beside = ("follow_light", "estimate_variance, 7 x 7", "taa")  # not in a step of `paper`
    whole = sum(wall for name, (wall, _) in spent.items() if name in stages and not name.startswith(beside))
    bandwidth, peak = 2 * big.nbytes / spent.pop("copy")[0], most_operations()
    titles = (
        "stage",
        "share of a step",
        "processor, s",
        "least MB moved",
        "of copy bandwidth",
        "10^9 operations",
        "of their peak",
    )
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for name, (wall, used) in spent.items():
        moved, done = (
            f"{least[name] / wall / bandwidth:.0%}",
            "?" if peak is None else f"{work[name] / wall / peak:.0%}",
        )
        lines.append(
            f"| {name} | {wall / whole:.0%} | {used:.2f} | {least[name] / 1e6:.0f} | {moved} | {work[name] / 1e9:.2f} | {done} |"
        )
    known = "" if peak is None else f" Multiply-adds: {peak / 1e9:.0f} billion operations a second."
    return [*lines, "", f"Copy bandwidth: {bandwidth / 1e9:.1f} GB/s.{known}"]


def bench_sizes(height: int, width: int, rounds: int) -> list[str]:
    sizes = [(270, 480), (540, 960), (1080, 1920), (2160, 3840)]
    runs = {size: steady("paper", *size) for size in sizes}
    # As many pixels in a turn, as far as that goes: a small frame alone would find the caches full of the large one before.
    frames = {size: max(1, round(1080 * 1920 / (size[0] * size[1]))) for size in sizes}
    spent = take_turns(
        {size: lambda size=size: [runs[size][0]() for _ in range(frames[size])] for size in sizes}, rounds
    )
    each = {size: np.array(spent[size]) / (frames[size] * size[0] * size[1]) for size in sizes}
    lines = ["| size | seconds a pixel / those at 1920x1080, wall | processor | compile, s |", "|---|---|---|---|"]
    for size in sizes:
        wall, used = each[size] / each[1080, 1920]
        lines.append(f"| {size[1]}x{size[0]} | {wall:.2f} | {used:.2f} | {runs[size][1]:.1f} |")
    return lines


BENCHES = {"atrous": bench_atrous, "step": bench_step, "stages": bench_stages, "sizes": bench_sizes}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("benches", nargs="*", choices=[[], *BENCHES], default=[])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--size", default="1920x1080")
    options = parser.parse_args()
    width, height = (int(n) for n in options.size.split("x"))
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for name in options.benches or BENCHES:
        lines = BENCHES[name](height, width, options.rounds)
        print("\n".join(lines), "\n", flush=True)
        results[name] = {
            "table": lines,
            "date": time.strftime("%Y-%m-%d"),
            "machine": f"{platform.machine()}, {len(jax.devices())} {jax.devices()[0].device_kind} device(s)",
            "versions": f"Python {platform.python_version()}, JAX {jax.__version__}",
        }
        RESULTS.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(main())
