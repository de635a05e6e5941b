"""What a fit is fed: shots, each a sequence of frames with what they should have looked like, read one at a time."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from svgf_jax import Frame, SvgfError, open_source, read_frame
from svgf_jax.references import pair_references, read_reference


class Example(NamedTuple):
    """One frame and its target `[H, W, 3]`; None = there is no target for it, and the filter only runs through it."""

    frame: Frame
    target: np.ndarray | None


class Shot(NamedTuple):
    """A sequence.

    Attributes:
        name: for people.
        length: number of frames.
        read: index -> `Example` of NumPy arrays; called from other threads, and anew for each pass.
        notes: what the user should know before the work starts, as sentences.
        numbers: of the frames, as their files have them; () = from 0 on.
        paths: of all files of frames and targets, in order.
    """

    name: str
    length: int
    read: Callable[[int], Example]
    notes: tuple[str, ...] = ()
    numbers: tuple[int, ...] = ()
    paths: tuple[str, ...] = ()


def frame_numbers(shot: Shot) -> tuple[int, ...]:
    """The frames' numbers."""
    return shot.numbers or tuple(range(shot.length))


def shot_of_arrays(frames: Frame, targets: Any, *, name: str = "frames") -> Shot:
    """A shot held in memory: a `Frame` with a leading T, and targets `[T, H, W, 3]`."""
    targets = np.asarray(targets)
    if targets.shape != np.shape(frames.emission):
        raise SvgfError(
            f"{name}: targets of shape {targets.shape} for frames of {np.shape(frames.emission)}; "
            "wanted one image [H, W, 3] of the same size for each frame"
        )

    def read(index: int) -> Example:
        leaves: list[Any] = [None if leaf is None else np.asarray(leaf[index]) for leaf in frames]
        return Example(Frame(*leaves), targets[index])

    return Shot(name, targets.shape[0], read)


def shot_of_files(
    noisy: str,
    target: str,
    *,
    frames: str | None = None,
    prefer: Sequence[str] = ("ref", "reference", "frame"),
    **options: Any,
) -> Shot:
    """A shot on the disk.

    Args:
        noisy: whatever `svgf_jax.open_source` takes.
        target: the references: a folder, a pattern or a file; paired by frame number.
        frames: only these.
        prefer: which sequence of a folder of targets to take.
        **options: of `svgf_jax.open_source`.

    Raises:
        SvgfError: not found, no frame in common.
    """
    source = open_source(noisy, frames=frames, **options)
    paths, lacking = pair_references(source.sequence, target, prefer=tuple(prefer))
    numbers = [number for number, _ in source.sequence.files]

    def read(index: int) -> Example:
        frame = read_frame(source, index).frame
        path = paths.get(numbers[index])
        if path is None:
            return Example(frame, None)
        return Example(frame, read_reference(path, size=frame.depth.shape, number=numbers[index]))

    files = [path for _, path in source.sequence.files if path is not None]
    notes = (*source.warnings, *lacking)
    return Shot(str(noisy), len(numbers), read, notes, tuple(numbers), (*files, *paths.values()))


def window(shot: Shot, *, rows: slice = slice(None), columns: slice = slice(None), frames: slice = slice(None)) -> Shot:
    """A crop of a shot in space and time. What comes into the crop from outside has no history."""
    indices = range(shot.length)[frames]

    def read(index: int) -> Example:
        frame, target = shot.read(indices[index])
        axes = {"depth": 0, "prev_depth": 0, "object_id": 0, "radiance": 1, "albedo": 1, "variance": 1}
        axes |= dict.fromkeys(("reflected_motion", "reflected_prev_depth", "longest_history"), 1)
        cut: dict[str, Any] = {
            name: np.ascontiguousarray(leaf[(slice(None),) * (axes.get(name) == 1) + (rows, columns)])
            for name, leaf in frame._asdict().items()
            if leaf is not None
        }
        return Example(Frame(**cut), None if target is None else np.ascontiguousarray(target[rows, columns]))

    return shot._replace(length=len(indices), read=read, numbers=frame_numbers(shot)[frames])
