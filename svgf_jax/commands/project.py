"""`svgf-jax.toml`: a project's own defaults of the flags: a table for each command, and one for all; the command line wins.

[all]                                                     # for every command that has such an option
renderer = "studio.toml"                                  # relative paths count from this file's folder
[denoise]
preset = "tuned"
png = true
channel = { albedo = ["tint.R", "tint.G", "tint.B"] }     # or ["albedo=tint.R,tint.G,tint.B"]
set = { alpha = 0.4 }
"""

import os
import types
from collections.abc import Collection, Generator, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Union, get_args, get_origin

from cyclopts import App
from cyclopts.argument import ArgumentCollection
from cyclopts.token import Token

from svgf_jax.commands import terminal
from svgf_jax.parameters import sentences, suggest
from svgf_jax.toml import TomlFile, place, read_toml
from svgf_jax.types import SvgfError

NAME = "svgf-jax.toml"
ALL = "all"
OTHERS = ("tune",)  # tables that are not of svgf-jax, but of svgf-tune
NOT_OF_ALL = ("demo", "params", "completion")  # they read nothing of the project's: [all] is not for them
APART = (frozenset({"preset", "params", "method"}), frozenset({"resume", "overwrite"}))
"""Options that do not go together: one on the command line takes the others of the file away."""
_PLACES = ("reference", "second", "validate", "validate-reference", "before", "cameras", "renderer", "file")
"""Options that name files, beside those whose type is a path."""
_WORDS = ("auto", "none")


def use_project(app: App, given: str, *, commands: App, table: str | None = None) -> None:
    """Let the project file stand behind the command line of `app`: `given`, "none", or "auto" = the nearest one.

    `commands` has the commands of svgf-jax, of which [all] may have any option; `table` is the one of an app that has none.

    Raises SvgfError: not there, not TOML, a table of no command.
    """
    path = nearest(Path.cwd()) if given == "auto" else None if given == "none" else Path(given)
    if path is None:
        return
    file = read_toml(path, "project file")
    names = [name for name in commands if not name.startswith("-")]
    tables = (ALL, *names, *OTHERS)
    for name, value in file.content.items():
        if name not in tables or not isinstance(value, dict):
            raise SvgfError(
                f"{place(file, name)}: got {name!r}; wanted a table for each command, or for all: "
                f"{', '.join(f'[{known}]' for known in tables)}{suggest(name, tables)}"
            )
    known: dict[str, None] = {}
    if ALL in file.content:
        for name in names:
            if name not in NOT_OF_ALL:
                known |= dict.fromkeys(_options(commands[name].assemble_argument_collection()))
    above = () if table is None else (table,)
    app.config = (partial(_apply, file, above, tuple(known), used=[]),)


@contextmanager
def located(app: App) -> Generator[None]:
    """What is wrong with a value of the project file is told with its line: in errors that quote it."""
    try:
        yield
    except SvgfError as error:
        for config in app.config or ():
            for where, words in getattr(config, "keywords", {}).get("used", ()):
                if any(word in str(error) for word in words):
                    raise SvgfError(f"{where}: {error}") from None
        raise


def nearest(folder: Path) -> Path | None:
    """The project file of a folder, or of the nearest folder above that has one."""
    return next((path for above in (folder, *folder.parents) if (path := above / NAME).is_file()), None)


def _options(arguments: ArgumentCollection) -> dict[str, Any]:
    """The options of a command by their long names."""
    return {name[2:]: argument for argument in arguments for name in argument.names if name.startswith("--")}


def _apply(
    file: TomlFile,
    above: tuple[str, ...],
    known: Collection[str],
    _: App,
    commands: tuple[str, ...],
    arguments: ArgumentCollection,
    *,
    used: list[tuple[str, tuple[str, ...]]],
) -> None:
    """Give every option that the command line leaves open what the file says, and tell which.

    `used` gets the line of each value, and how errors quote it (`located`).
    """
    options = _options(arguments)
    taken = {name for name, argument in options.items() if argument.tokens}
    told = []
    for keys, table in _tables(file, (*above, *commands)):
        hidden = taken | {other for group in APART if group & taken for other in group}
        for name, value in table.items():
            where = place(file, *keys, name)
            if name not in options and keys == (ALL,) and name in known:
                continue
            if name not in options:
                who, names = (
                    ("no command has an", {**options, **dict.fromkeys(known)})
                    if keys == (ALL,)
                    else (f"{' '.join(keys)} has no", options)
                )
                raise SvgfError(f"{where}: {who} option {name!r}{sentences(suggest(name, names), sorted(names))}")
            texts = [
                _located(text, name, options[name].hint, file)
                for text in _texts(name, value, options[name].hint, where)
            ]
            if any(not text.strip() or min(text) < " " for text in texts):  # `out = ""` would be the current folder
                raise SvgfError(f"{where}: {name} = {value!r}; wanted a text, not empty, without control characters.")
            if name in hidden:
                continue
            for index, text in enumerate(texts):
                options[name].append(Token(keyword=f"--{name}", value=text, source=where, index=index))
                key, equals, given = text.partition("=")
                at = place(file, *keys, name, key) if equals and isinstance(value, dict) else where
                quoted = (repr(text), repr(key), repr(given), f"{key} = ") if equals else (repr(text),)
                used.append((at, (f"--{name} {text}", *quoted)))
            told.append(name)
            taken.add(name)
    if told:
        terminal.tell(f"{file.path}: {', '.join(told)}")


def _tables(file: TomlFile, commands: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], dict[str, Any]]]:
    """The tables that a command reads, that which counts more first, each with its name."""
    table: Any = file.content
    for command in commands:
        table = table.get(command, {}) if isinstance(table, dict) else {}
    if isinstance(table, dict):
        yield commands, table
    if commands and commands[0] not in NOT_OF_ALL:
        yield (ALL,), file.content.get(ALL, {})


def _texts(name: str, value: Any, hint: Any, where: str) -> list[str]:
    """What would stand on the command line, for an option of type `hint`; a table is NAME=VALUE for each of its keys."""
    hint = next((one for one in get_args(hint) if one is not type(None)), hint) if _is_union(hint) else hint
    several = get_origin(hint) is tuple
    wanted, fits = {
        bool: ("true or false", isinstance(value, bool)),
        int: ("a whole number", isinstance(value, int) and not isinstance(value, bool)),
        float: ("a number", isinstance(value, int | float) and not isinstance(value, bool)),
        tuple: ("a list of texts, or a table", _are_texts(value) or (isinstance(value, dict) and _are_plain(value))),
    }.get(tuple if several else hint, ("a text", isinstance(value, str)))
    if not fits:
        quoted = f': {name} = "{_text(value)}"' if wanted == "a text" and type(value) in (int, float) else ""
        raise SvgfError(f"{where}: {name} = {_text(value)}; wanted {wanted}{quoted}.")
    if isinstance(value, dict):
        return [f"{key}={_text(item)}" for key, item in value.items()]
    return [_text(item) for item in value] if isinstance(value, list) else [_text(value)]


def _located(text: str, name: str, hint: Any, file: TomlFile) -> str:
    """`text`, and where it is a relative path, that as seen from here: it counts from the file's own folder."""
    folder = file.path.parent
    kinds = get_args(hint) if _is_union(hint) else (hint,)
    if (name not in _PLACES and Path not in kinds) or text in _WORDS or folder.resolve() == Path.cwd():
        return text
    if name == "file":  # a pattern without a folder is meant beside the frames
        role, equals, pattern = text.partition("=")
        return f"{role}{equals}{folder / pattern}" if os.path.dirname(pattern) else text
    return text if name == "renderer" and not text.endswith(".toml") else str(folder / text)


def _is_union(hint: Any) -> bool:
    return get_origin(hint) in (Union, types.UnionType)


def _are_texts(value: Any) -> bool:
    return isinstance(value, str) or (isinstance(value, list) and all(isinstance(one, str) for one in value))


def _are_plain(table: dict[str, Any]) -> bool:
    """Whether a table has nothing but texts, numbers, flags, and lists of them."""
    every = [one for value in table.values() for one in (value if isinstance(value, list) else [value])]
    return all(isinstance(one, str | int | float) for one in every)


def _text(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(map(_text, value))
    return str(value).lower() if isinstance(value, bool) else str(value)
