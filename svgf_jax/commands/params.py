"""`svgf-jax params list` and `svgf-jax params show`."""

import re
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from svgf_jax.commands import settings
from svgf_jax.types import Config, Params


def list_() -> None:
    """List presets and parameters."""
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from svgf_jax import parameters

    console = Console()
    with_meanings = console.width >= 110
    presets = {name: parameters.preset(name) for name in parameters.PRESETS}
    table = Table(box=SIMPLE)
    for name in ("parameter", *presets):
        table.add_column(name, justify="left" if name == "parameter" else "right", overflow="fold")
    if with_meanings:
        table.add_column("meaning", overflow="fold")
    meanings = _meanings(Params) | _meanings(Config)
    for name in (*Params._fields, *Config._fields):
        values = [getattr(params if name in Params._fields else config, name) for params, config in presets.values()]
        cells = (name, *map(_short, values), *([meanings.get(name, "")] if with_meanings else []))
        table.add_row(*map(Text, cells))
    console.print(table)
    if not with_meanings:
        console.print("A terminal of 110 columns or more also shows what each parameter means.")


def show(
    source: Annotated[str, Parameter(name="PRESET|FILE.toml")] = "paper",
    /,
    *,
    set_: Annotated[
        tuple[str, ...],
        Parameter(name="--set", metavar="NAME=VALUE", negative=(), consume_multiple=False, show_default=False),
    ] = (),
) -> None:
    """Print parameters as TOML, ready for `svgf-jax denoise --params FILE.toml`.

    Args:
        source: A preset, or a file.
        set_: One value changed; a comma list gives one value per a-trous level. Repeatable.
    """
    import tomli_w

    from svgf_jax.outputs import numbers

    from_file = source.endswith(".toml")
    _, params, config = settings.choose(None if from_file else source, Path(source) if from_file else None, set_)
    values = numbers(params, config)
    print(tomli_w.dumps({"params": values["parameters"], "config": values["config"]}), end="")


def _meanings(cls: type) -> dict[str, str]:
    """Field -> what its class's docstring says of it."""
    text = (cls.__doc__ or "").partition("Attributes:")[2]
    entries = re.findall(r"^ {8}(\w+): (.*(?:\n {12}.*)*)", text, flags=re.MULTILINE)
    return {name: " ".join(meaning.split()) for name, meaning in entries}


def _short(value: Any) -> str:
    if isinstance(value, str | bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, int | float) else ", ".join(f"{item:g}" for item in value)
