"""TOML files that people write: read, and errors that name the line. The standard library only."""

import re
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

from svgf_jax.regular import require_regular
from svgf_jax.types import SvgfError

LARGEST = 1_000_000
"""Bytes; a bigger file is something else."""
LONGEST, DEEPEST = 10_000, 100
"""Characters of a line, and tables in tables: tomllib's time grows with their square."""


class TomlFile(NamedTuple):
    """A file: its path, its text, and what is in it."""

    path: Path
    text: str
    content: dict[str, Any]


def read_toml(path: Path, what: str) -> TomlFile:
    """Read a TOML file; `what` it is, for the errors. Raises SvgfError: not a regular file, not text, not TOML (with the
    line), too big, nested too deeply, an integer of more than the 64 bits that TOML has.
    """
    text = ""
    try:
        require_regular(path)
        if (size := path.stat().st_size) > LARGEST:
            raise SvgfError(f"{path}: {size} bytes; wanted a {what}, of at most {LARGEST}. Is it another file?")
        text = path.read_text(encoding="utf-8")
        for number, line in enumerate(text.split("\n"), 1):
            if len(line) > LONGEST:
                raise SvgfError(
                    f"{path}:{number}: a line of {len(line)} characters; wanted at most {LONGEST}. Break it up."
                )
        content = tomllib.loads(text)
    except FileNotFoundError:
        raise SvgfError(f"{path}: no such {what}") from None
    except tomllib.TOMLDecodeError as error:
        said, _, where = str(error).partition(" (at ")
        line = re.match(r"line (\d+)", where)
        number = int(line.group(1)) if line else text.rstrip().count("\n") + 1  # "at end of document"
        raise SvgfError(f"{path}:{number}: not TOML: {said}. Got {_line(text, number)!r}.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SvgfError(f"{path}: can't be read as text: {getattr(error, 'strerror', None) or error}") from None
    except (RecursionError, ValueError) as error:  # of tomllib: brackets in brackets, an integer of thousands of digits
        raise SvgfError(f"{path}: can't be read as TOML: {str(error).partition(';')[0]}. Is it another file?") from None
    _check_values(path, content)
    return TomlFile(path, text, content)


def _check_values(path: Path, content: dict[str, Any]) -> None:
    """SvgfError where values are nested too deeply or an integer is too large to be a number anywhere else."""
    level: list[Any] = [content]
    for _ in range(DEEPEST):
        if any(type(value) is int and not -(2**63) <= value < 2**63 for value in level):
            raise SvgfError(f"{path}: an integer of more than 64 bits; wanted a number that is smaller.")
        level = [
            inner
            for value in level
            if isinstance(value, dict | list)
            for inner in (value.values() if isinstance(value, dict) else value)
        ]
        if not level:
            return
    raise SvgfError(f"{path}: tables or lists nested more than {DEEPEST} deep; wanted a few. Is it another file?")


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
