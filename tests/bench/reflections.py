"""What hit distances are worth, part by part: the scene `mirror` of render_scenes.py, with and without them.

    python tests/bench/render_scenes.py FOLDER mirror --frames 16 --size 320x180        (wants Mitsuba)
    python tests/bench/reflections.py FOLDER/mirror [--only paper,adaptive] [--first 4] [--pictures OUT]

Every preset filters the sequence without the channel `hit_distance`, then with it. PSNR (on x / (1 + x)), relMSE and temporal error
are over all pixels of a part in all frames from `--first` on. The parts: all; mirror (flat), lacquer (a coat over a pattern), rough
(metal), gold (a ball, a curved mirror), glazed (a ball, a rough coat), and moving: those pixels of all these in which a moving
thing is reflected, or was there in the last three frames.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

from svgf_jax import Params, exr, init, open_source, preset, read_frame, step
from svgf_jax.metrics import display

PARTS = ("mirror", "lacquer", "rough", "gold", "glazed")
MOVING = ("ball", "box")


def filtered(folder: Path, name: str, *, hit: bool) -> Iterator[np.ndarray]:
    without = {} if hit else {"hit_distance": ("none",)}
    source = open_source(folder, renderer=str(folder / "table.toml"), channel=without)
    params, config = preset(name)
    leaves = Params(*(np.asarray(leaf, np.float32) for leaf in params))
    history = None
    for i in range(len(source.sequence.files)):
        frame = read_frame(source, i).frame
        history = init(frame) if history is None else history
        history, output = step(history, frame, params=leaves, config=config)
        yield np.asarray(jax.block_until_ready(output.image))


def references(folder: Path) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """The clean picture, and which pixels belong to each part."""
    seen: list[np.ndarray] = []
    for path in sorted(folder.glob("ref_*.exr")):
        image = exr.read(path)
        names = str(image.attributes["shapes"]).split()
        ids, reflected = image.channels["id.I"], image.channels["reflected.id"]
        parts = {name: ids == names.index(name) for name in PARTS}
        seen = [*seen[-3:], np.isin(reflected, [names.index(name) for name in MOVING])]
        moving = np.any(seen, axis=0) & np.any(list(parts.values()), axis=0)
        still = {name: mask & ~moving for name, mask in parts.items()}
        yield (
            np.stack([image.channels[c] for c in "RGB"], -1),
            {"all": np.ones(ids.shape, bool), **still, "moving": moving},
        )


def measure(folder: Path, name: str, *, hit: bool, first: int, pictures: Path | None) -> dict[str, tuple[float, ...]]:
    sums: dict[str, np.ndarray] = {}
    before = None
    for t, (image, (clean, parts)) in enumerate(zip(filtered(folder, name, hit=hit), references(folder), strict=True)):
        if pictures:
            np.save(pictures / f"{name}_{'hit' if hit else 'surface'}_{t:04d}.npy", image)
        error = display(image) - display(clean)
        relative = np.square(image - clean) / (np.square(clean) + 0.01)
        if t >= first and before is not None:
            planes = np.stack([np.square(error), relative, np.square(error - before)])
            for part, mask in parts.items():
                sums[part] = sums.get(part, 0) + np.array([*planes[:, mask].sum(axis=(1, 2)), 3 * mask.sum()])
        before = error
    means = {part: total[:3] / total[3] for part, total in sums.items()}
    return {part: (-10 * np.log10(m[0]), m[1], m[2] ** 0.5) for part, m in means.items()}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="paper,adaptive")
    parser.add_argument("--first", type=int, default=4)
    parser.add_argument("--pictures", type=Path)
    given = parser.parse_args()
    if given.pictures:
        given.pictures.mkdir(parents=True, exist_ok=True)
    print("| | " + " | ".join(columns := ("all", *PARTS, "moving")) + " |\n|---" + "|---" * len(columns) + "|")
    for name in given.only.split(","):
        for hit in (False, True):
            found = measure(given.folder, name, hit=hit, first=given.first, pictures=given.pictures)
            cells = (f"{p:.2f} / {r:.3f} / {d:.4f}".replace(" 0.", " .") for p, r, d in map(found.__getitem__, columns))
            print(f"| `{name}`, {'hit distance' if hit else 'surface'} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
