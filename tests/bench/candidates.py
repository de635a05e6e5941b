"""Other ways to make history notice that light has changed, beside `adaptive`, on whole sequences.

    python tests/bench/candidates.py FOLDER...

- `clamp k`: the history clamped to mean +- k standard deviations of this frame's illumination over 7 x 7 (the GAMES202 homework).
- `fast a, k`: a second, fast history (least weight a of the new frame, not filtered), as in NVIDIA's RELAX: the slow history is
  clamped to mean +- k standard deviations of the fast one over 7 x 7.

Everything else is the preset `paper` with a short-history boost of 4. Composed from the library's public stages.
"""

import json
import sys
from functools import partial
from pathlib import Path

import jax
import numpy as np

import svgf_jax as sj
from svgf_jax.metrics import mean_scores, score_frames
from svgf_jax.types import Config, History, Params

RESULTS = Path(__file__).with_suffix(".json")
BASE = Params(short_history_boost=4.0)


@partial(jax.jit, static_argnames="config")
def step(slow: History, fast: History, frame: sj.Frame, params: Params, fast_alpha: jax.Array, *, config: Config):
    """`pipeline.step` with a second history; `config.clamp_radius` is the window over the fast one."""
    frame, _ = sj.sanitise(frame)
    quick = params._replace(alpha=fast_alpha, alpha_moments=fast_alpha)
    light = sj.demodulate(frame.radiance, frame.albedo, albedo_floor=params.albedo_floor)
    recent = sj.accumulate(light, sj.reproject(fast, frame, params=params, config=config), frame, params=quick)
    previous = sj.reproject(slow, frame, params=params, config=config)
    previous = sj.clamp_history(previous, recent.illumination, frame, params=params, config=config)
    now = sj.accumulate(light, previous, frame, params=params)
    variance = sj.estimate_variance(now.moments, now.history_length, frame, params=params, config=config)
    filtered, _, feedback = sj.atrous_filter(now.illumination, variance, frame, params=params, config=config)
    image = sj.modulate(filtered, frame, albedo_floor=params.albedo_floor)
    guides = {"depth": frame.depth, "normal": frame.normal, "object_id": frame.object_id}
    slow = History(feedback, now.moments, now.history_length, **guides)
    return slow, History(recent.illumination, recent.moments, recent.history_length, **guides), image


def images(folder: str, kind: str, fast_alpha: float, k: float):
    source = sj.open_source(folder)
    config = Config(clamp_radius=3)
    params = jax.tree.map(np.float32, BASE._replace(clamp_sigma=k))
    slow = fast = None
    for i in range(len(source.sequence.files)):
        frame = sj.read_frame(source, i).frame
        if slow is None:
            slow = fast = sj.init(frame)
        if kind == "clamp":
            slow, output = sj.step(slow, frame, params=params, config=config)
            yield np.asarray(output.image)
        else:
            slow, fast, image = step(slow, fast, frame, params, np.float32(fast_alpha), config=config)
            yield np.asarray(image)


def main() -> None:
    choices = [("clamp", 1.0, k) for k in (0.5, 1.0, 2.0)]
    choices += [("fast", alpha, k) for alpha in (0.5, 0.25) for k in (0.5, 1.0, 2.0)]
    for folder in sys.argv[1:]:
        references = sj.load_reference(folder)
        for kind, alpha, k in choices:
            pairs = zip(images(folder, kind, alpha, k), references, strict=True)
            mean = mean_scores(s for s in score_frames(pairs) if s is not None)
            name = f"clamp {k:g}" if kind == "clamp" else f"fast {alpha:g}, {k:g}"
            stored = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
            stored.setdefault(Path(folder).name, {})[name] = {"psnr": mean.psnr, "temporal": mean.temporal}
            RESULTS.write_text(json.dumps(stored, indent=1) + "\n")
            print(f"{Path(folder).name:16} {name:14} {mean.psnr:.2f} / {mean.temporal:.4f}", flush=True)


if __name__ == "__main__":
    main()
