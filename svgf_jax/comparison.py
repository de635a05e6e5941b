"""Two sequences on disk, measured frame by frame. NumPy only."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from svgf_jax.exr_layout import PathName
from svgf_jax.metrics import Scores, score_frames
from svgf_jax.references import NAMES, read_radiance
from svgf_jax.sequences import find_sequence, format_range
from svgf_jax.threads import read_ahead
from svgf_jax.types import SvgfError


class Pair(NamedTuple):
    """A frame to compare: its number, its file and its reference's."""

    number: int
    path: str
    reference: str


def pair_sequences(
    out: PathName, reference: PathName, *, frames: str | None = None, warn: Callable[[str], None] = lambda text: None
) -> list[Pair]:
    """The frames that both sequences have, in order. No pixel is read.

    `warn` hears of frames that one of them lacks, or both. Folders, patterns or files as `find_sequence` takes them; of a
    folder's sequences, `frame` is taken for `out` and `ref` for `reference`. Raises SvgfError: not found, no frame in common.
    """
    sequences = (
        find_sequence(out, frames=frames, missing="reset", prefer=("frame", "denoised", "beauty")),
        find_sequence(reference, frames=frames, missing="reset", prefer=NAMES),
    )
    ours, theirs = ({number: path for number, path in sequence.files if path is not None} for sequence in sequences)
    common = sorted(ours.keys() & theirs.keys())
    if not common:
        raise SvgfError(
            f"{sequences[0].name} (frames {format_range(ours)}) and {sequences[1].name} (frames "
            f"{format_range(theirs)}) have no frame number in common; wanted the same frames in both."
        )
    if alone := ours.keys() ^ theirs.keys():
        warn(f"frames {format_range(alone)} are in only one of the sequences and are left out")
    wanted = {number for sequence in sequences for number, _ in sequence.files}
    if frames is not None and (nowhere := wanted - ours.keys() - theirs.keys()):
        warn(f"frames {format_range(nowhere)} are in neither of the sequences")
    return [Pair(number, ours[number], theirs[number]) for number in common]


def compare_sequences(
    out: PathName,
    reference: PathName,
    *,
    frames: str | None = None,
    with_flip: bool = False,
    warn: Callable[[str], None] = lambda text: None,
) -> Iterator[tuple[int, Scores]]:
    """(frame number, scores) of each pair of `pair_sequences`. Raises SvgfError as that does, and as `compare_pairs`."""
    return compare_pairs(pair_sequences(out, reference, frames=frames, warn=warn), with_flip=with_flip, warn=warn)


def compare_pairs(
    pairs: Sequence[Pair], *, with_flip: bool = False, warn: Callable[[str], None] = lambda text: None
) -> Iterator[tuple[int, Scores]]:
    """(frame number, scores) of each pair. `warn` hears of pixels that are not finite.

    Raises SvgfError: unreadable, of different sizes, no colour.
    """

    def read(pair: Pair) -> tuple[np.ndarray, np.ndarray]:
        image, wanted = read_radiance(pair.path), read_radiance(pair.reference)
        if image.shape != wanted.shape:
            raise SvgfError(
                f"{pair.path} is {image.shape[1]} x {image.shape[0]} pixels, {pair.reference} {wanted.shape[1]} x "
                f"{wanted.shape[0]}; wanted the same size in both."
            )
        return image, wanted

    def checked() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for pair, images in zip(pairs, read_ahead(read, pairs, threads=1), strict=True):
            for image, where in zip(images, ("", " in the reference"), strict=True):
                if bad := int((~np.isfinite(image)).any(-1).sum()):
                    warn(f"frame {pair.number}: {bad} pixel{'s' * (bad != 1)} not finite{where}")
            yield images

    for pair, scores in zip(pairs, score_frames(checked(), with_flip=with_flip), strict=True):
        assert scores is not None  # every pair has its reference
        yield pair.number, scores
