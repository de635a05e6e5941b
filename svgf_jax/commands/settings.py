"""Options that set numbers and names: `--preset`, `--params`, `--set NAME=VALUE`, `--channel ROLE=...`. No JAX."""

import difflib
from collections.abc import Iterable
from pathlib import Path

from svgf_jax.types import Config, Params, SvgfError


def choose(preset: str | None, file: Path | None, changes: Iterable[str]) -> tuple[str, Params, Config]:
    """(name for the record, parameters, choices) from a preset or a file, with single values changed."""
    from svgf_jax import parameters

    if preset is not None and file is not None:
        raise SvgfError(f"Got --preset {preset} and --params {file}; wanted one of them. --set changes single values.")
    name = preset or "paper"
    params, config = parameters.preset(name) if file is None else parameters.load_params(file)
    record = name if file is None else file.name
    for change in changes:
        key, text = _split(change, option="--set", example="sigma_normal=64")
        params, config = _change(params, config, key, text)
        record += f" {change}"
    return record, params, config


def assignments(texts: Iterable[str], *, option: str, example: str) -> dict[str, str]:
    """`NAME=VALUE` texts as a dictionary, each name once."""
    pairs: dict[str, str] = {}
    for text in texts:
        key, value = _split(text, option=option, example=example)
        if key in pairs:
            raise SvgfError(f"{option} {key} is given twice: {pairs[key]} and {value}. Leave one out.")
        pairs[key] = value
    return pairs


def _split(text: str, *, option: str, example: str) -> tuple[str, str]:
    key, equals, value = (part.strip() for part in text.partition("="))
    if not (key and equals and value):
        raise SvgfError(f"Got {option} {text!r}; wanted NAME=VALUE, for example {option} {example}.")
    return key, value


def _change(params: Params, config: Config, key: str, text: str) -> tuple[Params, Config]:
    """One value replaced, by its name and as text."""
    if key in Config._fields:
        try:
            return params, config._replace(**{key: int(text)})
        except ValueError as error:
            raise SvgfError(f"Got --set {key}={text}; wanted a whole number.") from error
    if key not in Params._fields:
        names = [*Params._fields, *Config._fields]
        close = difflib.get_close_matches(key, names, n=3) or names
        raise SvgfError(f"There is no parameter {key!r}. Closest: {', '.join(close)}. See `svgf-jax params list`.")
    try:
        values = tuple(float(item) for item in text.split(","))
    except ValueError as error:
        raise SvgfError(
            f"Got --set {key}={text}; wanted a number, or one per a-trous level separated by commas: {key}=4,3,2,1,1."
        ) from error
    return params._replace(**{key: values[0] if len(values) == 1 else values}), config
