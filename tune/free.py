"""Free coordinates: any real number is a valid parameter, so that a solver without bounds can't leave them.

Scales (0, inf) are free in their logarithm, blends and cosines (least, most) in their logit, factors (1, inf) in the logarithm
of what they exceed 1 by. One free number moves one scalar parameter, or one level of a per-level one.
"""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from svgf_jax import Config, Params, SvgfError
from svgf_jax.parameters import BOUNDS, suggest
from svgf_jax.types import unread

TUNED_BY_DEFAULT = (
    "alpha",
    "alpha_moments",
    "sigma_depth",
    "sigma_normal",
    "sigma_luminance",
    "depth_epsilon",
    "kernel_near",
    "kernel_far",
)
PER_LEVEL = (
    "sigma_depth",
    "sigma_normal",
    "sigma_luminance",
    "depth_epsilon",
    "luminance_epsilon",
    "kernel_near",
    "kernel_far",
)
"""The parameters that each a-trous level reads for itself."""
GATES = ("reproject_depth", "reproject_normal")
"""Thresholds of a yes-or-no test: no derivative, but one can be taken across a step that many pixels fall into."""

_INSIDE = 0.25  # where a start that lies on a bound is moved to, in units of the bound's scale


class Free(NamedTuple):
    """One free number: a parameter, or one level of it (`level` None = it is a scalar)."""

    name: str
    level: int | None = None

    @property
    def label(self) -> str:
        """`alpha`, `sigma_luminance[2]`."""
        return self.name if self.level is None else f"{self.name}[{self.level}]"


class Coordinates(NamedTuple):
    """Which numbers of `start` are free.

    Attributes:
        start: NumPy scalars or per-level vectors, float64; what is not free keeps its value.
        config: static choices.
        free: the free numbers, in the order of the coordinate vector.
        notes: what had to be moved to be free, as sentences.
    """

    start: Params
    config: Config
    free: tuple[Free, ...]
    notes: tuple[str, ...]

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of the free numbers."""
        return tuple(free.label for free in self.free)


def choose(
    params: Params,
    config: Config,
    *,
    names: Iterable[str] = TUNED_BY_DEFAULT,
    per_level: bool | Iterable[str] = False,
    freeze: Iterable[str] = (),
) -> Coordinates:
    """Settle which numbers of `params` are free.

    Args:
        params, config: the start.
        names: parameters, or single levels of them (`sigma_luminance[2]`); `all` = every parameter that is read.
        per_level: True = one number a level for each of `names` that the a-trous levels read; or the names for which.
        freeze: names or labels taken off again.

    Raises:
        SvgfError: unknown names, no such level, a parameter that has no levels, nothing left to tune.
    """
    names, freeze = tuple(names), tuple(freeze)
    names = tuple(name for name in BOUNDS if name not in unread(config)) if names == ("all",) else names
    wanted = [(name, level) for name, level in map(_parse, names)]
    frozen = {_parse(name) for name in freeze}
    if idle := [name for name, _ in wanted if name in unread(config)]:
        raise SvgfError(
            f"nothing reads {', '.join(idle)} with these choices: {config}; tune others, or change the choice"
        )
    if per_level is True:
        split = set(PER_LEVEL)
    else:
        split = {_parse(name)[0] for name in (per_level or ())}
        if wrong := sorted(split - set(PER_LEVEL)):
            raise SvgfError(
                f"{', '.join(wrong)} can't be tuned per level: only the a-trous levels' {', '.join(PER_LEVEL)}"
            )
    leaves = {name: np.asarray(value, np.float64) for name, value in params._asdict().items()}
    entries: list[Free] = []
    for name, level in wanted:
        if level is not None and (name not in PER_LEVEL or level >= config.levels):
            raise SvgfError(f"no level {level} of {name}; there are {config.levels} levels, of {', '.join(PER_LEVEL)}")
        if (level is not None or name in split) and leaves[name].ndim == 0:
            leaves[name] = np.full(max(config.levels, 1), float(leaves[name]))
        levels = [level] if level is not None else [None] if leaves[name].ndim == 0 else range(leaves[name].size)
        entries += [Free(name, i) for i in levels]
    entries = [e for e in dict.fromkeys(entries) if (e.name, None) not in frozen and (e.name, e.level) not in frozen]
    if not entries:
        raise SvgfError(
            f"nothing is left to tune of {', '.join(names)} without {', '.join(freeze)}; name at least one parameter"
        )
    notes = [note for e in entries if (note := _move_inside(leaves, e))]
    return Coordinates(Params(**leaves), config, tuple(entries), tuple(notes))


def to_free(params: Params, coordinates: Coordinates) -> np.ndarray:
    """The free coordinates `[n]` float64 of `params`, which must lie inside the bounds."""
    return np.array([_forward(e.name, float(_entry(getattr(params, e.name), e.level))) for e in coordinates.free])


def from_free(y: Array, start: Params, free: tuple[Free, ...]) -> Params:
    """`start` with the numbers `free` at the coordinates `y` `[n]`, differentiable; in the dtype of `y`."""
    leaves: dict[str, Any] = {name: jnp.asarray(value, y.dtype) for name, value in start._asdict().items()}
    for i, e in enumerate(free):
        value = _inverse(e.name, y[i])
        leaves[e.name] = value if e.level is None else leaves[e.name].at[e.level].set(value)
    return Params(**leaves)


def natural(y: np.ndarray, coordinates: Coordinates) -> np.ndarray:
    """The values `[n]` of the free numbers in their own units, float64."""
    return np.array([_inverse_host(e.name, float(v)) for e, v in zip(coordinates.free, y, strict=True)])


def params_at(y: np.ndarray, coordinates: Coordinates) -> Params:
    """`from_free` in NumPy float64: Python floats and per-level vectors."""
    leaves: dict[str, Any] = {
        name: float(value) if np.ndim(value) == 0 else np.array(value)
        for name, value in coordinates.start._asdict().items()
    }
    for e, value in zip(coordinates.free, natural(y, coordinates), strict=True):
        if e.level is None:
            leaves[e.name] = float(value)
        else:
            leaves[e.name][e.level] = value
    return Params(**leaves)


def slope(y: np.ndarray, coordinates: Coordinates) -> np.ndarray:
    """d value / d coordinate `[n]`: what turns a standard error of the coordinate into one of the parameter."""
    slopes = []
    for e, value in zip(coordinates.free, natural(y, coordinates), strict=True):
        least, most = BOUNDS[e.name]
        slopes.append(value - least if math.isinf(most) else (value - least) * (most - value) / (most - least))
    return np.array(slopes)


def _forward(name: str, value: float) -> float:
    least, most = BOUNDS[name]
    return math.log(value - least) if math.isinf(most) else math.log((value - least) / (most - value))


def _inverse(name: str, y: Array) -> Array:
    least, most = BOUNDS[name]
    if math.isinf(most):
        return least + jnp.exp(jnp.clip(y, -60.0, 60.0))  # within float32
    return least + (most - least) / (1.0 + jnp.exp(-jnp.clip(y, -60.0, 60.0)))


def _inverse_host(name: str, y: float) -> float:
    least, most = BOUNDS[name]
    y = min(max(y, -60.0), 60.0)
    return least + math.exp(y) if math.isinf(most) else least + (most - least) / (1.0 + math.exp(-y))


def _move_inside(leaves: dict[str, np.ndarray], e: Free) -> str | None:
    least, most = BOUNDS[e.name]
    value = float(_entry(leaves[e.name], e.level))
    if least < value < most:
        return None
    inside = (
        least + _INSIDE if math.isinf(most) else least + (most - least) * (_INSIDE if value <= least else 1 - _INSIDE)
    )
    if e.level is None:
        leaves[e.name] = np.asarray(inside)
    else:
        leaves[e.name][e.level] = inside
    return f"{e.label} = {value:g} lies on its bound, where it can't move; the fit starts at {inside:g}."


def _entry(value: Any, level: int | None) -> Any:
    value = np.asarray(value, np.float64)
    return value if value.ndim == 0 else value[level or 0]


def _parse(label: str) -> tuple[str, int | None]:
    name, bracket, rest = label.strip().partition("[")
    if name not in BOUNDS:
        raise SvgfError(f"no parameter {name!r} to tune; there are {', '.join(BOUNDS)}{suggest(name, BOUNDS)}")
    if not bracket:
        return name, None
    if not rest.endswith("]") or not rest[:-1].isdigit():
        raise SvgfError(f"got {label!r}; wanted a name, or one level of it such as {name}[2]")
    return name, int(rest[:-1])
