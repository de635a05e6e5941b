"""How far gradients in float32 are from those in float64, of whole sequences through a preset.

    python tests/bench/gradients32.py [--presets paper adaptive] [--cases 200] [--seed 1]

A case is three frames of 16x12 of `tests/scenes.py` (panning floor, moving objects, light that jumps; every second one with NaN,
Inf and negative values in it), and a random weighted sum of log(1 + image) of all frames. Its gradient is taken with respect to all
radiance and to every parameter, in both types; the difference is |a - b| / |b|, norms over all radiance or all parameters (each
parameter times its own value). The filter has kinks, thresholds of significance among them: a case whose rounding falls on the
other side of one differs by more than rounding. So the quantiles are told, and whether all is finite.
"""

import argparse
import sys
from functools import partial
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1])]
import bridge  # noqa: E402
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import scenes  # noqa: E402
from compiling import QUICK  # noqa: E402

from svgf_jax.parameters import preset  # noqa: E402
from svgf_jax.pipeline import denoise  # noqa: E402

jax.config.update("jax_enable_x64", True)


def gradients(name: str):
    """A function (frames, weights, dtype) -> gradients in radiance and parameters, of that dtype."""
    start, config = preset(name)

    def loss(radiance, params, frames, weights):
        _, outputs = denoise(frames._replace(radiance=radiance), params=params, config=config)
        return (weights * jnp.log1p(outputs.image)).mean()

    compiled = jax.jit(jax.grad(loss, argnums=(0, 1)), compiler_options=dict(QUICK))

    def run(frames, weights, dtype):
        cast = partial(np.asarray, dtype=dtype)
        params = jax.tree.map(lambda p: np.broadcast_to(cast(p), (config.levels,)), start)
        frames = bridge.to_frames(frames, dtype)
        by_radiance, by_params = compiled(cast(frames.radiance), params, frames, cast(weights))
        scaled = jax.tree.map(lambda g, p: np.asarray(g, np.float64) * p, by_params, params)
        return np.asarray(by_radiance, np.float64), np.stack(jax.tree.leaves(scaled))

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", nargs="+", default=["paper", "adaptive"])
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    print("| preset | | finite | median | 90 % | 99 % | worst |\n|---|---|---|---|---|---|---|")
    for name in given.presets:
        run, found = gradients(name), []
        for case in range(given.cases):
            seed = given.seed * 100_000 + case
            frames = scenes.synthetic(seed, 12, 16, frames=3, dirty=case % 2 == 1)
            weights = np.random.default_rng(seed).normal(size=(3, 12, 16, 3))
            pairs = zip(*(run(frames, weights, dtype) for dtype in (np.float32, np.float64)), strict=True)
            found.append([np.linalg.norm(a - b) / max(np.linalg.norm(b), 1e-30) for a, b in pairs])
        for what, errors in zip(("radiance", "parameters"), np.array(found).T, strict=True):
            finite = np.isfinite(errors)
            quantiles = " | ".join(f"{q:.1e}" for q in np.quantile(errors[finite], (0.5, 0.9, 0.99, 1.0)))
            print(f"| `{name}` | {what} | {finite.sum()} of {len(errors)} | {quantiles} |", flush=True)


if __name__ == "__main__":
    main()
