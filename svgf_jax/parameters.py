"""Presets and parameter files.

A parameter file is TOML:

    schema = 1                  # of this file; optional
    preset = "paper"            # where values come from that are not given below; optional

    [params]                    # numbers of `Params`: one value, or one per a-trous level
    alpha = 0.4
    sigma_luminance = [4.0, 3.5, 3.0, 3.0, 2.5]

    [config]                    # static choices of `Config`
    levels = 5

    [provenance]                # free: what it was tuned on, when, with which version, error before and after
"""

import difflib
import math
import os
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import tomli_w

from svgf_jax import atomic
from svgf_jax.toml import TomlFile, place, read_toml
from svgf_jax.types import Config, Params, SvgfError, bounds_of, choices_of, is_choice

SCHEMA = 1
"""The kind of parameter file that is written here, and the only one that is read."""

PRESETS: dict[str, tuple[Params, Config]] = {
    "paper": (Params(), Config()),
    "falcor": (
        Params(alpha=0.05, sigma_luminance=10.0, short_history_boost=4.0),
        Config(levels=4, feedback_level=1),
    ),
    # Fitted by svgf-tune from `paper` to three one-sample sequences; see svgf_jax/docs/tuning.md.
    "tuned": (
        Params(
            alpha=0.886,
            alpha_moments=0.309,
            sigma_depth=0.174,
            sigma_normal=(6.9, 10.1, 68.9, 117.0, 35.8),
            sigma_luminance=(447.0, 12.95, 6.4, 6.36, 7.23),
            depth_epsilon=0.0383,
            kernel_near=(0.746, 0.835, 0.783, 0.632, 0.825),
            kernel_far=0.215,
        ),
        Config(),
    ),
    "adaptive": (
        Params(
            alpha=0.35,
            sigma_depth=0.6,
            sigma_normal=(4.0, 6.0, 32.0, 64.0, 32.0),
            sigma_luminance=(40.0, 10.0, 3.5, 2.5, 2.5),
            short_history_boost=4.0,
            depth_epsilon=0.004,
            kernel_near=0.75,
            kernel_far=0.2,
            light_sigma_normal=16.0,
        ),
        Config(light_cell=4),
    ),
}

# Where each number may lie: (least, most), both included; infinity is not a number.
_NOT_NEGATIVE = (0.0, math.inf)
BOUNDS: dict[str, tuple[float, float]] = {
    "alpha": (0.0, 1.0),
    "alpha_moments": (0.0, 1.0),
    "sigma_depth": _NOT_NEGATIVE,
    "sigma_normal": _NOT_NEGATIVE,
    "sigma_luminance": _NOT_NEGATIVE,
    "short_history_boost": (1.0, math.inf),
    "max_history": (1.0, math.inf),
    "albedo_floor": (2.0**-30, math.inf),  # a bound that float32 holds exactly
    "depth_epsilon": _NOT_NEGATIVE,
    "luminance_epsilon": _NOT_NEGATIVE,
    "reproject_depth": _NOT_NEGATIVE,
    "reproject_normal": (-1.0, 1.0),
    "kernel_near": _NOT_NEGATIVE,
    "kernel_far": _NOT_NEGATIVE,
    "light_gain_threshold": _NOT_NEGATIVE,
    "light_offset_threshold": _NOT_NEGATIVE,
    "light_sigma_normal": _NOT_NEGATIVE,
    "initial_variance": _NOT_NEGATIVE,
    "variance_scale": _NOT_NEGATIVE,
    "clamp_sigma": _NOT_NEGATIVE,
    "taa_alpha": (0.0, 1.0),
    "outlier_sigma": _NOT_NEGATIVE,
}


def preset(name: str) -> tuple[Params, Config]:
    """The parameters and choices of a preset: `paper` (Schied et al. 2017), `falcor` (NVIDIA Falcor's SVGFPass), `tuned` (the
    paper's filter with numbers fitted to one-sample path tracing), or `adaptive`, which follows changes of the light.
    """
    if name not in PRESETS:
        raise SvgfError(f"no preset {name!r}; there are {', '.join(PRESETS)}{suggest(name, PRESETS)}")
    params, config = PRESETS[name]
    per_level = {key: _per_level(list(value)) for key, value in params._asdict().items() if isinstance(value, tuple)}
    return params._replace(**per_level), config


def load_params(path: str | os.PathLike[str]) -> tuple[Params, Config]:
    """Read a parameter file. Raises `SvgfError` that names the file, the line, what was got and what was wanted."""
    file = read_toml(Path(path), "parameter file")
    _check_keys(file)
    content = file.content
    if (
        "schema" in content and "preset" not in content and not file.text.endswith("\n")
    ):  # as `save_params` never writes it
        last = file.text.rpartition("\n")[2]
        raise SvgfError(
            f"{file.path}: the file is cut off, perhaps within a number: it ends with {last!r}. Wanted all of it; if it is all, "
            "end the last line."
        )
    try:
        params, config = preset(content.get("preset", "paper"))
    except (SvgfError, TypeError) as error:
        raise SvgfError(f"{place(file, 'preset')}: {error}") from None
    levels = config.levels
    for table, names, other in (("config", Config._fields, "params"), ("params", Params._fields, "config")):
        for key, value in content.get(table, {}).items():
            try:
                if key not in names:
                    hint = f"; it belongs into [{other}]" if key in (*Params._fields, *Config._fields) else ""
                    raise SvgfError(f"no {key!r} in [{table}]{sentences(hint or suggest(key, names), names)}")
                levels = _choice(key, value) if key == "levels" else levels
                _choice(key, value) if table == "config" else _number(key, value, levels)
            except SvgfError as error:
                raise SvgfError(f"{place(file, table, key)}: {error}") from None
    try:
        return override(params, config, {**content.get("config", {}), **content.get("params", {})})
    except SvgfError as error:  # what the preset gives per level does not fit
        raise SvgfError(f"{place(file, 'config', 'levels')}: {error}") from None


def _check_keys(file: TomlFile) -> None:
    known = ("schema", "preset", "params", "config", "provenance")
    for key, value in file.content.items():
        if key not in known:
            raise SvgfError(f"{place(file, key)}: unknown key {key!r}; wanted {', '.join(known)}{suggest(key, known)}")
        if key in known[2:] and not isinstance(value, dict):
            raise SvgfError(f"{place(file, key)}: {key} is {value!r}; wanted a table, [{key}]")
    if type(schema := file.content.get("schema", SCHEMA)) is not int or schema != SCHEMA:
        raise SvgfError(f"{place(file, 'schema')}: schema = {schema!r}; wanted {SCHEMA}. Is it of another version?")


def load_provenance(path: str | os.PathLike[str]) -> dict[str, Any]:
    """What a parameter file says of its origin; {} if nothing. Raises `SvgfError` as `load_params` does."""
    file = read_toml(Path(path), "parameter file")
    _check_keys(file)
    return file.content.get("provenance", {})


def save_params(
    path: str | os.PathLike[str],
    params: Params,
    config: Config = Config(),
    *,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write a parameter file that `load_params` reads back to the same numbers; under a temporary name, then renamed."""
    file = Path(path)
    text = to_toml(params, config, provenance=provenance)
    try:
        atomic.write_text(file, text)
    except OSError as error:
        raise SvgfError(f"{file}: can't write the parameters: {error}") from None


def to_toml(params: Params, config: Config = Config(), *, provenance: Mapping[str, Any] | None = None) -> str:
    """The text of a parameter file."""
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "params": {name: _plain(value) for name, value in params._asdict().items()},
        "config": config._asdict(),
    }
    if provenance:
        content["provenance"] = dict(provenance)
    return tomli_w.dumps(content)


def override(params: Params, config: Config, values: Mapping[str, Any]) -> tuple[Params, Config]:
    """Replace numbers of `params` and choices of `config` by name, checked against their ranges and the number of levels."""
    names = (*Params._fields, *Config._fields)
    for name in values:
        if name not in names:
            raise SvgfError(f"no parameter {name!r}; there are {', '.join(names)}{suggest(name, names)}")
    config = config._replace(**{k: _choice(k, v) for k, v in values.items() if k in Config._fields})
    given = {k: _number(k, v, config.levels) for k, v in values.items() if k in Params._fields}
    params = params._replace(**given)
    for name, value in params._asdict().items():
        _number(name, _plain(value), config.levels)  # a preset's per-level values must fit the levels asked for
    return params, config


def _choice(name: str, value: Any) -> Any:
    if not is_choice(name, value):
        raise SvgfError(f"{name} = {value!r}; wanted {choices_of(name)}")
    return value


def _number(name: str, value: Any, levels: int) -> Any:
    per_level = isinstance(value, list | tuple)
    entries = list(value) if per_level else [value]
    if per_level and len(entries) != levels:
        raise SvgfError(f"{name} has {len(entries)} values; wanted one, or one for each of the {levels} levels")
    least, most = BOUNDS[name]
    for entry in entries:
        if (
            isinstance(entry, bool)
            or not isinstance(entry, int | float)
            or not least <= entry <= min(most, sys.float_info.max)  # also of an integer that no float holds
        ):
            raise SvgfError(f"{name} = {entry!r}; wanted {bounds_of(least, most)}")
    return _per_level(entries) if per_level else float(value)


def _per_level(entries: list[float]) -> Any:
    import numpy as np

    return np.asarray(entries, dtype=np.float64)


def _plain(value: Any) -> Any:
    """A float, or a list of floats, out of whatever array a parameter is held in."""
    value = value.tolist() if hasattr(value, "tolist") else value
    return [float(v) for v in value] if isinstance(value, list | tuple) else float(value)


def sentences(hint: str, known: Iterable[str]) -> str:
    """The end of an error message: what `suggest` says or another hint, then all that there is."""
    return f"{hint}{'' if hint.endswith('?') else '.'} There are {', '.join(known)}."


def suggest(name: Any, known: Any) -> str:
    """The end of an error message about an unknown name: the most similar one that is known, if any is."""
    close = difflib.get_close_matches(str(name), list(known), n=1)
    return f". Did you mean {close[0]}?" if close else ""
