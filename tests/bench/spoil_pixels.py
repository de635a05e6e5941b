"""Sequences with anything wrong in them, through the filter: finite, within bounds, counted, with finite gradients.

    python tests/bench/spoil_pixels.py                       # 12 000 sequences of five frames, a quarter for each preset
    python tests/bench/spoil_pixels.py --cases 50000 --seed 9
    python tests/bench/spoil_pixels.py --what derivatives variance --presets adaptive      # "variance": frames that bring it
    python tests/bench/spoil_pixels.py --recovery            # after four bad frames: how many until the picture is right again

hypothesis draws from tests/bad_pixels.py (16 x 12 pixels, two signals, float32): up to six faults, each of one channel, some
pixels and some frames: not finite, negative, fireflies of 1e30, denormals, zero and long normals, motion of 1e6, depths of any
kind, ids that change, exposure times 1e6, black, constant, shuffled. A case that fails is made as small as it gets and shown.
Others go through the gradient with respect to all parameters and all radiance. Needs hypothesis.
"""

import argparse
import sys
import time
from functools import partial
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1])]
import bad_pixels  # noqa: E402
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import scenes  # noqa: E402
from bridge import jitted_step, to_frame  # noqa: E402
from compiling import QUICK  # noqa: E402
from hypothesis import HealthCheck, Phase, given, settings  # noqa: E402
from hypothesis import seed as seeded  # noqa: E402

from svgf_jax.parameters import PRESETS  # noqa: E402
from svgf_jax.pipeline import denoise, init  # noqa: E402
from svgf_jax.types import Frame, Params  # noqa: E402

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

KINDS = {
    "NaN in a pixel": ("radiance", (0, 5, 5), np.nan),
    "firefly of 100": ("radiance", (0, 5, 5), 100.0),
    "firefly of 1e6": ("radiance", (0, 5, 5), 1e6),
    "firefly of 1e30": ("radiance", (0, 5, 5), 1e30),
    "black": ("radiance", ..., 0.0),
    "exposure times 1e6": ("radiance", ..., 1e6),
    "motion NaN": ("motion", ..., np.nan),
    "motion of 1e6": ("motion", ..., 1e6),
    "depth NaN": ("depth", ..., np.nan),
    "normals of zeros": ("normal", ..., 0.0),
    "another object": ("object_id", ..., 77),
    "all background": ("object_id", ..., -1),
}


def hold(property_of, count: int, seed: int) -> None:
    """Let hypothesis try so many cases; raises what it found."""

    @seeded(seed)
    @settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
        print_blob=False,
    )
    @given(bad_pixels.cases)
    def holds(case):
        property_of(case)

    holds()


def forward(preset: str, count: int, seed: int, *, variance: bool) -> str:
    """The filter over so many sequences: how many, and the largest share of the bound."""
    params, config = ready(preset)
    run = jax.jit(partial(denoise, config=config), compiler_options=dict(QUICK))
    shares = []

    def check(case):
        frames = bad_pixels.build(case, variance=variance)
        _, output = jax.tree.map(np.asarray, run(frames, params=params))
        growth = bad_pixels.GROWTH if config.light_cell else 1.0
        shares.append(bad_pixels.check(frames, output, growth=growth))

    hold(check, count, seed)
    return f"{len(shares)} sequences, at most {max(shares):.3g} of the bound"


def backward(preset: str, count: int, seed: int) -> str:
    """The gradient of the tone-mapped mean with respect to all parameters and all radiance."""
    params, config = ready(preset)

    def loss(params, radiance, frames):
        _, output = denoise(frames._replace(radiance=radiance), params=params, config=config)
        return jnp.mean(output.image / (1.0 + jnp.abs(output.image)))

    gradient = jax.jit(jax.grad(loss, argnums=(0, 1)), compiler_options=dict(QUICK))
    done = []

    def check(case):
        frames = bad_pixels.build(case)
        by_params, by_radiance = gradient(params, frames.radiance, frames)
        wrong = [name for name, leaf in by_params._asdict().items() if not np.isfinite(leaf).all()]
        assert not wrong, wrong
        assert np.isfinite(by_radiance).all(), "radiance"
        done.append(case)

    hold(check, count, seed)
    return f"{len(done)} gradients"


def recovery(preset: str, kind: str) -> int | None:
    """Frames after four bad ones until a wall of light 1 is within 5 % everywhere; None = not in 150."""
    params, config = ready(preset)
    step = jitted_step(config, QUICK)
    wall = to_frame(scenes.flat(*bad_pixels.SIZE, signals=2), np.float32)
    good = {name: values for name, values in wall._asdict().items() if values is not None}
    channel, where, value = KINDS[kind]
    bad = {name: a.copy() for name, a in good.items()}
    bad[channel][where] = value
    history = init(Frame(**good), config=config)
    for t in range(10 + 150):
        history, output = step(history, Frame(**(bad if 6 <= t < 10 else good)), params=params)
        if t >= 10 and np.abs(np.asarray(output.image) - 2.0).max() <= 0.1:
            return t - 9
    return None


def ready(preset: str):
    params, config = PRESETS[preset]
    return Params(*(jnp.asarray(leaf, jnp.float32) for leaf in params)), config


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=12_000)
    parser.add_argument("--gradients", type=int, default=1_200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--what", nargs="*", default=["plain", "variance", "derivatives"])
    parser.add_argument("--presets", nargs="*", default=["paper", "falcor", "tuned", "adaptive"])
    parser.add_argument("--recovery", action="store_true")
    options = parser.parse_args()
    if options.recovery:
        for kind in KINDS:
            print(f"{kind:20}", *(f"{preset} {recovery(preset, kind)}" for preset in options.presets), flush=True)
        return
    count, gradients = (total // len(options.presets) for total in (options.cases, options.gradients))
    jobs = {
        "plain": partial(forward, count=count // 2, variance=False),
        "variance": partial(forward, count=count // 2, variance=True),
        "derivatives": partial(backward, count=gradients),
    }
    for what in options.what:
        for i, preset in enumerate(options.presets):
            began = time.monotonic()
            told = jobs[what](preset, seed=options.seed + i)
            print(f"{preset} {what}: {told}, {time.monotonic() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main()
