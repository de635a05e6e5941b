"""TOML files that people write: read, and errors that name the line. The standard library only."""

import re
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

from svgf_jax.types import SvgfError


class TomlFile(NamedTuple):
    """A file: its path, its text, and what is in it."""

    path: Path
    text: str
    content: dict[str, Any]


def read_toml(path: Path, what: str) -> TomlFile:
    """Read a TOML file; `what` it is, for the errors. Raises SvgfError: not there, not text, not TOML (with the line)."""
    text = ""
    try:
        text = path.read_text(encoding="utf-8")
        return TomlFile(path, text, tomllib.loads(text))
    except FileNotFoundError:
        raise SvgfError(f"{path}: no such {what}") from None
    except tomllib.TOMLDecodeError as error:
        said, _, where = str(error).partition(" (at ")
        line = re.match(r"line (\d+)", where)
        number = int(line.group(1)) if line else text.rstrip().count("\n") + 1  # "at end of document"
        raise SvgfError(f"{path}:{number}: not TOML: {said}. Got {_line(text, number)!r}.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SvgfError(f"{path}: can't be read as text: {error}") from None


def place(file: TomlFile, *keys: str | int) -> str:
    """`FILE:LINE` where a key is given: ("params", "alpha") is `alpha` of the table [params], ("light", 1) the second [[light]]."""
    return f"{file.path}:{line_of(file.text, *keys)}"


def line_of(text: str, *keys: str | int) -> int:
    """The line, from 1, where TOML `text` begins to give a key.

    The first lines are parsed, always more of them, until the key is there: no second parser, and right wherever tomllib is.
    """
    lines, parsed = text.split("\n"), 0
    for end in range(1, len(lines) + 1):
        try:
            content = tomllib.loads("\n".join(lines[:end]))
        except tomllib.TOMLDecodeError:  # within a value of several lines
            continue
        if _has(content, keys):
            return parsed + 1
        parsed = end
    return len(lines)


def _has(content: Any, keys: tuple[str | int, ...]) -> bool:
    try:
        for key in keys:
            content = content[key]
    except (KeyError, IndexError, TypeError):
        return False
    return True


def _line(text: str, number: int) -> str:
    return text.split("\n")[number - 1].strip()
