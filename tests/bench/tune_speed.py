"""How long a fit takes: a trial point against a plain run of the filter, and a whole fit; and what memory it needs.

    python tests/bench/tune_speed.py [--frames 8] [--trial] [--peak] [--fit]      adds to tests/bench/tune_speed.json

A trial point with n parameters should cost at most 2 + n plain runs; 8 scalars on 8 frames of 480 x 270, S = 2, should be fitted
within 10 minutes on two cores; the peak memory of 8 and of 64 frames should differ by less than 10 %.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import tune
from svgf_jax import preset
from tune.evaluate import filtered
from tune.free import choose, to_free
from tune.residuals import REFERENCE
from tune.shots import window
from tune.sweep import pose, sweep

DATA = Path(__file__).parents[3] / "shared" / "data" / "cornell-dolly"
RESULTS = Path(__file__).with_suffix(".json")


def timed(*runs, rounds: int = 3) -> list[float]:
    """Median seconds of each of `runs`, taken in turns."""
    seconds = [[] for _ in runs]
    for _ in range(rounds):
        for run, spent in zip(runs, seconds, strict=True):
            began = time.monotonic()
            run()
            spent.append(time.monotonic() - began)
    return [float(np.median(spent)) for spent in seconds]


def looped(shot: tune.Shot, length: int) -> tune.Shot:
    """A shot of any length out of a short one, back and forth."""
    order = [*range(shot.length), *range(shot.length - 1, -1, -1)]
    return shot._replace(length=length, read=lambda i: shot.read(order[i % len(order)]))


def trial_point(frames: int) -> dict:
    """A pass with derivatives against one without, and against nothing but the filter."""
    shot = tune.shot_of_files(str(DATA), str(DATA), frames=f"0-{frames - 1}")
    params, config = preset("paper")
    results = {}
    filter_only = lambda: [None for _ in filtered(shot, params, config)]  # noqa: E731
    filter_only()
    for n in (1, 8):
        names = (
            "alpha",
            "sigma_luminance",
            "sigma_normal",
            "sigma_depth",
            "alpha_moments",
            "kernel_near",
            "kernel_far",
            "depth_epsilon",
        )
        coordinates = choose(params, config, names=names[:n])
        y = to_free(coordinates.start, coordinates)
        posed = pose(coordinates, y, REFERENCE, [shot])
        sweep(posed, y, linear=True)
        passes = (lambda d=d, p=posed, y=y: sweep(p, y, linear=d) for d in (False, True))
        bare, plain, linear = timed(filter_only, *passes)
        results[n] = {
            "filter_s": bare,
            "loss_only_s": plain,
            "trial_point_s": linear,
            "ratio": linear / bare,
            "allowed": 2 + n,
        }
        print(n, results[n], flush=True)
    return results


def peak_memory(frames: int) -> float:
    """Peak resident memory, MB, of one pass over so many frames, in a process of its own."""
    code = f"import sys; sys.argv = ['x', '--memory', '{frames}']; import runpy; runpy.run_path({__file__!r}, run_name='__main__')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=os.environ)
    return float(done.stdout.split()[-1])


def memory(frames: int) -> None:
    shot = looped(tune.shot_of_files(str(DATA), str(DATA), frames="0-7"), frames)
    small = window(shot, rows=slice(0, 135), columns=slice(0, 240))
    params, config = preset("paper")
    coordinates = choose(params, config._replace(levels=3), names=("alpha", "sigma_luminance"))
    y = to_free(coordinates.start, coordinates)
    posed = pose(coordinates, y, REFERENCE, [small])
    sweep(posed, y, linear=True)
    # Not ru_maxrss, which a child inherits from its parent.
    status = Path("/proc/self/status").read_text()
    print(int(re.search(r"VmHWM:\s+(\d+)", status)[1]) / 1024)  # pyright: ignore[reportOptionalSubscript]


def whole_fit(frames: int) -> dict:
    shot = tune.shot_of_files(str(DATA), str(DATA), frames=f"0-{frames - 1}")
    began = time.monotonic()
    fit = tune.fit(
        *preset("paper"), [shot], on_iteration=lambda i: print(i.number, i.loss, time.monotonic() - began, flush=True)
    )
    return {"seconds": time.monotonic() - began, "trials": len(fit.iterations), "result": fit.result, "loss": fit.loss}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--trial", action="store_true")
    parser.add_argument("--peak", action="store_true")
    parser.add_argument("--memory", type=int)
    given = parser.parse_args()
    if given.memory:
        memory(given.memory)
        return
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    if given.fit:
        results["fit"] = whole_fit(given.frames)
    if given.trial:
        results["load"] = os.getloadavg()
        results["trial_point"] = trial_point(given.frames)
    if given.peak:
        peaks = [{n: peak_memory(n) for n in (8, 64)} for _ in range(5)]  # one alone is off by a tenth, either way
        results["peak_MB"] = {str(n): float(np.median([peak[n] for peak in peaks])) for n in (8, 64)}
        results["peak_grows_by"] = results["peak_MB"]["64"] / results["peak_MB"]["8"] - 1
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
