"""The largest picture that is read, for all that reads in this process. The standard library only."""

from svgf_jax.types import SvgfError

MAX_PIXELS = 2**28
"""16384 x 16384, the area of eight 8K frames: 3.2 GB for one colour in 32-bit float."""

_chosen: int | None = None


def set_max_pixels(count: int | None) -> None:
    """Read pictures of up to so many pixels, and believe files that claim as many; None = as by default. Raises SvgfError."""
    global _chosen
    if count is not None and count < 1:
        raise SvgfError(f"Got --max-pixels {count}; wanted a number of pixels, 1 or more.")
    _chosen = count


def max_pixels() -> tuple[int, bool]:
    """The limit, and whether somebody chose it."""
    return (MAX_PIXELS, False) if _chosen is None else (_chosen, True)
