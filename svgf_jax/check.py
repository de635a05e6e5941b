"""Checks of shapes and dtypes at the public boundary: they cost nothing at run time, and name what does not fit."""

from typing import Any

import jax.numpy as jnp
from jax import Array

from svgf_jax.types import Config, Frame, History, Params, SvgfError, TaaHistory, choices_of, is_choice


def check_frame(frame: Frame) -> None:
    """Raise `SvgfError` unless the arrays of one frame fit together."""
    if len(frame.radiance.shape) != 4 or frame.radiance.shape[-1] != 3:
        raise SvgfError(
            f"radiance has shape {frame.radiance.shape}; wanted [S, H, W, 3], S signals. "
            "For a plain image add the first axis: radiance[None]. For a sequence call denoise, not step."
        )
    signals, height, width, _ = frame.radiance.shape
    shapes = {
        "emission": (height, width, 3),
        "normal": (height, width, 3),
        "depth": (height, width),
        "prev_depth": (height, width),
        "motion": (height, width, 2),
        "object_id": (height, width),
    }
    if frame.position is not None:
        shapes["position"] = (height, width, 3)
    for name, wanted in shapes.items():
        got = tuple(getattr(frame, name).shape)
        if got != wanted:
            raise SvgfError(f"{name} has shape {got}; wanted {wanted}, to go with radiance {frame.radiance.shape}")
    if tuple(frame.albedo.shape) not in {(signals, height, width, 3), (1, height, width, 3)}:
        raise SvgfError(
            f"albedo has shape {frame.albedo.shape}; wanted {(signals, height, width, 3)}, "
            f"or {(1, height, width, 3)} if all signals share it"
        )
    dtype = frame.radiance.dtype
    if dtype not in (jnp.float32, jnp.float64):
        raise SvgfError(f"radiance is {dtype}; wanted float32 or float64. Try radiance.astype('float32')")
    if frame.variance is not None and tuple(frame.variance.shape) != (signals, height, width):
        raise SvgfError(
            f"variance has shape {tuple(frame.variance.shape)}; wanted {(signals, height, width)}, one plane a signal"
        )
    reflected = {
        "reflected_motion": (signals, height, width, 2),
        "reflected_prev_depth": (signals, height, width),
        "longest_history": (signals, height, width),
    }
    there = {name: tuple(array.shape) for name in reflected if (array := getattr(frame, name)) is not None}
    if there and there != reflected:
        raise SvgfError(f"of reflections there is {there}; wanted {reflected}, or none of them")
    for name, array in frame._asdict().items():
        wanted_dtype = jnp.int32 if name == "object_id" else dtype
        if array is not None and array.dtype != wanted_dtype:
            raise SvgfError(
                f"{name} is {getattr(frame, name).dtype}; wanted {jnp.dtype(wanted_dtype)}, like the rest of the frame"
            )


def check_history(history: History, frame: Frame, config: Config) -> None:
    """Raise `SvgfError` unless the history belongs to frames of this size, dtype and number of signals."""
    signals, height, width, _ = frame.radiance.shape
    shapes = {
        "illumination": (signals, height, width, 3),
        "moments": (signals, height, width, 2),
        "history_length": (height, width),
        "depth": (height, width),
        "normal": (height, width, 3),
        "object_id": (height, width),
        "effective_history": (signals, height, width),
    }
    if (history.taa is not None) != config.taa:
        raise SvgfError(
            f"the history {'lacks' if config.taa else 'has'} a past for temporal anti-aliasing, and taa is {config.taa}; "
            "wanted a history that was started with the same choices: init(frame, config=config)"
        )
    if history.taa is not None and tuple(history.taa.color.shape) != (height, width, 3):
        raise SvgfError(f"the history's taa is of {tuple(history.taa.color.shape)}; wanted {(height, width, 3)}")
    for name, leaf in history._replace(taa=None)._asdict().items():
        if leaf is None:
            continue
        dtype = jnp.int32 if name == "object_id" else frame.radiance.dtype
        if tuple(leaf.shape) != shapes[name] or leaf.dtype != dtype:
            raise SvgfError(
                f"the history's {name} is {leaf.dtype} {tuple(leaf.shape)}; wanted {jnp.dtype(dtype)} {shapes[name]} for "
                "this frame. A history belongs to one sequence: start another with init(frame)"
            )


def check_image(image: Array) -> None:
    """Raise `SvgfError` unless this is one image `[H, W, 3]` of float32 or float64."""
    if image.ndim != 3 or image.shape[-1] != 3 or image.dtype not in (jnp.float32, jnp.float64):
        raise SvgfError(f"the image is {image.dtype} {tuple(image.shape)}; wanted float32 or float64 [H, W, 3]")


def check_taa(history: TaaHistory, image: Array, motion: Array, depth: Array) -> None:
    """Raise `SvgfError` unless the arrays of `taa` fit together."""
    check_image(image)
    height, width, _ = image.shape
    named = {
        "motion": (motion, (height, width, 2)),
        "depth": (depth, (height, width)),
        "history's color": (history.color, (height, width, 3)),
        "history's frames": (history.frames, ()),
    }
    for name, (array, wanted) in named.items():
        if tuple(array.shape) != wanted or array.dtype != image.dtype:
            raise SvgfError(
                f"the {name} is {array.dtype} {tuple(array.shape)}; wanted {image.dtype} {wanted}, to go with the image"
                f"{'. Start another history with taa_init(image)' if name.startswith('history') else ''}"
            )


def check_sequence(frames: Frame) -> None:
    """Raise `SvgfError` unless the arrays have a leading T of one length >= 1."""
    if len(frames.radiance.shape) != 5:
        raise SvgfError(
            f"radiance has shape {tuple(frames.radiance.shape)}; wanted [T, S, H, W, 3], T frames of S signals. "
            "For one frame call step, or add the leading T: jax.tree.map(lambda a: a[None], frame)"
        )
    lengths = {
        name: array.shape[0] if array.shape else 0 for name, array in frames._asdict().items() if array is not None
    }
    if len(set(lengths.values())) != 1 or 0 in lengths.values():
        raise SvgfError(f"the frames' arrays have lengths {lengths}; wanted one length T >= 1 for all")


def check_params(params: Params, config: Config, *, dtype: Any) -> Params:
    """The parameters as arrays of `dtype`; raise `SvgfError` unless each is a scalar or has one value per level."""
    for name, value in config._asdict().items():
        if not is_choice(name, value):
            raise SvgfError(f"{name} is {value!r}; wanted {choices_of(name)}")
    arrays = Params(*(jnp.asarray(leaf, dtype) for leaf in params))
    for name, leaf in arrays._asdict().items():
        if leaf.ndim != 0 and leaf.shape != (max(config.levels, 1),):
            raise SvgfError(
                f"{name} has shape {leaf.shape}; wanted a scalar, or one value for each of the {config.levels} levels"
            )
    return arrays
