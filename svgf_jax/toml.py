"""TOML files that people write: read, and errors that name the line. The standard library only."""

import re
import tomllib
from bisect import bisect_left
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from svgf_jax.regular import require_regular
from svgf_jax.types import SvgfError

LARGEST = 1_000_000
"""Bytes; a bigger file is something else."""
LONGEST, DEEPEST = 10_000, 100
"""Characters of a line, and tables in tables: tomllib's time grows with their square."""

_TOKENS = re.compile(
    r'"""(?:[^\\]|\\.)*?"{3,5}(?!")' r"|'''.*?'{3,5}(?!')" r'|"(?:[^"\\\n]|\\.)*"' r"|'[^'\n]*'|#[^\n]*|[\[\]{}]|\n",
    re.DOTALL,
)
"""What a line's end may lie in, and what may hide that: texts, comments, brackets."""


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
    """The line, from 1, where TOML `text` begins to give a key; the last one where it does not. `text` parses as a whole.

    The first statements are parsed, more or fewer of them, until those are found with which the key is there: no second
    parser, and right wherever tomllib is.
    """
    lines = text.split("\n")
    starts = [*_statements(text), len(lines)]
    first = bisect_left(starts, True, lo=1, key=lambda end: _has(tomllib.loads("\n".join([*lines[:end], ""])), keys))
    return starts[first - 1] + 1 if first < len(starts) else len(lines)


def _statements(text: str) -> Iterator[int]:
    """The lines, from 0, that begin a statement, a comment or nothing: those within brackets and texts of several lines don't."""
    line, depth = 0, 0
    yield 0
    for found in _TOKENS.finditer(text):
        token = found[0]
        line += token.count("\n")
        depth += (token in "[{") - (token in "]}")
        if token == "\n" and depth == 0:
            yield line


def _has(content: Any, keys: tuple[str | int, ...]) -> bool:
    try:
        for key in keys:
            content = content[key]
    except (KeyError, IndexError, TypeError):
        return False
    return True


def _line(text: str, number: int) -> str:
    return text.split("\n")[number - 1].strip()
