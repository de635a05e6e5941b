"""Motion vectors of other conventions, brought to this library's own. Which one they follow: `svgf_jax.warping`.

No two renderers agree on motion. A convention is said in a few words, in any order, for example "fraction y-up from-previous":

| word              | meaning                                                                                          |
|-------------------|--------------------------------------------------------------------------------------------------|
| `pixel`           | pixels                                                                                           |
| `fraction`        | the picture's width and height are 1                                                             |
| `ndc`             | the picture's width and height are 2                                                             |
| `world`           | world space, three numbers; needs positions and cameras (`svgf_jax.frames` projects them)        |
| `y-down`, `y-up`  | where y points                                                                                   |
| `to-previous`     | previous place - this one                                                                        |
| `from-previous`   | this place - the previous one                                                                    |
| `to-next`         | next place - this one: taken from the frame before                                               |
| `from-next`       | this place - the next one: likewise                                                              |

`pixel y-down to-previous` is this library's own, `Frame.motion`. Pure NumPy.
"""

from typing import NamedTuple

import numpy as np

from svgf_jax.types import SvgfError

UNITS = ("pixel", "fraction", "ndc", "world")
Y_AXES = ("y-down", "y-up")
DIRECTIONS = ("to-previous", "from-previous", "to-next", "from-next")


class Convention(NamedTuple):
    """What the numbers of a motion vector mean; words of the table at the top of this module."""

    unit: str = "pixel"
    y: str = "y-down"
    direction: str = "to-previous"

    def __str__(self) -> str:
        """The words, as `parse_convention` reads them."""
        return " ".join(self)

    @property
    def from_frame_before(self) -> bool:
        """Whether the vectors that are wanted stand in the frame before."""
        return self.direction.endswith("next")


CONVENTIONS = tuple(Convention(unit, y, way) for unit in UNITS[:3] for way in DIRECTIONS for y in Y_AXES)
"""Every convention in screen space, this library's own first."""


_WORDS = {
    word: field for field, words in zip(Convention._fields, (UNITS, Y_AXES, DIRECTIONS), strict=True) for word in words
}


def parse_convention(text: str) -> Convention:
    """A convention from words between spaces or commas; what is not said is this library's own. Raises SvgfError."""
    said: dict[str, str] = {}
    for word in text.replace(",", " ").split():
        field = _WORDS.get(word)
        if field is None or field in said:
            what = "is not known" if field is None else f"comes after {said[field]}"
            raise SvgfError(
                f"motion convention {text!r}: {word!r} {what}; wanted one each of {'|'.join(UNITS)}, {'|'.join(Y_AXES)}, "
                f"{'|'.join(DIRECTIONS)}; for example: fraction y-up from-previous."
            )
        said[field] = word
    return Convention(**said)


def convert(
    motion: np.ndarray,
    convention: Convention,
    *,
    size: tuple[int, int] | None = None,
    motion_before: np.ndarray | None = None,
) -> np.ndarray:
    """Motion `[H, W, 2]` of any convention in screen space as `Frame.motion` wants it: pixels, y down, previous - this.

    Args:
        motion: as in the frame's file.
        convention: what it means.
        size: width and height of the whole picture, of which the arrays may be a crop; that of the arrays if None.
        motion_before: as in the file of the frame before; wanted for `to-next` and `from-next`. Where a point came from
            is found by going back along it a few times; what came from outside is taken to move as the border does.

    Raises SvgfError: a world-space convention, no `motion_before`.
    """
    if convention.unit == "world":
        raise SvgfError(
            "Motion in world space cannot be converted without cameras and positions; open the files with both."
        )
    stored = motion_before if convention.from_frame_before else motion
    if stored is None:
        raise SvgfError(f"motion {convention}: wanted the motion vectors of the frame before too; got none.")
    width, height = size or motion.shape[1::-1]
    factor = {"pixel": (1, 1), "fraction": (width, height), "ndc": (width / 2, height / 2)}[convention.unit]
    sign = 1 if convention.direction in ("to-previous", "from-next") else -1
    scale = np.array([sign * factor[0], sign * factor[1] * (1 if convention.y == "y-down" else -1)], np.float32)
    with np.errstate(all="ignore"):
        vectors = stored[..., :2].astype(np.float32) * scale
    return _follow_back(vectors) if convention.from_frame_before else vectors


def _follow_back(vectors: np.ndarray) -> np.ndarray:
    """Motion to the previous frame, from vectors (previous - this) that stand at the previous frame's pixels.

    Solves m = v(p + m), v read at the nearest pixel; a few steps do where motion changes little from pixel to pixel.
    """
    height, width = vectors.shape[:2]
    y, x = np.mgrid[:height, :width]
    motion = vectors
    for _ in range(4):
        column, row = (
            _inside(at + motion[..., axis], most) for axis, (at, most) in enumerate(((x, width), (y, height)))
        )
        motion = vectors[row, column]
    return motion


def _inside(at: np.ndarray, count: int) -> np.ndarray:
    """The nearest index of a picture with `count` pixels in this direction; 0 for what is not finite."""
    return np.clip(np.rint(np.nan_to_num(at, posinf=count, neginf=0)), 0, count - 1).astype(np.int64)
