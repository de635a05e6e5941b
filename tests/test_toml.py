"""Which line a key of a TOML file stands in."""

import time
import tomllib

import pytest

from svgf_jax.toml import line_of

TEXT = r"""# [a]
x = "[ # \\"   # a comment with " and [
y = [ # ]
  1, "]", 2, [
  ], # [
]
"quoted [ key" = SSS
z = 1
SSSSS
many = DDD
\DDD
later = 2
DDDDD

p.q.c = 1
[a.b]
d = { e = "}", f = [1,
  2] }
[[light]]
name = 'C:\'
[[light]]
name = "#"
  [light.sub]
  deep = DDDone lineDDD  # and SSS
empty = DDDDDD
last = ''
""".replace("SSS", "'''").replace("DDD", '"' * 3)
TEXT = TEXT.replace("SS", "''").replace("DD", '""')
PLACES = {
    ("x",): "x =",
    ("y",): "y =",
    ("y", 2): "y =",
    ("quoted [ key",): '"quoted',
    ("many",): "many",
    ("p", "q"): "p.q.c",
    ("p", "q", "c"): "p.q.c",
    ("a",): "[a.b]",
    ("a", "b", "d"): "d =",
    ("a", "b", "d", "f"): "d =",
    ("light",): "[[light]]",
    ("light", 1): "[[light]]",
    ("light", 0, "name"): "name = 'C",
    ("light", 1, "name"): 'name = "#"',
    ("light", 1, "sub"): "[light.sub]",
    ("light", 1, "sub", "deep"): "deep",
    ("light", 1, "sub", "empty"): "empty",
    ("light", 1, "sub", "last"): "last",
}


@pytest.mark.parametrize("keys", PLACES, ids=str)
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_key_is_found_in_its_line(keys, end):
    assert tomllib.loads(TEXT)["light"][1]["sub"]["last"] == ""
    lines = [line.strip() for line in TEXT.splitlines()]
    found = line_of(TEXT.replace("\n", end), *keys)
    assert lines[found - 1].startswith(PLACES[keys])
    assert keys != ("light", 1) or "[[light]]" in lines[: found - 1]


def test_what_is_not_there_is_told_with_the_last_line():
    assert line_of(TEXT, "light", 2) == line_of(TEXT, "z") == TEXT.count("\n") + 1
    assert line_of("", "x") == 1


def test_a_long_file_takes_no_longer_than_it_must():
    long = "".join(f"a{i} = [\n{i},\n]\n" for i in range(1500))
    began = time.process_time()
    assert line_of(long, "a1499") == 3 * 1499 + 1
    assert line_of("x = [\n" + "1,\n" * 5_000 + "]\ny = 1", "y") == 5_003
    assert time.process_time() - began < 5.0  # a minute, if every line were parsed anew
