"""The house holds: a file imports only from lower floors, stages do not know each other, the library does not know the tuner."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FLOORS = [
    {"atomic", "kept_programs", "memory", "prints", "regular", "remedies", "spelling"},
    {"types"},
    {"limits", "tonemapping", "toml", "npz", "sampling"},
    {"color", "parameters", "metrics", "exr_layout", "threads", "check", "moments", "motion", "processes"},
    {"windows", "noise", "exr_chunks"},
    {
        "methods",
        "edges",
        "exr",
        "sanitation",
        "accumulation",
        "reprojection",
        "modulation",
        "antialiasing",
        "sequences",
        "cameras",
        "warping",
    },
    {"renderers", "cells"},
    {"significance"},
    {"variance", "atrous", "adaptation", "roles", "reflections", "preview", "joint_bilateral", "outliers", "matrices"},
    {"advising", "planes", "camera_files", "geometry"},
    {"assembly"},
    {"arrays", "frames", "references", "pipeline", "checkpoint", "page"},
    {"baselines", "comparison", "devices", "film", "outputs", "plan", "scan", "shown", "tev", "pieces"},
    {"compiled", "estimates"},
    {"filing"},
    {"ablation", "streaming"},
    {"demo", "report", "inspection"},
    {"findings"},
    {"commands"},
    {"cli"},
    {"__main__"},
]
STAGES = {
    "sanitation",
    "reprojection",
    "accumulation",
    "adaptation",
    "variance",
    "atrous",
    "joint_bilateral",
    "antialiasing",
    "outliers",
}
NUMPY_ONLY = {
    "atomic",
    "regular",
    "npz",
    "spelling",
    "types",
    "toml",
    "parameters",
    "metrics",
    "exr_layout",
    "exr_chunks",
    "exr",
    "sequences",
    "cameras",
    "advising",
    "arrays",
    "assembly",
    "camera_files",
    "motion",
    "planes",
    "renderers",
    "warping",
    "matrices",
    "methods",
    "roles",
    "reflections",
    "references",
    "frames",
    "scan",
    "noise",
    "geometry",
    "inspection",
    "findings",
    "estimates",
    "preview",
    "page",
    "shown",
    "tev",
    "report",
    "tonemapping",
}


def imports(file: Path) -> set[str]:
    """Modules of the project and of others that a file imports when it is loaded or run, as dotted names."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
    return names


def modules() -> dict[str, set[str]]:
    """Module (or sub-package) of svgf_jax -> those of svgf_jax that it imports."""
    package = ROOT / "svgf_jax"
    found: dict[str, set[str]] = {}
    for file in package.rglob("*.py"):
        name = file.relative_to(package).parts[0].removesuffix(".py")
        if name == "__init__":
            continue
        own = {dotted.split(".")[1] for dotted in imports(file) if dotted.startswith("svgf_jax.")}
        found.setdefault(name, set()).update(own - {name})
    return found


def floor_of(name: str) -> int:
    return next(i for i, floor in enumerate(FLOORS) if name in floor)


def test_every_module_has_a_floor():
    assert modules().keys() <= set().union(*FLOORS)


def test_imports_go_down():
    names = set().union(*FLOORS)
    upward = [f"{a} imports {b}" for a, used in modules().items() for b in used & names if floor_of(b) >= floor_of(a)]
    assert not upward


def test_stages_do_not_know_each_other():
    found = modules()
    assert not [f"{a} imports {found[a] & STAGES}" for a in STAGES & found.keys() if found[a] & STAGES]


@pytest.mark.parametrize("name", sorted(NUMPY_ONLY))
def test_reading_files_needs_no_jax(name):
    for dotted in imports(ROOT / "svgf_jax" / f"{name}.py"):
        assert dotted.split(".")[0] != "jax" or name == "types", f"{name} imports {dotted}"


def test_the_library_does_not_know_the_tuner():
    for file in (ROOT / "svgf_jax").rglob("*.py"):
        assert not {name.split(".")[0] for name in imports(file)} & {"tune", "optimistix", "equinox", "lineax"}, file


def test_the_oracles_do_not_know_the_library():
    for file in (ROOT / "tests").glob("oracle*.py"):
        others = {name.split(".")[0] for name in imports(file)} - {"numpy", "math", "typing", "collections"}
        assert all(name.startswith("oracle") for name in others), file


def test_files_stay_small():
    long = {f: n for f in ROOT.rglob("*.py") if ".venv" not in str(f) and (n := f.read_text().count("\n")) > 420}
    assert not long
