"""What the shell offers for the values of options, asked for when TAB is pressed. It answers at once: no JAX."""

import os
from typing import TYPE_CHECKING

from cyclopts import Parameter

from svgf_jax.types import SvgfError

if TYPE_CHECKING:
    from cyclopts.completion._engine import CompletionContext

_SEQUENCES = ("INPUT", "NOISY")  # what the sequence is called in the commands


def _presets(_: "CompletionContext") -> list[str]:
    from svgf_jax.parameters import PRESETS

    return list(PRESETS)


def _presets_and_methods(context: "CompletionContext") -> list[str]:
    from svgf_jax.methods import METHODS

    return [*_presets(context), *METHODS]


def _listed(_: "CompletionContext") -> list[str]:
    from svgf_jax.methods import METHODS

    return ["presets", "methods", *METHODS]


def _renderers(_: "CompletionContext") -> list[str]:
    from svgf_jax.renderers import renderer_names

    return ["auto", *renderer_names()]


def _layers(context: "CompletionContext") -> tuple[str, ...]:
    """The view layers of the sequence's first file; nothing where that cannot be read."""
    from svgf_jax import exr
    from svgf_jax.renderers import detect_renderer, layers_of
    from svgf_jax.sequences import find_sequence, patterns

    given = next((text for name in _SEQUENCES if (value := context.get(name)) and (text := value.raw)), None)
    if given is None:
        return ()
    try:
        sequence = find_sequence(given, missing="reset")
        path = next(path for _, path in sequence.files if path is not None)
        header = exr.read_header(path)
        table = detect_renderer(header.channels, header.attributes, tuple(patterns(os.path.dirname(path))))
    except (SvgfError, OSError, StopIteration):
        return ()
    return layers_of(table, header.channels) if table.layered else ()


PRESET, ANY, LISTED, RENDERER, LAYER = (
    Parameter(completer=one) for one in (_presets, _presets_and_methods, _listed, _renderers, _layers)
)
