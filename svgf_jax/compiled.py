"""The filter compiled for a device, with its parameters there. Imports JAX when first used, not before."""

from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from functools import cache, partial
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from svgf_jax import memory
from svgf_jax.methods import MethodConfig
from svgf_jax.types import Config, Frame, History, Output, SvgfError

Result = TypeVar("Result")

# The same bits, sooner and in less memory: vectors as wide as the processor has them, not half as wide (a tenth of the time), and
# work in the order that holds least at once (a third to two fifths less of a step's own memory, 2 % of the time).
LEAN = {"xla_cpu_prefer_vector_width": 512, "xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"}

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
    devices: int = 1,
    leave_out: tuple[str, ...] = (),
    effective_history: bool = False,
) -> Filters:
    """The jitted filter with its parameters on the device.

    `device` is "cpu", "gpu:1", ..., None = JAX's default; `pipeline` is `(init, step)`, None = that of which `config` is;
    `devices`: so many of the kind share the rows of each frame (of SVGF only, see `check_devices`);
    `leave_out` names fields of `Output` that nobody will read: they are None, and need no memory;
    `effective_history`: of SVGF, keep it, as `svgf_jax.init` does.
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
    chosen = _devices(device, devices)
    numbers = type(params)(*(np.asarray(value, np.float32) for value in params))
    if devices == 1:
        put = partial(jax.device_put, device=chosen[0])
        numbers = put(numbers)
    else:
        from svgf_jax.devices import spread

        put = partial(spread, devices=chosen, config=cast(Config, config))  # `check_devices` saw to it
    asked = effective_history and pipeline is None and isinstance(config, Config)
    jitted_init, jitted_step = _jitted(init, step, config, leave_out, chosen, asked)
    compiled = False

    def begun(frame: Frame) -> History:
        with jax.default_device(chosen[0]):  # for `sampling.on_cpu`
            return jitted_init(put(frame))

    def filtered(history: History, frame: Frame) -> tuple[History, Output]:
        nonlocal compiled
        arguments = (*put((history, frame)), numbers)
        with jax.default_device(chosen[0]):
            if not compiled:  # apart, so that its memory is given back before the frame needs its own
                jitted_step.lower(*arguments).compile()
                memory.give_back()
                compiled = True
            return jitted_step(*arguments)

    return Filters(
        init=begun,
        step=filtered,
        device=f"{f'{devices} x ' if devices > 1 else ''}{chosen[0].platform}: {chosen[0].device_kind}",
    )


def check_devices(config: Config | MethodConfig, device: str | None, devices: int) -> None:
    """Raise SvgfError where frames could not be divided over so many devices, before JAX is asked."""
    if devices < 1:
        raise SvgfError(f"Got {devices} devices; wanted 1 or more.")
    if devices > 1 and isinstance(config, MethodConfig):
        raise SvgfError(f"Got {devices} devices for another method than svgf; wanted 1: only svgf divides a frame.")
    if devices > 1 and ":" in (device or ""):
        raise SvgfError(f"Got device {device} and {devices} devices; wanted a kind, cpu or gpu, or one device.")


@cache
def _jitted(
    init: Callable[..., History],
    step: Callable[..., Any],
    config: Config | MethodConfig,
    leave_out: tuple[str, ...],
    devices: tuple[Any, ...],
    effective_history: bool,
) -> tuple[Callable[..., Any], Any]:
    """Compiled once a process, however many sequences it denoises."""
    import jax

    options = compiler_options(devices[0].platform)
    if len(devices) > 1:
        from svgf_jax.devices import step_over

        step = partial(cast(Any, step_over), devices=devices)
    asked: dict[str, Any] = {"config": config} if getattr(config, "taa", False) else {}
    if effective_history:
        asked["effective_history"] = True
    start = partial(init, **asked) if asked else init  # other pipelines know nothing of these

    def go(history: History, frame: Frame, params: Any) -> tuple[History, Output]:
        history, output = step(history, frame, params=params, config=config)
        return history, output._replace(**dict.fromkeys(leave_out))

    return jax.jit(start), jax.jit(go, donate_argnums=0, compiler_options=options)


@cache
def compiler_options(platform: str) -> dict[str, Any]:
    """What `jax.jit` is told for this kind of device ("cpu", "gpu"): of `LEAN` what its compiler knows; nothing for others."""
    import jax

    def knows(option: dict[str, Any]) -> bool:
        try:
            jax.jit(lambda a: a, compiler_options=option).lower(np.float32(0)).compile()
        except (RuntimeError, ValueError):  # a compiler of another year
            return False
        return True

    return {name: value for name, value in LEAN.items() if platform == "cpu" and knows({name: value})}


def _devices(name: str | None, count: int) -> tuple[Any, ...]:
    """The JAX device called "cpu", "gpu:1", ..., the default one for None; or so many of the kind."""
    import jax

    if count > 1:
        with suppress(RuntimeError):  # JAX has started: it has the CPUs that it has
            jax.config.update("jax_num_cpu_devices", count)
    platform, _, number = (name or "").partition(":")
    try:
        first = jax.devices(platform or None)[int(number or 0)]
    except (RuntimeError, IndexError, ValueError) as error:
        there = ", ".join(
            sorted({f"{device.platform}:{device.id}" for device in [*jax.devices(), *jax.devices("cpu")]})
        )
        raise SvgfError(
            f"There is no device {name!r} here; there is {there}. Try one of these, or leave it out."
        ) from error
    if count == 1:
        return (first,)
    there = jax.local_devices(backend=first.platform)
    if len(there) < count:
        raise SvgfError(
            f"Got {count} devices; there are {len(there)} ({first.device_kind}). Try --devices {len(there)}, and for CPUs set "
            "JAX_NUM_CPU_DEVICES before JAX starts."
        )
    return tuple(there[:count])


def to_host(result: Result, name: str) -> Result:
    """An output, a history or some arrays as NumPy arrays of their own; waits for them.

    `name` says whose it is if the device's memory ran out (SvgfError).
    """
    import jax

    with _enough_memory(name):
        return jax.tree.map(np.array, result)


def wait(result: Result, name: str) -> Result:
    """The same result once it is there. Raises as `to_host`."""
    import jax

    with _enough_memory(name):
        return jax.block_until_ready(result)


@contextmanager
def _enough_memory(name: str) -> Generator[None]:
    import jax

    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        raise SvgfError(
            f"{name}: the device has not enough memory for a frame of this size. Try --device cpu, or crop the frames."
        ) from error
