"""The total radiance of any image: what references and results are compared by."""

import os

import numpy as np

from svgf_jax import exr
from svgf_jax.exr_layout import PathName
from svgf_jax.limits import limits
from svgf_jax.planes import light
from svgf_jax.renderers import detect_renderer, in_layer
from svgf_jax.roles import resolve_roles
from svgf_jax.sequences import Sequence, find_sequence, format_range
from svgf_jax.types import SvgfError

NAMES = ("ref", "reference", "frame")
"""What the sequence of references in a folder may be called, the most likely first."""


def read_radiance(path: PathName, *, max_pixels: int | None = None, max_ratio: int | None = None) -> np.ndarray:
    """Total radiance `[H, W, 3]` float32: R, G, B where the file has them, else the renderer's beauty, else all light added up.

    `max_pixels` and `max_ratio` as in `open_source`. Raises SvgfError: unreadable, or nothing of this is there.
    """
    image = exr.read(path, most=limits(max_pixels, max_ratio))
    where = os.fspath(path)
    if {"R", "G", "B"} <= image.channels.keys():
        roles = resolve_roles(tuple(image.channels), channel={"radiance": "RGB"}, where=where)
    else:
        table = detect_renderer(image.channels, image.attributes)
        only = "Wanted a picture with one of them, or with R, G, B."
        channels = in_layer(table, tuple(image.channels), None, where=where, choose=only)
        roles = resolve_roles(channels, table=table, where=where)

    def plane(role: str) -> np.ndarray:
        return np.stack([image.channels[name].astype(np.float32) for name in roles.layers[role].channels], -1)

    if "radiance" in roles.layers:
        return plane("radiance")
    wanted = (*roles.signals, *(one.albedo for one in roles.light.values()), "emission", "environment")
    radiance, _, emission = light(roles, {role: plane(role) for role in wanted if role in roles.layers}, {})
    return radiance.sum(0) + emission


def pair_references(
    frames: Sequence, pattern: PathName, *, prefer: tuple[str, ...] = NAMES
) -> tuple[dict[int, str], tuple[str, ...]]:
    """The references of a sequence's frames by number, and what to tell of frames that have none. No pixel is read.

    Args:
        frames: the sequence.
        pattern: the references: a folder, a pattern or a file.
        prefer: which sequence of a folder to take.

    Raises SvgfError: not found, no frame in common.
    """
    wanted = find_sequence(pattern, missing="reset", prefer=prefer)
    there = {number: path for number, path in wanted.files if path is not None}
    numbers = [number for number, _ in frames.files[frames.warmup or 0 :]]
    paths = {number: there[number] for number in numbers if number in there}
    if not paths:
        raise SvgfError(
            f"{wanted.name} (frames {format_range(there)}) has none of the frames {format_range(numbers)} of "
            f"{frames.name}; wanted the same frame numbers in both."
        )
    missing = [number for number in numbers if number not in paths]
    told = (
        f"{wanted.name} lacks frames {format_range(missing)} of {frames.name}: the filter runs through them, "
        "and they count for nothing."
    )
    return paths, (told,) * bool(missing)


def read_reference(path: PathName, *, size: tuple[int, ...], number: int) -> np.ndarray:
    """`read_radiance` of the reference of the frame `number`, which is of `size` (height, width); else SvgfError."""
    image = read_radiance(path)
    if image.shape[:2] != size:
        raise SvgfError(
            f"{path} is {image.shape[1]} x {image.shape[0]} pixels, the noisy frame {number} {size[1]} x {size[0]}; "
            "wanted references of the same size. Render them anew, or crop both alike."
        )
    return image


def load_reference(pattern: PathName, *, frames: str | None = None) -> np.ndarray:
    """Total radiance of all references `[T, H, W, 3]`: a folder (its `ref_` sequence), a pattern or a file."""
    sequence = find_sequence(pattern, frames=frames, prefer=NAMES)
    return np.stack([read_radiance(path) for _, path in sequence.files if path is not None])
