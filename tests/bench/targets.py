"""Are targets that do not belong to their frames found, and those that do left in peace?

    python tests/bench/targets.py

Eight frames of the three real sequences and of the bundled sample, each against its references as they are and changed in ways that
happen. Prints, for each change, the range of what `tune.targets.likeness` measures, and how many were doubted.
"""

from pathlib import Path

import numpy as np

from svgf_jax.demo import sample
from tune.shots import Example, Shot, shot_of_files
from tune.targets import doubts, likeness

DATA = Path(__file__).parents[3] / "shared/data"
NAMES = ("cornell-dolly", "gallery-pan", "lights-flicker")
LENGTH = 8


def read_shot(path: Path) -> Shot:
    """The first frames and one more, held in memory."""
    shot = shot_of_files(str(path), str(path), frames=f"0-{LENGTH}")
    examples = [shot.read(i) for i in range(shot.length)]
    return shot._replace(read=lambda i: examples[i], length=LENGTH)


def with_targets(shot: Shot, change) -> Shot:
    """`change(target, index)` for the targets."""
    return shot._replace(read=lambda i: Example(shot.read(i).frame, change(shot.read(i).target, i)))


def with_fireflies(shot: Shot, count: int, brightness: float) -> Shot:
    """So many in each frame."""

    def read(index: int) -> Example:
        frame, target = shot.read(index)
        radiance, draw = np.array(frame.radiance), np.random.default_rng(index)
        radiance[0].reshape(-1, 3)[draw.integers(0, frame.depth.size, count)] = brightness
        return Example(frame._replace(radiance=radiance), target)

    return shot._replace(read=read)


def with_noise(shot: Shot) -> Shot:
    """The targets times log-normal numbers of mean 1 in place of the frames."""

    def read(index: int) -> Example:
        frame, target = shot.read(index)
        light = target * np.random.default_rng(index).lognormal(-3.125, 2.5, (*target.shape[:2], 1))
        return Example(frame._replace(radiance=light[None], emission=0 * frame.emission), target)

    return shot._replace(read=read)


def told(name: str, shots: list[Shot]) -> None:
    """A row of the table."""
    found = [likeness(shot) for shot in shots]
    ranges = ["{:.2f} to {:.2f}".format(*np.nanquantile([one[i] for one in found], (0, 1))) for i in range(3)]
    doubted = sum(bool(doubts("s", one)) for one in found)
    print("|", " | ".join([name, *ranges, f"{doubted} of {len(found)}"]), "|", flush=True)


def main() -> None:
    shots = [read_shot(path) for path in (sample(), *(DATA / name for name in NAMES))]
    real = shots[1:]
    print("| targets | correlation | slope | brightness | doubted |\n|---|---|---|---|---|")
    told("the references", shots)
    for count, brightness in ((1, 1e3), (1, 1e30), (20, 1e6)):
        told(
            f"with fireflies in each frame: {count} of {brightness:g}",
            [with_fireflies(s, count, brightness) for s in shots],
        )
    told("with noise of 22 times the light", [with_noise(shot) for shot in shots])
    twice = [with_targets(s, lambda t, i: 2 * t) for s in shots]
    for count, brightness in ((0, 0), (1, 1e30), (20, 1e3), (20, 1e6)):
        told(
            f"twice as bright; fireflies: {count} of {brightness:g}",
            [with_fireflies(s, count, brightness) for s in twice],
        )
    told(
        "of another sequence",
        [with_targets(a, lambda t, i, b=b: b.read(i).target) for a in real for b in real if a is not b],
    )
    told("of the next frame", [with_targets(s, lambda t, i, s=s: s.read(i + 1).target) for s in shots])
    for name, change in {
        "upside down": lambda t: t[::-1, ::-1],
        "moved by one pixel": lambda t: np.roll(t, 1, 1),
        "gamma 2.2": lambda t: np.maximum(t, 0) ** (1 / 2.2),
        "gamma 2.2, 8 bits": lambda t: np.round(255 * np.clip(t, 0, 1) ** (1 / 2.2)) / 255,
        "x / (1 + x)": lambda t: t / (1 + t),
        "clipped at 1": lambda t: np.clip(t, 0, 1),
    }.items():
        told(name, [with_targets(s, lambda t, i, change=change: change(t)) for s in shots])


if __name__ == "__main__":
    main()
