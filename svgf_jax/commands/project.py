"""`svgf-jax.toml`: a project's own defaults of the flags, a table for each command; the command line wins.

[denoise]
preset = "tuned"
png = true
channel = { albedo = ["tint.R", "tint.G", "tint.B"] }     # or ["albedo=tint.R,tint.G,tint.B"]
set = { alpha = 0.4 }
"""

from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import Any, get_origin

from cyclopts import App
from cyclopts.argument import ArgumentCollection
from cyclopts.token import Token

from svgf_jax.commands import terminal
from svgf_jax.parameters import sentences, suggest
from svgf_jax.toml import TomlFile, place, read_toml
from svgf_jax.types import SvgfError

NAME = "svgf-jax.toml"
OTHERS = ("tune",)  # tables that are not of svgf-jax, but of svgf-tune
APART = (frozenset({"preset", "params", "method"}), frozenset({"resume", "overwrite"}))
"""Options that do not go together: one on the command line takes the others of the file away."""


def use_project(app: App, given: str, *, tables: Collection[str] = (), table: str | None = None) -> None:
    """Let the project file stand behind the command line of `app`: `given`, "none", or "auto" = the nearest one.

    `tables` are those that there may be, if anyone knows; `table` is the one of an app that has no commands.

    Raises SvgfError: not there, not TOML, a table of no command.
    """
    path = nearest(Path.cwd()) if given == "auto" else None if given == "none" else Path(given)
    if path is None:
        return
    file = read_toml(path, "project file")
    for name, value in file.content.items():
        if (tables and name not in tables) or not isinstance(value, dict):
            raise SvgfError(
                f"{place(file, name)}: got {name!r}; wanted a table for each command: "
                f"{', '.join(f'[{known}]' for known in tables)}{suggest(name, tables)}"
            )
    app.config = (partial(_apply, file, () if table is None else (table,)),)


def nearest(folder: Path) -> Path | None:
    """The project file of a folder, or of the nearest folder above that has one."""
    return next((path for above in (folder, *folder.parents) if (path := above / NAME).is_file()), None)


def _apply(
    file: TomlFile, above: tuple[str, ...], _: App, commands: tuple[str, ...], arguments: ArgumentCollection
) -> None:
    """Give every option that the command line leaves open what the file says, and tell which."""
    table: Any = file.content
    commands = (*above, *commands)
    for command in commands:
        table = table.get(command, {}) if isinstance(table, dict) else {}
    options = {name[2:]: argument for argument in arguments for name in argument.names if name.startswith("--")}
    given = {name for name, argument in options.items() if argument.tokens}
    hidden = {other for group in APART if group & given for other in group}
    used = []
    for name, value in table.items():
        where = place(file, *commands, name)
        if name not in options:
            raise SvgfError(
                f"{where}: {' '.join(commands)} has no option {name!r}"
                f"{sentences(suggest(name, options), sorted(options))}"
            )
        texts = _texts(name, value, options[name].hint, where)
        if name in given | hidden:
            continue
        for index, text in enumerate(texts):
            options[name].append(Token(keyword=f"--{name}", value=text, source=where, index=index))
        used.append(name)
    if used:
        terminal.tell(f"{file.path}: {', '.join(used)}")


def _texts(name: str, value: Any, hint: Any, where: str) -> list[str]:
    """What would stand on the command line, for an option of type `hint`; a table is NAME=VALUE for each of its keys."""
    several = get_origin(hint) is tuple
    if (hint is bool) != isinstance(value, bool) or (isinstance(value, list | dict) and not several):
        wanted = "true or false" if hint is bool else "a list or a table" if several else "one text or number"
        raise SvgfError(f"{where}: {name} = {_text(value)}; wanted {wanted}.")
    if isinstance(value, dict):
        return [f"{key}={_text(item)}" for key, item in value.items()]
    return [_text(item) for item in value] if isinstance(value, list) else [_text(value)]


def _text(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(map(_text, value))
    return str(value).lower() if isinstance(value, bool) else str(value)
