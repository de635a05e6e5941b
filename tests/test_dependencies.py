"""The page of dependencies says what pyproject.toml says, and what the packages say of their licences."""

import importlib.metadata
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "svgf_jax" / "docs" / "dependencies.md").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
PERMISSIVE = {"MIT", "MIT-CMU", "BSD-2-Clause", "BSD-3-Clause", "Apache-2.0"}
# What older metadata call them.
CALLED = {
    "MIT": ("MIT",),
    "MIT-CMU": ("MIT-CMU", "CMU License"),
    "BSD-3-Clause": ("BSD",),
    "Apache-2.0": ("Apache",),
    "MPL-2.0": ("MPL-2.0", "Mozilla"),
}


def asked() -> dict[str, tuple[str, str]]:
    """Package -> (from which version on, extra), as pyproject.toml has it."""
    wanted = [(text, "") for text in PROJECT["dependencies"]]
    wanted += [(text, extra) for extra, texts in EXTRAS.items() for text in texts if not text.startswith("svgf-jax")]
    found = {}
    for text, extra in wanted:
        name, floor = re.fullmatch(r"([\w-]+)>=([\d.]+)(?:,<[\d.]+)?", text).groups()
        found[name] = floor, extra
    return found


def told() -> dict[str, tuple[str, str, str]]:
    """Package -> (from which version on, extra, licence), as the page has it."""
    rows = [[cell.strip() for cell in row.strip("|").split("|")] for row in re.findall(r"^\|.*\|$", PAGE, re.MULTILINE)]
    return {
        row[0]: (row[1], row[3] if len(row) == 5 else "", row[2]) for row in rows if row[0] not in ("package", "---")
    }


def test_every_dependency_is_told_with_its_floor_and_its_extra():
    assert {name: (floor, extra) for name, (floor, extra, _) in told().items()} == asked()


def test_what_is_run_is_under_permissive_licences():
    assert {licence for _, extra, licence in told().values() if extra != "test"} <= PERMISSIVE


@pytest.mark.parametrize("name", sorted(told()))
def test_the_licence_is_what_the_package_says(name):
    try:
        metadata = importlib.metadata.metadata(name)
    except importlib.metadata.PackageNotFoundError:
        assert asked()[name][1] == "bench"
        return
    said = [metadata.get(key, "") for key in ("License-Expression", "License")] + (metadata.get_all("Classifier") or [])
    said = [text.splitlines()[0] for text in said if text and ("License" in text or "::" not in text)]
    if name == "OpenEXR" and not said:
        (text,) = [path for path in importlib.metadata.files(name) if path.name.startswith("LICENSE")]
        said = ["BSD" if "Redistribution and use in source and binary forms" in text.read_text() else "?"]
    assert any(word in text for text in said for word in CALLED[told()[name][2]]), said
