"""How large the pictures may be that this process reads, and what a small file may claim. The standard library only."""

from typing import NamedTuple

from svgf_jax.types import SvgfError

MAX_PIXELS = 2**28
"""16384 x 16384, the area of eight 8K frames: 3.2 GB for one colour in 32-bit float."""

MAX_RATIO = 1100
"""Bytes of pixels to a byte of file. Deflate packs at most 1032 into one; DWA, HTJ2K and ZSTD pack a black picture up to 120 000
times, and what they decode takes up to six times its size in memory."""

PLAUSIBLE = 2**28
"""Bytes of pixels that any file may claim."""


class Limits(NamedTuple):
    """The most pixels of a picture; and how many times its own bytes a file may claim, above `PLAUSIBLE`."""

    pixels: int = MAX_PIXELS
    ratio: int = MAX_RATIO


_chosen = Limits()


def set_limits(pixels: int = MAX_PIXELS, ratio: int = MAX_RATIO) -> None:
    """What is read from now on, wherever nothing else is said. Each limit holds by itself. Raises SvgfError."""
    global _chosen
    for option, number, what in (("--max-pixels", pixels, "pixels"), ("--max-ratio", ratio, "times a file's size")):
        if number < 1:
            raise SvgfError(f"Got {option} {number}; wanted a number of {what}, 1 or more.")
    _chosen = Limits(pixels, ratio)


def limits(pixels: int | None = None, ratio: int | None = None) -> Limits:
    """The limits that hold, or in their place those given."""
    return Limits(_chosen.pixels if pixels is None else pixels, _chosen.ratio if ratio is None else ratio)
