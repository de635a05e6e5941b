"""Two sequences on disk, measured frame by frame. NumPy only."""

from collections.abc import Callable, Iterator

import numpy as np

from svgf_jax.exr_layout import PathName
from svgf_jax.metrics import Scores, score_frames
from svgf_jax.references import NAMES, read_radiance
from svgf_jax.sequences import find_sequence, format_range
from svgf_jax.threads import read_ahead
from svgf_jax.types import SvgfError


def compare_sequences(
    out: PathName,
    reference: PathName,
    *,
    frames: str | None = None,
    with_flip: bool = False,
    warn: Callable[[str], None] = lambda text: None,
) -> Iterator[tuple[int, Scores]]:
    """(frame number, scores) of each frame that both sequences have, in order.

    `warn` hears of frames that one of them lacks, or both, and of pixels that are not finite.

    Folders, patterns or files as `find_sequence` takes them; of a folder's sequences, `frame` is taken for `out` and
    `ref` for `reference`. Raises SvgfError: not found, no frame in common, unreadable, of different sizes, no colour.
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

    def read(number: int) -> tuple[np.ndarray, np.ndarray]:
        image, wanted = read_radiance(ours[number]), read_radiance(theirs[number])
        if image.shape != wanted.shape:
            raise SvgfError(
                f"{ours[number]} is {image.shape[1]} x {image.shape[0]} pixels, {theirs[number]} {wanted.shape[1]} x "
                f"{wanted.shape[0]}; wanted the same size in both."
            )
        return image, wanted

    def checked() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for number, pair in zip(common, read_ahead(read, common, threads=1), strict=True):
            for image, where in zip(pair, ("", " in the reference"), strict=True):
                if bad := int((~np.isfinite(image)).any(-1).sum()):
                    warn(f"frame {number}: {bad} pixel{'s' * (bad != 1)} not finite{where}")
            yield pair

    for number, scores in zip(common, score_frames(checked(), with_flip=with_flip), strict=True):
        assert scores is not None  # every pair has its reference
        yield number, scores
