"""Kill `svgf-tune` at random moments and resume it: is the result that of the undisturbed fit, to the bit?

    python tests/bench/tuner_faults.py --kills 20 --seed 1

Fits three numbers to six frames of a crop of the bundled sample. Each round starts the command anew and kills it (SIGKILL) again
and again, on average a few times before it comes to its end; after each kill no other file than the checkpoint may be there, whole.
Prints how many kills there were, how many runs they made, and whether each parameter file is that of the undisturbed run.
"""

import argparse
import difflib
import os
import random
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from svgf_jax import exr
from svgf_jax.demo import sample

WHAT = ["--tune", "alpha,sigma_luminance,max_history", "--set", "levels=1", "--frames", "0-5", "--max-steps", "5"]


def numbers(path: Path) -> str:
    """The parameter file without its time and its scores, which are measured after the fit."""
    return (
        re.sub(r"(?m)^written = .*$", "", path.read_text(encoding="utf-8")).partition("[provenance.scores")[0].strip()
    )


def crop(folder: Path) -> Path:
    folder.mkdir()
    for path in sorted(sample().glob("*.exr")):
        channels = {n: np.ascontiguousarray(p[20:56, 30:78]) for n, p in exr.read(path).channels.items()}
        exr.write(folder / path.name, exr.new_image(channels))
    return folder


def start(shots: Path, out: Path, *more: str) -> subprocess.Popen:
    call = [sys.executable, "-m", "tune", shots, "--reference", shots, "-o", out, *WHAT, *more]
    quick = os.environ | {"XLA_FLAGS": "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"}
    return subprocess.Popen(list(map(str, call)), stderr=subprocess.PIPE, text=True, env=quick)


def main(kills: int, seed: int) -> None:
    draw, killed, rounds, resumed = random.Random(seed), 0, 0, 0
    with tempfile.TemporaryDirectory() as folder:
        shots = crop(Path(folder) / "shots")
        began = time.monotonic()
        whole = Path(folder) / "whole.toml"
        process = start(shots, whole)
        process.communicate()
        assert process.returncode == 0
        took = time.monotonic() - began
        print(f"undisturbed: {took:.0f} s", flush=True)
        while killed < kills:
            rounds += 1
            out = Path(folder) / f"round{rounds}" / "tuned.toml"
            out.parent.mkdir()
            checkpoint = out.with_name(f".{out.name}.progress.npz")
            while True:
                again = ["--resume"] if checkpoint.exists() else []
                resumed += bool(again)
                process = start(shots, out, *again)
                try:
                    _, said = process.communicate(timeout=draw.uniform(0.2, 1.1) * took if killed < kills else None)
                    assert process.returncode == 0, said
                    break
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.communicate()
                    killed += 1
                others = [path.name for path in out.parent.iterdir() if path not in (out, checkpoint)]
                assert all(name.startswith(".") for name in others), others
                if out.exists():
                    break  # killed while it measured: the parameters are there
            difference = "\n".join(
                difflib.unified_diff(numbers(whole).splitlines(), numbers(out).splitlines(), "whole", "resumed")
            )
            assert not difference, difference
            print(f"{killed} kills, {resumed} resumed, {rounds} fits, all as undisturbed", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    main(**vars(parser.parse_args()))
