"""What hit distances are worth, part by part: the scene `mirror` of render_scenes.py, with and without them.

    python tests/bench/render_scenes.py FOLDER mirror --size 320x180        (wants Mitsuba)
    python tests/bench/reflections.py FOLDER/mirror [--first 4] [--figure reflections.jpg]

PSNR (on x / (1 + x)), relMSE and temporal error are over all pixels of a part in all frames from `--first` on. The parts: all;
mirror (flat), lacquer (a coat over a pattern), rough (metal), gold (a ball, a curved mirror), glazed (a ball, a rough coat), and
moving: those pixels of all these in which a moving thing is reflected, or was there in the last three frames.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
from PIL import Image

from svgf_jax import Params, exr, init, open_source, preset, read_frame, step
from svgf_jax.metrics import display

VARIANTS = {  # preset, with the channel `hit_distance`, table, other parameters
    "`paper`, surface": ("paper", False, "table", {}),
    "`paper`, hit distance": ("paper", True, "table", {}),
    "`paper`, hit distance, mirrored albedo": ("paper", True, "mirrored", {}),
    "`adaptive`, surface": ("adaptive", False, "table", {}),
    "`adaptive`, hit distance": ("adaptive", True, "table", {}),
    "the same, `sigma_luminance` 2": ("adaptive", True, "table", {"sigma_luminance": 2.0}),
    "the same, mirrored albedo": ("adaptive", True, "mirrored", {"sigma_luminance": 2.0}),
}
PARTS = ("mirror", "lacquer", "rough", "gold", "glazed")
MOVING = ("ball", "box")


CROP, SHOWN = (
    (slice(60, 180), slice(0, 200)),
    ("`paper`, surface", "`paper`, hit distance", "`paper`, hit distance, mirrored albedo"),
)


def filtered(folder: Path, name: str, hit: bool, table: str, changes: dict[str, float]) -> Iterator[np.ndarray]:
    without = {} if hit else {"hit_distance": ("none",)}
    source = open_source(folder, renderer=str(folder / f"{table}.toml"), channel=without)
    params, config = preset(name)
    leaves = Params(*(np.asarray(leaf, np.float32) for leaf in params._replace(**changes)))
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


def measure(folder: Path, variant: str, *, first: int) -> tuple[dict[str, tuple[float, ...]], np.ndarray]:
    """(PSNR, relMSE, temporal error) by part, and the last picture."""
    sums: dict[str, np.ndarray] = {}
    before, image = None, np.empty(0)
    pairs = zip(filtered(folder, *VARIANTS[variant]), references(folder), strict=True)
    for t, (image, (clean, parts)) in enumerate(pairs):
        error = display(image) - display(clean)
        relative = np.square(image - clean) / (np.square(clean) + 0.01)
        if t >= first and before is not None:
            planes = np.stack([np.square(error), relative, np.square(error - before)])
            for part, mask in parts.items():
                sums[part] = sums.get(part, 0) + np.array([*planes[:, mask].sum(axis=(1, 2)), 3 * mask.sum()])
        before = error
    means = {part: total[:3] / total[3] for part, total in sums.items()}
    return {part: (-10 * np.log10(m[0]), m[1], m[2] ** 0.5) for part, m in means.items()}, image


def shown(image: np.ndarray) -> np.ndarray:
    """A part of the picture, twice as large, 8 bits."""
    part = np.clip(display(image)[CROP] * 1.3, 0, 1) ** (1 / 2.2) * 255
    return np.repeat(np.repeat(part.astype(np.uint8), 2, axis=0), 2, axis=1)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--first", type=int, default=4)
    parser.add_argument("--figure", type=Path)
    given = parser.parse_args()
    print("| | " + " | ".join(columns := ("all", *PARTS, "moving")) + " |\n|---" + "|---" * len(columns) + "|")
    pictures = {}
    for variant in VARIANTS:
        found, pictures[variant] = measure(given.folder, variant, first=given.first)
        cells = (f"{p:.2f} / {r:.3f} / {d:.4f}".replace(" 0.", " .") for p, r, d in map(found.__getitem__, columns))
        print(f"| {variant} | {' | '.join(cells)} |", flush=True)
    if given.figure:
        *_, (clean, _) = references(given.folder)
        panels = [shown(image) for image in (clean, *(pictures[name] for name in SHOWN))]
        rows = [np.concatenate(panels[i : i + 2], axis=1) for i in (0, 2)]
        Image.fromarray(np.concatenate(rows)).save(given.figure, quality=88)


if __name__ == "__main__":
    main()
