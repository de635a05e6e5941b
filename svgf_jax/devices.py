"""One frame over many devices: each filters some of the rows, and fetches from the others what its filters reach for.

The stages know nothing of it; `svgf_jax.sampling`, through which they read all other pixels, does. Neighbours' rows go from device
to device, as many as a filter reaches; the history goes to all, since motion may lead anywhere. A height that the devices don't
divide is made up with rows without a surface, which no pixel of the image ever reads.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from svgf_jax.check import check_frame, check_history
from svgf_jax.pipeline import step
from svgf_jax.sampling import DIVIDED
from svgf_jax.types import Config, Frame, History, Output, Params, SvgfError

_PER_SIGNAL = {  # `[S, H, ...]`; all others are `[H, ...]` or scalars
    *("radiance", "albedo", "variance", "reflected_motion", "reflected_prev_depth", "longest_history"),
    *("illumination", "moments", "variance_filtered", "change", "effective_history"),
}


def step_over(
    history: History,
    frame: Frame,
    *,
    devices: Sequence[Any],
    params: Params = Params(),
    config: Config = Config(),
) -> tuple[History, Output]:
    """`svgf_jax.step` with the rows of the frame divided over devices: the same to rounding, and as differentiable.

    Args:
        history, frame, params, config: as for `step`.
        devices: of one kind, for example `jax.devices()`; on CPUs there is one unless JAX_NUM_CPU_DEVICES says otherwise.

    Returns:
        As `step`. The arrays lie on the devices, divided too where they divide the height (and with `light_cell` its cells); else
        each device has the whole.

    Raises:
        SvgfError: shapes or dtypes that do not fit together, no devices.
    """
    if not devices:
        raise SvgfError("devices is empty; wanted one or more, for example jax.devices()")
    check_frame(frame)
    check_history(history, frame, config)
    history, frame = spread((history, frame), devices=devices, config=config)
    return _step(history, frame, params, config=config, devices=tuple(devices))


def spread(tree: Any, *, devices: Sequence[Any], config: Config) -> Any:
    """Histories and frames brought to where `step_over` wants them: its compiler then sees the same in every frame."""
    tree = jax.tree.map(jnp.asarray, tree)
    height = next(leaf for leaf in jax.tree.leaves(tree) if leaf.ndim > 2).shape[-3]
    even = height == rows_of_each(height, len(devices), config) * len(devices)
    mesh, axis = _mesh(height, devices)

    def put(array, axis_of_rows: int | None, axis: str, name: str):
        spec = _spec(array, axis_of_rows, axis, name) if even else PartitionSpec()
        return jax.device_put(array, NamedSharding(mesh, spec))

    return _over_rows(put, tree, axis)


def _mesh(height: int, devices: Sequence[Any]) -> tuple[Mesh, str]:
    axis = f"{DIVIDED}{height}"
    return Mesh(np.asarray(devices), (axis,)), axis


@partial(jax.jit, static_argnames=("config", "devices"))
def _step(
    history: History, frame: Frame, params: Params, *, config: Config, devices: tuple[Any, ...]
) -> tuple[History, Output]:
    height = frame.depth.shape[0]
    rows = rows_of_each(height, len(devices), config)
    mesh, axis = _mesh(height, devices)
    results = jax.eval_shape(partial(step, config=config), history, frame, params=params)
    given = (history, frame)
    divided = jax.shard_map(
        lambda given, params: step(*given, params=params, config=config),
        mesh=mesh,
        in_specs=(_over_rows(_spec, given, axis), PartitionSpec()),
        out_specs=_over_rows(_spec, results, axis),
        check_vma=False,
    )
    extended = _over_rows(_extend, given, rows * len(devices))
    return _over_rows(_cut, divided(extended, params), height)


def rows_of_each(height: int, devices: int, config: Config) -> int:
    """How many rows each device gets: whole cells of `light_cell` pixels."""
    cell = max(config.light_cell, 1)
    return -(-height // (devices * cell)) * cell


def _over_rows(function: Callable[..., Any], tree: Any, value: int | str) -> Any:
    """`function(array, axis of the rows, value, name)` of each array of a tree of named tuples; axis None: it has none."""
    if not hasattr(tree, "_asdict"):
        return tuple(_over_rows(function, part, value) for part in tree)

    def one(name: str, leaf):
        if leaf is None or hasattr(leaf, "_asdict"):
            return None if leaf is None else _over_rows(function, leaf, value)
        return function(leaf, None if leaf.ndim == 0 else int(name in _PER_SIGNAL), value, name)

    return type(tree)(**{name: one(name, leaf) for name, leaf in tree._asdict().items()})


def _spec(array, axis: int | None, name: str, _: str) -> PartitionSpec:
    return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, name)


def _extend(array, axis: int | None, height: int, name: str):
    """With rows without a surface below."""
    if axis is None or array.shape[axis] == height:
        return array
    more = [(0, height - array.shape[axis]) if i == axis else (0, 0) for i in range(array.ndim)]
    return jnp.pad(array, more, constant_values=-1 if name == "object_id" else 0)


def _cut(array, axis: int | None, height: int, _: str):
    return array if axis is None else jax.lax.slice_in_dim(array, 0, height, axis=axis)
