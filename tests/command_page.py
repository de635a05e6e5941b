"""The page svgf_jax/docs/commands.md, from the commands themselves: every flag, what it takes, its default, its help.

python tests/command_page.py        writes the page
"""

import types
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from cyclopts import App

from svgf_jax.cli import app as denoiser
from tune.__main__ import app as tuner

PAGE = Path(__file__).parents[1] / "svgf_jax" / "docs" / "commands.md"
HEAD = """# Commands and flags

All that the commands say of themselves when asked for help, on one page. A word in capitals stands for a value;
the default is in brackets.

*Written by `python tests/command_page.py`; a test holds it to be so, and nothing of it changes by accident.*
"""
NOT_OURS = ("--help", "-h", "--version")  # cyclopts brings these to each


def commands(app: App, called: str) -> Iterator[tuple[str, App]]:
    """Each command with its whole name, those of groups after their group."""
    if app.default_command is not None:
        yield called, app
    for name in app:
        if name not in NOT_OURS:
            yield from commands(app[name], f"{called} {name}")


def taken(hint: Any, metavar: str | None) -> str:
    """What a flag takes, in words; "" = nothing, it is given or not."""
    if metavar:
        return metavar
    if get_origin(hint) in (Union, types.UnionType):
        hint = next(kind for kind in get_args(hint) if kind is not type(None))
    if get_origin(hint) is tuple:
        hint = get_args(hint)[0]
    if get_origin(hint) is Literal:
        return "|".join(map(str, get_args(hint)))
    return {bool: "", int: "N", float: "NUMBER", str: "TEXT", Path: "PATH"}[hint]


def written(default: Any) -> str:
    if default in (None, (), False, ""):
        return ""
    if isinstance(default, Enum):
        default = default.value
    return f" [{' '.join(map(str, default)) if isinstance(default, tuple) else default}]"


def flags(app: App) -> Iterator[str]:
    """A line each, as they are declared."""
    for argument in app.assemble_argument_collection(parse_docstring=True):
        names = [name for name in argument.names if name != "*"]
        if not names or not argument.show:
            continue
        given = " ".join(filter(None, [", ".join(names), taken(argument.hint, argument.parameter.metavar)]))
        if not names[0].startswith("-"):
            given = names[0]
        default = "" if argument.required else written(argument.field_info.default)
        told = " ".join((argument.parameter.help or "").split())
        yield f"- `{given}`{default}{' (needed)' * argument.required}: {told}"


def page() -> str:
    """The page's text."""
    parts = [HEAD]
    for top, name in ((denoiser, "svgf-jax"), (tuner, "svgf-tune")):
        parts.append("\n".join([f"## Every command of {name}\n", *flags(top.meta), ""]))
        for called, app in commands(top, name):
            told = " ".join((app.help or "").split("\n\n")[0].split())
            parts.append("\n".join([f"## `{called}`\n", f"{told}\n", *flags(app), ""]))
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(f"{PAGE.name}: {len(PAGE.read_text(encoding='utf-8').splitlines())} lines")
