"""What SVGF grew from, frame by frame as `pipeline` does it: a filter of each frame alone, then project and accumulate.

With the numbers of GAMES202's homework 5 (2021), steps in its order:

1. filter the frame (`joint_bilateral`),
2. fetch the accumulated color of the frame before from the nearest pixel, if it is on the screen and shows the same object,
3. clamp that to mean +- k standard deviations of the filtered frame over 7 x 7 pixels,
4. color = alpha filtered + (1 - alpha) clamped; alpha = 1 where there is no history.

Steps 2 to 4 are SVGF's own stages with other choices. What differs from the handout: a pixel without a surface counts in no window
and passes through as it is.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from svgf_jax.accumulation import accumulate, clamp_history
from svgf_jax.check import check_frame, check_history, check_sequence
from svgf_jax.color import demodulate
from svgf_jax.joint_bilateral import bilateral_filter, gaussian_filter, joint_bilateral_filter
from svgf_jax.methods import OVER_TIME, Games202Params, MethodConfig, check_method_config
from svgf_jax.modulation import modulate
from svgf_jax.pipeline import init
from svgf_jax.reprojection import reproject
from svgf_jax.sanitation import sanitise
from svgf_jax.types import Config, Frame, History, Output, Params, SvgfError


def baseline_init(frame: Frame) -> History:
    """The empty history that a sequence starts with, of one signal. Only the shapes and the dtype of `frame` matter."""
    check_frame(frame)
    return init(frame._replace(radiance=frame.radiance[:1], albedo=frame.albedo[:1], variance=None))


@partial(jax.jit, static_argnames="config")
def baseline_step(
    history: History, frame: Frame, *, params: Any = Games202Params(), config: MethodConfig = MethodConfig()
) -> tuple[History, Output]:
    """Filter one frame.

    Args:
        history: of the frame before; `baseline_init(frame)` at the start or after a cut.
        frame: one frame, as for `step`; its signals are added up. The joint bilateral filter also reads its `position`.
        params: the method's numbers, traced scalars.
        config: its static choices; `methods.method(name)` has both.

    Returns:
        The history for the next frame, and this frame's output. `Output.variance` and `variance_filtered` are None.

    Raises:
        SvgfError: shapes or dtypes that do not fit together, a frame without position, an albedo for each signal where
            `config.demodulate`.
    """
    history, frame = jax.tree.map(jnp.asarray, (history, frame))
    check_frame(frame)
    check_method_config(config)
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, frame.radiance.dtype), params)

    frame, rejected = sanitise(frame)
    frame = one_signal(frame, config=config)
    check_history(history, frame, Config())
    color = filter_alone(demodulate(frame.radiance, frame.albedo), frame, params=params, config=config)
    length, valid = (frame.object_id != -1).astype(color.dtype), jnp.zeros_like(frame.object_id, bool)
    if config.temporal:
        numbers, choices = as_svgf(params, config)
        previous = reproject(history, frame, params=numbers, config=choices)
        previous = clamp_history(previous, color, frame, params=numbers, config=choices)
        accumulated = accumulate(color, previous, frame, params=numbers, config=choices)
        color, length, valid = accumulated.illumination, accumulated.history_length, previous.valid
        history = History(*accumulated, depth=frame.depth, normal=frame.normal, object_id=frame.object_id)
    return history, Output(
        image=modulate(color, frame),
        illumination=color,
        variance=None,
        variance_filtered=None,
        history_length=length,
        valid=valid,
        rejected=rejected,
    )


@partial(jax.jit, static_argnames="config")
def baseline_denoise(
    frames: Frame,
    *,
    history: History | None = None,
    params: Any = Games202Params(),
    config: MethodConfig = MethodConfig(),
) -> tuple[History, Output]:
    """Filter a sequence: `baseline_step` in `lax.scan`, bit for bit what it gives frame by frame. Arguments as for `denoise`."""
    check_sequence(frames)
    if history is None:
        history = baseline_init(jax.tree.map(lambda a: a[0], frames))
    body = jax.checkpoint(partial(baseline_step, params=params, config=config), prevent_cse=False)
    return lax.scan(body, history, frames)


def one_signal(frame: Frame, *, config: MethodConfig) -> Frame:
    """A sanitised frame with its signals added up: the beauty, or with `config.demodulate` the reflected radiance."""
    reflected = frame.radiance.sum(axis=0, keepdims=True)
    if not config.demodulate:
        beauty = reflected + frame.emission[None]
        return frame._replace(
            radiance=beauty, albedo=jnp.ones_like(beauty), emission=jnp.zeros_like(frame.emission), variance=None
        )
    if frame.albedo.shape[0] != 1:
        raise SvgfError(
            f"demodulate wants one albedo for all signals; got {frame.albedo.shape[0]} of them. Leave demodulate off."
        )
    return frame._replace(radiance=reflected, variance=None)


def filter_alone(color: Array, frame: Frame, *, params: Any, config: MethodConfig) -> Array:
    """`config.filter` on the color `[1, H, W, 3]` of one frame."""
    window = {name: getattr(config, name) for name in ("radius", "footprint", "levels", "last_pass")}
    window["mask"] = frame.object_id != -1
    if config.filter == "none":
        return color
    if config.filter == "gaussian":
        return gaussian_filter(color[0], sigma=params.sigma_space, **window)[None]
    if config.filter == "bilateral":
        return bilateral_filter(color[0], sigma_space=params.sigma_space, sigma_color=params.sigma_color, **window)[
            None
        ]
    if frame.position is None:
        raise SvgfError(
            "The joint bilateral filter reads Frame.position, and it is None; "
            "try load_sequence(..., position=True) or open_source(..., position=True)."
        )
    return joint_bilateral_filter(
        color[0],
        normal=frame.normal,
        position=frame.position,
        sigma_space=params.sigma_space,
        sigma_color=params.sigma_color,
        sigma_normal=params.sigma_normal,
        sigma_plane=params.sigma_plane,
        **window,
    )[None]


def as_svgf(params: Any, config: MethodConfig) -> tuple[Params, Config]:
    """The same reprojection and accumulation in the terms of SVGF's stages: depth and normals pass every test."""
    numbers = Params(
        alpha=params.alpha,
        alpha_moments=params.alpha,
        clamp_sigma=params.clamp_sigma,
        reproject_depth=jnp.inf,
        reproject_normal=-2.0,
    )
    shared = {name: getattr(config, name) for name in OVER_TIME}
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, params.alpha.dtype), numbers), Config(**shared)
