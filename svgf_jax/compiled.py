"""The filter compiled for a device, with its parameters there. Imports JAX when first used, not before."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from svgf_jax.methods import MethodConfig
from svgf_jax.types import Config, Frame, History, Output, SvgfError

Pipeline = tuple[Callable[..., History], Callable[..., tuple[History, Output]]]  # init, step


class Filters(NamedTuple):
    """`init(frame)` and `step(history, frame)` of NumPy or JAX arrays, and what they run on."""

    init: Callable[[Frame], History]
    step: Callable[[History, Frame], tuple[History, Output]]
    device: str


def compile_filters(
    params: Any, config: Config | MethodConfig, *, device: str | None, pipeline: Pipeline | None
) -> Filters:
    """The jitted filter with its parameters on the device.

    `device` is "cpu", "gpu:1", ..., None = JAX's default; `pipeline` is `(init, step)`, None = that of which `config` is.
    Raises SvgfError where there is no such device.
    """
    import jax

    if pipeline is not None:
        init, step = pipeline
    elif isinstance(config, MethodConfig):
        from svgf_jax.baselines import baseline_init as init
        from svgf_jax.baselines import baseline_step as step
    else:
        from svgf_jax.pipeline import init, step
    chosen = _device(device)
    on_device = jax.device_put(type(params)(*(np.asarray(value, np.float32) for value in params)), chosen)
    jitted_init, jitted_step = _jitted(init, step, config)
    return Filters(
        init=lambda frame: jitted_init(jax.device_put(frame, chosen)),
        step=lambda history, frame: jitted_step(*jax.device_put((history, frame), chosen), on_device),
        device=f"{chosen.platform}: {chosen.device_kind}",
    )


@cache
def _jitted(
    init: Callable[..., History], step: Callable[..., Any], config: Config | MethodConfig
) -> tuple[Callable, Callable]:
    """Compiled once a process, however many sequences it denoises."""
    import jax

    start = (
        partial(init, config=config) if getattr(config, "taa", False) else init
    )  # other pipelines know nothing of it
    return jax.jit(start), jax.jit(lambda history, frame, params: step(history, frame, params=params, config=config))


def _device(name: str | None) -> Any:
    """The JAX device called "cpu", "gpu:1", ...; the default one for None."""
    import jax

    platform, _, number = (name or "").partition(":")
    try:
        return jax.devices(platform or None)[int(number or 0)]
    except (RuntimeError, IndexError, ValueError) as error:
        there = ", ".join(
            sorted({f"{device.platform}:{device.id}" for device in [*jax.devices(), *jax.devices("cpu")]})
        )
        raise SvgfError(
            f"There is no device {name!r} here; there is {there}. Try one of these, or leave it out."
        ) from error


def to_host(output: Any, name: str) -> Any:
    """An output, or some of its arrays, as NumPy arrays; waits for them.

    `name` says whose it is if the device's memory ran out (SvgfError).
    """
    import jax

    try:
        return jax.tree.map(np.asarray, output)
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        raise SvgfError(
            f"{name}: the device has not enough memory for a frame of this size. Try --device cpu, or crop the frames."
        ) from error
