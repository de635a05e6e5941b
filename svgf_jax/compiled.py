"""The filter compiled for a device, with its parameters there. Imports JAX when first used, not before."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple, TypeVar

import numpy as np

from svgf_jax.methods import MethodConfig
from svgf_jax.types import Config, Frame, History, Output, SvgfError

Result = TypeVar("Result")

Pipeline = tuple[Callable[..., History], Callable[..., tuple[History, Output]]]  # init, step


class Filters(NamedTuple):
    """`init(frame)` and `step(history, frame)` of NumPy or JAX arrays, and what they run on.

    `step` takes the history's memory for the new one: what was passed in must not be read again.
    """

    init: Callable[[Frame], History]
    step: Callable[[History, Frame], tuple[History, Output]]
    device: str


def compile_filters(
    params: Any,
    config: Config | MethodConfig,
    *,
    device: str | None,
    pipeline: Pipeline | None,
    leave_out: tuple[str, ...] = (),
) -> Filters:
    """The jitted filter with its parameters on the device.

    `device` is "cpu", "gpu:1", ..., None = JAX's default; `pipeline` is `(init, step)`, None = that of which `config` is;
    `leave_out` names fields of `Output` that nobody will read: they are None, and need no memory.
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
    jitted_init, jitted_step = _jitted(init, step, config, leave_out)
    return Filters(
        init=lambda frame: jitted_init(jax.device_put(frame, chosen)),
        step=lambda history, frame: jitted_step(*jax.device_put((history, frame), chosen), on_device),
        device=f"{chosen.platform}: {chosen.device_kind}",
    )


@cache
def _jitted(
    init: Callable[..., History], step: Callable[..., Any], config: Config | MethodConfig, leave_out: tuple[str, ...]
) -> tuple[Callable, Callable]:
    """Compiled once a process, however many sequences it denoises."""
    import jax

    start = (
        partial(init, config=config) if getattr(config, "taa", False) else init
    )  # other pipelines know nothing of it

    def go(history: History, frame: Frame, params: Any) -> tuple[History, Output]:
        history, output = step(history, frame, params=params, config=config)
        return history, output._replace(**dict.fromkeys(leave_out))

    return jax.jit(start), jax.jit(go, donate_argnums=0)


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


def to_host(result: Result, name: str) -> Result:
    """An output, a history or some arrays as NumPy arrays of their own; waits for them.

    `name` says whose it is if the device's memory ran out (SvgfError).
    """
    import jax

    try:
        return jax.tree.map(np.array, result)
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        raise SvgfError(
            f"{name}: the device has not enough memory for a frame of this size. Try --device cpu, or crop the frames."
        ) from error
