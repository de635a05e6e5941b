"""Ways to make history notice that light has changed, on whole sequences: the candidates beside the preset `adaptive`.

    python tests/bench/candidates.py FOLDER... [--only 'gradient 5;test 2, 2']
    python tests/bench/candidates.py --table                                     (what was measured, as Markdown)

- `clamp k`: the history clamped to mean +- k standard deviations of this frame's illumination over 7 x 7 (the GAMES202 homework).
- `fast a, k`: a second, fast history (least weight a of the new frame, not filtered), as in NVIDIA's RELAX: the slow history is
  clamped to mean +- k standard deviations of the fast one over 7 x 7.
- `gradient n`: the normalised temporal gradient of A-SVGF (Schied et al. 2018), which re-shades samples of the frame before, from
  the files alone. d = l(I) - l(H), luminances of this frame and of its reprojected history, and m = max(l(I), l(H)) go through n
  a-trous levels with the geometry's weights only; lambda = |d| / m.
- `test n, k`: the same d against its standard error e, as these levels propagate the tracked variance of a sample:
  lambda = max(0, 1 - (k e / d)^2). (The levels share taps, which makes e too small: k takes that in.)
- `gain`, `offset`, `both`: the corrections of `adaptive`, one or both, with thresholds of 2.
- `adaptive`, `steady`: the preset as it is, and with `light_cell` 0. `..., test n, k`: any of these, then the test of what is left.

By lambda a signal's weight of the new frame becomes (1 - lambda) alpha + lambda, in the moments too; of the history length, which
all signals share, 1 - lambda is left, for the largest. All else is `paper` with a short-history boost of 4, except in `steady` and
`adaptive`.
Composed from the library's public stages. Results are added to tests/bench/candidates.json.
"""

import argparse
import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import svgf_jax as sj
from svgf_jax.metrics import mean_scores, score_frames
from svgf_jax.types import Config, Frame, History, Params, Reprojected

RESULTS = Path(__file__).with_suffix(".json")
BASE = Params(short_history_boost=4.0)
FOLLOWING = BASE._replace(light_gain_threshold=2.0, light_offset_threshold=2.0)
NEVER = 1e6  # standard errors


class Way(NamedTuple):
    """`kind` is "step" (the library's own, with these params and config), "fast", "gradient" or "test".

    Attributes:
        levels: n above.
        number: a or k above.
    """

    kind: str = "step"
    params: Params = BASE
    config: Config = Config()
    levels: int = 0
    number: float = 0.0


def ways() -> dict[str, Way]:
    tests = [(3, 2.0), (3, 3.0), (5, 5.0)]
    cells, (tuned, following) = Config(light_cell=4), sj.preset("adaptive")
    steady = following._replace(light_cell=0)
    return {
        "paper": Way(params=Params()),
        "paper, boost 4": Way(),
        "alpha 0.8": Way(params=BASE._replace(alpha=0.8)),
        "no history": Way(params=BASE._replace(alpha=1.0, sigma_luminance=8.0)),
        **{f"clamp {k:g}": Way("step", BASE._replace(clamp_sigma=k), Config(clamp_radius=3)) for k in (0.5, 1.0, 2.0)},
        **{
            f"fast {a:g}, {k:g}": Way("fast", BASE._replace(clamp_sigma=k), Config(clamp_radius=3), number=a)
            for a in (0.5, 0.25)
            for k in (0.5, 1.0, 2.0)
        },
        **{f"gradient {n}": Way("gradient", levels=n) for n in (1, 3, 5)},
        **{f"test {n}, {k:g}": Way("test", levels=n, number=k) for n, k in tests},
        "gain": Way("step", FOLLOWING._replace(light_offset_threshold=NEVER), cells),
        "offset": Way("step", FOLLOWING._replace(light_gain_threshold=NEVER), cells),
        "both": Way("step", FOLLOWING, cells),
        "both, test 3, 3": Way("test", FOLLOWING, cells, 3, 3.0),
        "steady": Way("step", tuned, steady),
        "steady, test 3, 3": Way("test", tuned, steady, 3, 3.0),
        "adaptive": Way("step", tuned, following),
        "adaptive, test 3, 3": Way("test", tuned, following, 3, 3.0),
    }


def change(light: Array, previous: Reprojected, frame: Frame, params: Params, number: Array, *, kind: str, levels: int):
    """lambda `[S, H, W]`, in [0, 1], of `gradient` and `test`."""
    l, prev_l = sj.luminance(light), sj.luminance(previous.illumination)
    known = frame._replace(object_id=jnp.where(previous.valid, frame.object_id, -1))
    variance = sj.estimate_variance(previous.moments, previous.history_length, known, params=params)
    both = jnp.stack([l - prev_l, jnp.maximum(l, prev_l), jnp.zeros_like(l)], axis=-1)
    blind = BASE._replace(luminance_epsilon=1e30)  # to luminance; the paper's geometry
    means, square, _ = sj.atrous_filter(both, variance, known, params=blind, config=Config(levels=levels))
    d, m = means[..., 0], means[..., 1]
    if kind == "gradient":
        return jnp.minimum(jnp.abs(d) / jnp.maximum(m, 1e-6), 1.0)
    return jnp.maximum(1.0 - number**2 * square / jnp.maximum(d * d, 1e-12), 0.0)


def shortened(previous: Reprojected, change: Array, params: Params) -> tuple[Reprojected, Array]:
    """The history, shorter, and the longest history whose weight of the new frame is (1 - change) alpha + change."""
    alpha = jnp.maximum(params.alpha, 1.0 / jnp.minimum(previous.history_length + 1.0, params.max_history))
    length = previous.history_length * (1.0 - change.max(axis=0))
    return previous._replace(history_length=length), 1.0 / ((1.0 - change) * alpha + change)


@partial(jax.jit, static_argnames=("kind", "levels", "config"))
def step(
    slow: History, fast: History, frame: Frame, params: Params, number: Array, *, kind: str, levels: int, config: Config
) -> tuple[History, History, Array]:
    """`pipeline.step`, with a second history or with one that is shortened."""
    frame, _ = sj.sanitise(frame)
    guides = {"depth": frame.depth, "normal": frame.normal, "object_id": frame.object_id}
    light = sj.demodulate(frame.radiance, frame.albedo, albedo_floor=params.albedo_floor)
    previous = sj.reproject(slow, frame, params=params, config=config)
    previous = sj.follow_light(previous, light, frame, params=params, config=config)
    longest = None
    if kind == "fast":
        quick = params._replace(alpha=number, alpha_moments=number)
        recent = sj.accumulate(light, sj.reproject(fast, frame, params=params, config=config), frame, params=quick)
        previous = sj.clamp_history(previous, recent.illumination, frame, params=params, config=config)
        fast = History(recent.illumination, recent.moments, recent.history_length, **guides)
    else:
        share = change(light, previous, frame, params, number, kind=kind, levels=levels)
        previous, longest = shortened(previous, share, params)
    now = sj.accumulate(light, previous, frame._replace(longest_history=longest), params=params)
    variance = sj.estimate_variance(now.moments, now.history_length, frame, params=params, config=config)
    filtered, _, feedback = sj.atrous_filter(now.illumination, variance, frame, params=params, config=config)
    image = sj.modulate(filtered, frame, albedo_floor=params.albedo_floor)
    return History(feedback, now.moments, now.history_length, **guides), fast, image


def images(folder: str, way: Way) -> Iterator[np.ndarray]:
    source = sj.open_source(folder)
    params = jax.tree.map(np.float32, way.params)
    slow = fast = None
    for i in range(len(source.sequence.files)):
        frame = sj.read_frame(source, i).frame
        if slow is None or fast is None:
            slow = fast = sj.init(frame)
        if way.kind == "step":
            slow, output = sj.step(slow, frame, params=params, config=way.config)
            yield np.asarray(output.image)
        else:
            static = {"kind": way.kind, "levels": way.levels, "config": way.config}
            slow, fast, image = step(slow, fast, frame, params, np.float32(way.number), **static)
            yield np.asarray(image)


def stored() -> dict[str, dict[str, dict[str, float]]]:
    return json.loads(RESULTS.read_text()) if RESULTS.exists() else {}


def table() -> None:
    found = stored()
    print(f"| | {' | '.join(found)} |\n|---|{'---|' * len(found)}")
    for name in ways():
        scores = [s[name] for s in found.values()]
        cells = (f"{s['psnr']:.2f} / {s['temporal']:.4f}".replace(" 0.", " .") for s in scores)
        print(f"| {name} | {' | '.join(cells)} |")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--only")
    parser.add_argument("--table", action="store_true")
    given = parser.parse_args()
    if given.table:
        return table()
    for folder in given.folders:
        references = sj.load_reference(str(folder))
        for name, way in ways().items():
            if given.only and name not in given.only.split(";"):
                continue
            scores = score_frames(zip(images(str(folder), way), references, strict=True))
            mean = mean_scores(s for s in scores if s is not None)
            found = stored()
            found.setdefault(folder.name, {})[name] = {"psnr": mean.psnr, "temporal": mean.temporal}
            RESULTS.write_text(json.dumps(found, indent=1) + "\n")
            print(f"{folder.name:16} {name:20} {mean.psnr:.2f} / {mean.temporal:.4f}", flush=True)


if __name__ == "__main__":
    main()
