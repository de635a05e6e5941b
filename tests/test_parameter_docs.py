"""The page about parameters is complete, says the bounds and defaults that hold, and its pictures are there and small."""

import re
from pathlib import Path

import pytest

from svgf_jax import Config, Params
from svgf_jax.parameters import BOUNDS
from svgf_jax.types import _READ_WHERE, CHOICES

DOCS = Path(__file__).parents[1] / "svgf_jax" / "docs"
PAGE = (DOCS / "parameters.md").read_text(encoding="utf-8")
ROWS = {
    cells[0].strip("`"): cells[1:]
    for line in PAGE.splitlines()
    if (cells := line.strip("| ").split(" | ")) and len(cells) > 3
}


def number(text):
    """`.2`, `2/3`, `2^-30`, `32 frames` as a number."""
    text = text.split()[0]
    for sign, apply in (("/", lambda a, b: a / b), ("^", lambda a, b: a**b)):
        if sign in text:
            return apply(*map(float, text.split(sign)))
    return float(text)


@pytest.mark.parametrize("name", Params._fields)
def test_every_number_is_there_with_its_default_and_bounds(name):
    default, bounds, *rest = ROWS[name]
    assert number(default) == pytest.approx(getattr(Params(), name))
    least, most = BOUNDS[name]
    if bounds.startswith(">="):
        assert (number(bounds[3:]), most) == (least, float("inf"))
    else:
        assert tuple(map(float, bounds.split(" to "))) == (least, most)
    if name in _READ_WHERE:
        assert _READ_WHERE[name][0] in rest[0]


@pytest.mark.parametrize("name", Config._fields)
def test_every_choice_is_there_with_its_default_and_values(name):
    default, values, _ = ROWS[name]
    assert default == str(getattr(Config(), name)).lower()
    known = CHOICES[name]
    if isinstance(known, range):
        assert values == f"{known[0]} to {known[-1]}"
    else:
        assert set(values.split(", ")) == {str(value).lower() for value in known}


def test_the_pictures_are_there_and_small():
    pictures = [DOCS / name for name in re.findall(r"\]\((parameters/\w+\.jpg)\)", PAGE)]
    assert {path.name for path in pictures} == {path.name for path in (DOCS / "parameters").iterdir()}
    assert sum(path.stat().st_size for path in pictures) < 1_000_000
    assert (DOCS / "report.jpg").stat().st_size < 200_000
