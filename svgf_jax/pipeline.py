"""The filter, step by step as in figure 1 of Schied et al. 2017: (history, frame) -> (history, output)."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from svgf_jax.accumulation import accumulate, clamp_history, effective_history
from svgf_jax.adaptation import follow_light
from svgf_jax.antialiasing import taa, taa_init
from svgf_jax.atrous import atrous_filter
from svgf_jax.check import check_frame, check_history, check_params, check_sequence
from svgf_jax.color import demodulate
from svgf_jax.modulation import modulate
from svgf_jax.outliers import remove_outliers
from svgf_jax.reprojection import reproject, reproject_reflections
from svgf_jax.sanitation import sanitise
from svgf_jax.types import Config, Frame, History, Output, Params, at_level
from svgf_jax.variance import estimate_variance


def init(frame: Frame, *, config: Config = Config(), effective_history: bool = False) -> History:
    """The empty history that a sequence starts with.

    Args:
        frame: only its shapes and its dtype matter.
        config: only its `taa` matters.
        effective_history: also keep, from frame to frame, how many frames each signal's history is worth: the output of the
            same name, else None. It changes nothing else, and takes about 5 % more time.
    """
    check_frame(frame)
    signals, height, width, _ = frame.radiance.shape
    dtype = frame.radiance.dtype
    return History(
        illumination=jnp.zeros((signals, height, width, 3), dtype),
        moments=jnp.zeros((signals, height, width, 2), dtype),
        history_length=jnp.zeros((height, width), dtype),
        depth=jnp.zeros((height, width), dtype),
        normal=jnp.zeros((height, width, 3), dtype),
        object_id=jnp.full((height, width), -1, jnp.int32),
        taa=taa_init(frame.emission) if config.taa else None,
        effective_history=jnp.zeros((signals, height, width), dtype) if effective_history else None,
    )


@partial(jax.jit, static_argnames="config")
def step(
    history: History, frame: Frame, *, params: Params = Params(), config: Config = Config()
) -> tuple[History, Output]:
    """Filter one frame.

    Args:
        history: of the frame before; `init(frame, config=config)` at the start or after a cut.
        frame: one frame, float32 or float64 throughout; shapes and units as in `Frame`. Bad pixels are repaired and counted.
        params: the filter's numbers, traced: scalars or one value per a-trous level.
        config: the filter's static choices.

    Returns:
        The history for the next frame, and this frame's output.

    Raises:
        SvgfError: shapes or dtypes that do not fit together.
    """
    history, frame = jax.tree.map(jnp.asarray, (history, frame))
    check_frame(frame)
    check_history(history, frame, config)
    params = check_params(params, config, dtype=frame.radiance.dtype)
    floor = at_level(params, 0).albedo_floor

    motion = frame.motion  # the background's too
    frame, rejected = sanitise(frame)
    illumination = demodulate(frame.radiance, frame.albedo, albedo_floor=floor)
    illumination = remove_outliers(illumination, frame, params=params, config=config)
    previous = reproject(history, frame, params=params, config=config)
    previous = reproject_reflections(previous, history, frame, params=params, config=config)
    previous = follow_light(previous, illumination, frame, params=params, config=config)
    previous = clamp_history(previous, illumination, frame, params=params, config=config)
    accumulated = accumulate(illumination, previous, frame, params=params, config=config)
    worth = effective_history(previous, accumulated.history_length, frame, params=params, config=config)
    variance = estimate_variance(accumulated.moments, accumulated.history_length, frame, params=params, config=config)
    filtered, variance_filtered, feedback = atrous_filter(
        accumulated.illumination, variance, frame, params=params, config=config
    )
    image = modulate(filtered, frame, albedo_floor=floor)
    past, display = history.taa, None
    if past is not None:
        past, image = taa(past, image, motion, frame.depth, params=params)
        display = past.color

    history = History(
        illumination=feedback,
        moments=accumulated.moments,
        history_length=accumulated.history_length,
        depth=frame.depth,
        normal=frame.normal,
        object_id=frame.object_id,
        taa=past,
        effective_history=worth,
    )
    return history, Output(
        image=image,
        illumination=filtered,
        variance=variance,
        variance_filtered=variance_filtered,
        history_length=accumulated.history_length,
        valid=previous.valid,
        rejected=rejected,
        display=display,
        change=previous.change,
        effective_history=worth,
    )


@partial(jax.jit, static_argnames="config")
def denoise(
    frames: Frame, *, history: History | None = None, params: Params = Params(), config: Config = Config()
) -> tuple[History, Output]:
    """Filter a sequence: `step` in `lax.scan`, bit for bit what `step` gives frame by frame.

    Args:
        frames: a `Frame` whose arrays have a leading T.
        history: of the frame before the first; None = start afresh.
        params, config: as for `step`.

    Returns:
        The history after the last frame (to go on with), and the outputs with a leading T.
    """
    check_sequence(frames)
    if history is None:
        history = init(jax.tree.map(lambda a: a[0], frames), config=config)
    # Recompute a frame in reverse mode rather than store what happened inside it.
    body = jax.checkpoint(partial(step, params=params, config=config), prevent_cse=False)
    return lax.scan(body, history, frames)
