"""`svgf-jax params list`, `params show` and `params diff`."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from svgf_jax.commands import settings
from svgf_jax.commands.completing import ANY, LISTED
from svgf_jax.methods import METHODS, Games202Params, MethodConfig
from svgf_jax.types import Config, Params, SvgfError

Set = Annotated[
    tuple[str, ...],
    Parameter(name="--set", metavar="NAME=VALUE", negative=(), consume_multiple=False, show_default=False),
]
Name = Annotated[str, ANY, Parameter(name="PRESET|METHOD|FILE.toml")]


def list_(kind: Annotated[str, LISTED, Parameter(name="presets|methods|METHOD")] = "presets", /) -> None:
    """List the presets with their parameters, the methods of `denoise --method`, or one method's parameters.

    Args:
        kind: What to list.
    """
    from svgf_jax import parameters

    if kind == "presets":
        presets = {name: parameters.preset(name) for name in parameters.PRESETS}
        _print_columns(presets, (*Params._fields, *Config._fields), _meanings(Params) | _meanings(Config))
    elif kind == "methods":
        heads = ("method", "what it does", "parameters and choices")
        rows = [(name, m.summary, ", ".join((*m.params._fields, *m.choices))) for name, m in METHODS.items()]
        _print(heads, [("svgf", "the default; see `svgf-jax params list`", ""), *rows])
    elif kind in METHODS:
        chosen = METHODS[kind]
        names = (*chosen.params._fields, *chosen.choices)
        _print_columns(
            {kind: (chosen.params, chosen.config)}, names, _meanings(MethodConfig) | _meanings(Games202Params)
        )
    else:
        known = ("presets", "methods", *METHODS)
        raise SvgfError(
            f"nothing to list is called {kind!r}; there are {', '.join(known)}{parameters.suggest(kind, known)}"
        )


def show(source: Name = "paper", /, *, set_: Set = ()) -> None:
    """Print parameters as TOML, ready for `svgf-jax denoise --params FILE.toml`.

    Args:
        source: A preset, a file (with its provenance), or a method of --method.
        set_: One value changed; a comma list gives one value per a-trous level. Repeatable.
    """
    import tomli_w

    from svgf_jax import parameters
    from svgf_jax.outputs import numbers

    params, config = _chosen(source, set_)
    if source in METHODS:
        values = {name: value for name, value in _values(params, config, source).items() if value is not None}
        print(f"# For: svgf-jax denoise --method {source} --set NAME=VALUE; parameter files are of svgf.")
        print(tomli_w.dumps(values), end="")
        return
    told = parameters.load_provenance(source) if source.endswith(".toml") and not set_ else {}
    values = numbers(params, config)
    content = {"schema": parameters.SCHEMA, "params": values["parameters"], "config": values["config"]}
    print(tomli_w.dumps(content | ({"provenance": told} if told else {})), end="")


def diff(one: Name, other: Name, /) -> int:
    """Print in what two sets of parameters differ: 1 if they do, 0 if they are the same.

    Args:
        one: A preset, a file, or a method of --method.
        other: The other one.
    """
    rows = []
    one_values, other_values = (_values(*_chosen(name, ()), name) for name in (one, other))
    for name in dict.fromkeys((*one_values, *other_values)):
        pair = [values.get(name, "-") for values in (one_values, other_values)]
        if pair[0] != pair[1]:
            texts = tuple(map(_short, pair))
            rows.append((name, *(texts if texts[0] != texts[1] else map(str, pair))))
    if not rows:
        print(f"{one} and {other} are the same")
        return 0
    _print(("parameter", one, other), rows)
    return 1


def _chosen(source: str, changes: tuple[str, ...]) -> tuple[Any, Any]:
    """Parameters and choices of a preset, a file or a method by name."""
    if source in METHODS:
        return settings.choose_method(source, None, None, changes)[1:]
    if not source.endswith(".toml"):
        from svgf_jax import parameters

        if source not in parameters.PRESETS:
            known = (*parameters.PRESETS, *METHODS)
            raise SvgfError(
                f"no preset or method {source!r}; there are {', '.join(known)}, and files whose name ends in .toml"
                f"{parameters.suggest(source, known)}"
            )
        return settings.choose(source, None, changes)[1:]
    return settings.choose(None, Path(source), changes)[1:]


def _values(params: Any, config: Any, source: str) -> Mapping[str, Any]:
    """All numbers and choices by name, in plain numbers; of a method those that can be set."""
    from svgf_jax.outputs import numbers

    found = numbers(params, config)
    values = found["parameters"] | found["config"]
    return {name: values[name] for name in (*params._fields, *METHODS[source].choices)} if source in METHODS else values


def _print_columns(columns: Mapping[str, tuple[Any, Any]], names: tuple[str, ...], meanings: Mapping[str, str]) -> None:
    """A column for each set of parameters, and what each parameter means where there is room."""
    rows = []
    for name in names:
        values = [getattr(params if name in params._fields else config, name) for params, config in columns.values()]
        rows.append((name, *map(_short, values), meanings.get(name, "")))
    _print(("parameter", *columns, "meaning"), rows, last_from=110)


def _print(heads: tuple[str, ...], rows: list[tuple[str, ...]], *, last_from: int = 0) -> None:
    """A table; its last column only on terminals of so many columns."""
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    fits = console.width >= last_from
    table = Table(box=SIMPLE)
    for i, name in enumerate(heads if fits else heads[:-1]):
        number = last_from > 0 and 0 < i < len(heads) - 1
        table.add_column(Text(name), justify="right" if number else "left", overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row if fits else row[:-1]))
    console.print(table)
    if not fits:
        console.print(f"A terminal of {last_from} columns or more also shows what each parameter means.")


def _meanings(cls: type) -> dict[str, str]:
    """Field -> what its class's docstring says of it."""
    text = (cls.__doc__ or "").partition("Attributes:")[2]
    entries = re.findall(r"^ {8}(\w+(?:, \w+)*): (.*(?:\n {12}.*)*)", text, flags=re.MULTILINE)
    return {name: " ".join(meaning.split()) for names, meaning in entries for name in names.split(", ")}


def _short(value: Any) -> str:
    if isinstance(value, str | bool | None):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, int | float) else ", ".join(f"{item:g}" for item in value)
