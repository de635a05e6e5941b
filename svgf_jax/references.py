"""The total radiance of any image: what references and results are compared by."""

import os

import numpy as np

from svgf_jax import exr
from svgf_jax.exr_layout import PathName
from svgf_jax.roles import resolve_roles
from svgf_jax.sequences import find_sequence

NAMES = ("ref", "reference", "frame")
"""What the sequence of references in a folder may be called, the most likely first."""


def read_radiance(path: PathName, *, max_pixels: int = exr.MAX_PIXELS) -> np.ndarray:
    """Total radiance `[H, W, 3]` float32: R, G, B where the file has them, else direct + indirect + emission.

    Raises SvgfError: unreadable, or neither is there.
    """
    image = exr.read(path, max_pixels=max_pixels)
    beauty = {"radiance": "RGB"} if {"R", "G", "B"} <= image.channels.keys() else None
    roles = resolve_roles(tuple(image.channels), channel=beauty, where=os.fspath(path))
    terms = roles.signals if beauty else (*roles.signals, "emission")
    total = np.zeros((*next(iter(image.channels.values())).shape, 3), np.float32)
    for role in terms:
        if role in roles.layers:
            total += np.stack([image.channels[name].astype(np.float32) for name in roles.layers[role].channels], -1)
    return total


def load_reference(pattern: PathName, *, frames: str | None = None) -> np.ndarray:
    """Total radiance of all references `[T, H, W, 3]`: a folder (its `ref_` sequence), a pattern or a file."""
    sequence = find_sequence(pattern, frames=frames, prefer=NAMES)
    return np.stack([read_radiance(path) for _, path in sequence.files if path is not None])
