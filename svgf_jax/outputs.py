"""From one filtered frame to its files: the EXR with its layers and attributes, and the PNG preview. No JAX."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from svgf_jax import __version__, exr, preview
from svgf_jax.methods import MethodConfig
from svgf_jax.types import Config, Output

HALF_MAX = 65504.0


class WriteOptions(NamedTuple):
    """How outputs are written.

    Attributes:
        full_float: the denoised R, G, B and diagnostics as 32-bit float; else 16-bit.
        compression: an EXR compression, by the name that `exr.write` knows.
        only_denoised: leave out the input's other layers and attributes.
        diagnostics: add the layers `svgf.variance.*`, `svgf.change.*` (where the light is followed), `svgf.effective_history.*`,
            `svgf.history_length`, `svgf.valid`.
        png: also write a tone-mapped PNG beside each EXR.
        exposure: factor on the radiance in previews, > 0.
        tonemap: the tone curve of previews, a name of `tonemapping.CURVES`.
    """

    full_float: bool = False
    compression: str = "zip"
    only_denoised: bool = False
    diagnostics: bool = False
    png: bool = False
    exposure: float = 1.0
    tonemap: str = preview.CURVE


def numbers(params: Any, config: Config | MethodConfig) -> dict[str, Any]:
    """All parameters and choices as plain JSON numbers (lists where per level)."""
    plain = {name: np.asarray(value).astype(np.float64).tolist() for name, value in params._asdict().items()}
    return {"parameters": plain, "config": config._asdict()}


def attributes(
    source: str, *, method: str = "svgf", preset: str, params: Any, config: Config | MethodConfig
) -> dict[str, str]:
    """The header attributes that say how an output came about."""
    return {
        "svgf_jax:version": __version__,
        "svgf_jax:method": method,
        "svgf_jax:preset": preset,
        "svgf_jax:parameters": json.dumps(numbers(params, config)),
        "svgf_jax:source": source,
    }


def compose(
    output: Output,
    source: exr.Image,
    *,
    options: WriteOptions,
    signals: Sequence[str] = (),
    attributes: Mapping[str, Any],
) -> tuple[exr.Image, int]:
    """The image to write for one frame, and how many of its pixels had to be clamped to the range of 16-bit float.

    `R`, `G`, `B` are the denoised beauty. Every other channel and attribute of `source`, the input's main file, stays
    as it was, with its windows. `signals` names the signals for the diagnostics.
    """
    clipped = 0

    def plane(values: np.ndarray) -> np.ndarray:
        if options.full_float:
            return np.ascontiguousarray(values, np.float32)
        return np.ascontiguousarray(np.clip(values, -HALF_MAX, HALF_MAX), np.float16)

    image = np.asarray(output.image)
    if not options.full_float:
        clipped = int(np.count_nonzero((np.abs(image) > HALF_MAX).any(axis=-1)))
    channels = {} if options.only_denoised else dict(source.channels)
    channels |= {name: plane(image[..., c]) for c, name in enumerate("RGB")}
    if options.diagnostics:
        for layer in ("variance", "change", "effective_history"):
            for s, values in enumerate(() if (given := getattr(output, layer)) is None else np.asarray(given)):
                channels[f"svgf.{layer}.{signals[s] if s < len(signals) else s}"] = plane(values)
        channels["svgf.history_length"] = plane(np.asarray(output.history_length))
        channels["svgf.valid"] = plane(np.asarray(output.valid).astype(np.float32))
    kept = {} if options.only_denoised else dict(source.attributes)
    return source._replace(channels=channels, attributes=kept | dict(attributes)), clipped


def write_frame(path: Path, image: exr.Image, *, options: WriteOptions) -> tuple[str, ...]:
    """Write the EXR at `path` and, if asked for, the PNG beside it; each under a temporary name and then renamed.

    Returns the names of the attributes that could not be written.
    """
    dropped = exr.write(path, image, compression=options.compression)
    if options.png:
        preview.write_png(
            path.with_suffix(".png"), preview.to_8bit(beauty(image), exposure=options.exposure, curve=options.tonemap)
        )
    return dropped


def beauty(image: exr.Image) -> np.ndarray:
    """The `R`, `G`, `B` of an output as `[H, W, 3]` float32."""
    return np.stack([image.channels[name].astype(np.float32) for name in "RGB"], axis=-1)
