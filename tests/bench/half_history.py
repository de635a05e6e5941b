"""What a history of 16-bit floats would save and cost: the arithmetic stays 32-bit, only what goes from frame to frame is rounded.

    python tests/bench/half_history.py quality [FOLDER ...]    (sequences with references; else the three of shared/data)
    python tests/bench/half_history.py time [--size 1920x1080]

Rounded are illumination, moments, normal and history length; depth stays, because a plane's tolerance is finer than 16 bits. Prints
Markdown tables.
"""

import argparse
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from speed import numbers, processor, some_frame

import svgf_jax as svgf
from svgf_jax.compiled import compiler_options
from svgf_jax.metrics import mean_scores, score_frames

DATA = Path(__file__).parents[3] / "shared" / "data"
TYPES = {"float32": jnp.float32, "float16": jnp.float16, "bfloat16": jnp.bfloat16}
ROUNDED = ("illumination", "moments", "normal", "history_length")


def cast(history: svgf.History, dtype) -> svgf.History:
    """float16 ends at 65504: brighter light would be infinite there."""
    largest = float(jnp.finfo(dtype).max)
    fit = lambda a: jnp.clip(a, -largest, largest).astype(dtype)  # noqa: E731
    return history._replace(**{name: fit(getattr(history, name)) for name in ROUNDED})


@partial(jax.jit, static_argnames=("config", "dtype"), donate_argnums=0)
def step(history, frame, params, *, config, dtype):
    history = history._replace(**{name: getattr(history, name).astype(jnp.float32) for name in ROUNDED})
    history, output = svgf.step(history, frame, params=params, config=config)
    return cast(history, dtype), output.image


def quality(folders: list[Path]) -> None:
    print("| sequence | preset | " + " | ".join(TYPES) + " |\n|---|---|" + "---|" * len(TYPES))
    for folder in folders:
        frames, reference = svgf.load_sequence(folder), svgf.load_reference(folder)
        for name in ("paper", "adaptive"):
            params, config = svgf.preset(name)
            cells = []
            for dtype in TYPES.values():
                at = lambda i: jax.tree.map(lambda a: a[i], frames)  # noqa: B023, E731
                history, images = cast(svgf.init(at(0), config=config), dtype), []
                for i in range(len(reference)):
                    history, image = step(history, at(i), numbers(params), config=config, dtype=dtype)
                    images.append(np.asarray(image))
                scores = mean_scores(list(score_frames(zip(images, reference, strict=True))))
                cells.append(f"{scores.psnr:.2f} dB, {scores.temporal:.4f}")
            print(f"| {folder.name} | `{name}` | {' | '.join(cells)} |", flush=True)


def time(height: int, width: int, rounds: int) -> None:
    params, config = svgf.preset("paper")
    frame, runs, sizes = some_frame(height, width), {}, {}
    for name, dtype in TYPES.items():
        history = cast(svgf.init(frame, config=config), dtype)
        sizes[name] = sum(a.nbytes for a in jax.tree.leaves(history))
        go = partial(step.__wrapped__, config=config, dtype=dtype)
        program = jax.jit(go, donate_argnums=0, compiler_options=compiler_options(jax.devices()[0].platform))
        runs[name] = program.lower(history, frame, numbers(params)).compile(), history
    spent = {name: [] for name in runs}
    for _ in range(rounds + 1):
        for name, (program, history) in runs.items():
            began = processor()
            history, _ = jax.block_until_ready(program(history, frame, numbers(params)))
            runs[name] = program, history
            spent[name].append(processor() - began)
    usual = np.median(spent["float32"][1:])
    print("| history | MB | step, processor time |\n|---|---|---|")
    for name, seconds in spent.items():
        print(f"| {name} | {sizes[name] / 1e6:.0f} | {np.median(seconds[1:]) / usual:.2f} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["quality", "time"])
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    if options.what == "quality":
        quality(options.folders or [DATA / name for name in ("cornell-dolly", "gallery-pan", "lights-flicker")])
    else:
        time(*map(int, reversed(options.size.split("x"))), options.rounds)
