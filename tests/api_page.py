"""The page svgf_jax/docs/api.md, from the sources alone: signatures and the first sentences of docstrings.

    python tests/api_page.py        writes the page

A module with public names must be in a group below.
"""

import ast
import inspect
from pathlib import Path

import svgf_jax
import tune

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "svgf_jax" / "docs" / "api.md"
GROUPS = {
    "svgf_jax": {
        "The filter": ["pipeline", "devices", "types", "parameters"],
        "Its stages": [
            *("sanitation", "color", "outliers", "reprojection", "reflections", "adaptation", "accumulation"),
            *("variance", "edges", "atrous", "modulation", "antialiasing"),
        ],
        "Files and arrays": ["frames", "arrays", "references", "demo"],
        "Pictures": ["tonemapping"],
        "Other filters": ["joint_bilateral", "methods", "baselines"],
        "Samples of a pixel": ["moments"],
    },
    "tune": {"Tuning": ["fitting", "shots", "targets", "evaluate", "residuals", "knowledge"]},
}
WIDTH = 110  # of a signature that stays on a line
HEAD = """# API reference

Everything public in `svgf_jax` and `tune`: signatures, and the first sentences of the docstrings. `help(svgf_jax.denoise)` has the
rest: shapes, units, ranges, errors and sources. Arrays are `[H, W, C]`, signals `[S, H, W, C]`, sequences have a leading T;
the table of channels stands at the top of [types.py](../types.py), the order of the stages in [concepts](concepts.md).

Names are imported when first used. All functions from arrays to arrays jit, vmap and differentiate, except `trace_reflections` and
those that make or read frames, which are NumPy's. Options are keyword-only. What a reader can mend raises `SvgfError`.

*Written by `python tests/api_page.py`.*
"""


def definitions(text):
    """Each definition of a source: its node and its docstring."""
    nodes = ast.parse(text).body
    found = {n.name: (n, ast.get_docstring(n)) for n in nodes if isinstance(n, ast.FunctionDef | ast.ClassDef)}
    for node, following in zip(nodes, [*nodes[1:], None], strict=True):  # NAME = value, and a string below it
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        if isinstance(target, ast.Name):
            told = getattr(getattr(following, "value", None), "value", None)
            found[target.id] = node, inspect.cleandoc(told) if isinstance(told, str) else None
    return found


def signature(node, source):
    """How a function is called, what a tuple is made of, or what a constant is."""
    if isinstance(node, ast.ClassDef):
        fields = [n for n in node.body if isinstance(n, ast.AnnAssign)]
        parts = [ast.unparse(field) for field in fields]
        head, tail = f"{node.name}(", ")"
        if not fields:
            head, tail = f"{node.name}({', '.join(map(ast.unparse, node.bases))}", ")"
    elif isinstance(node, ast.FunctionDef):
        count = len(node.args.args) - len(node.args.defaults)
        positional = [(a, node.args.defaults[i - count] if i >= count else None) for i, a in enumerate(node.args.args)]
        parts = [parameter(*each) for each in positional]
        keywords = [parameter(*each) for each in zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True)]
        parts += ["*", *keywords] if keywords else []
        parts += [f"**{ast.unparse(node.args.kwarg)}"] if node.args.kwarg else []
        head, tail = f"{node.name}(", f") -> {ast.unparse(node.returns)}"
    else:
        return ast.get_source_segment(source, node)
    line = f"{head}{', '.join(parts)}{tail}"
    wrapped = line if len(line) <= WIDTH else "\n".join([head, *(f"    {part}," for part in parts), tail])
    return wrapped.replace("'", '"')


def parameter(argument, default):
    return ast.unparse(argument) + (f" = {ast.unparse(default)}" if default is not None else "")


def page():
    """The page's text."""
    parts = [HEAD]
    for package in (svgf_jax, tune):
        groups = GROUPS[package.__name__]
        grouped = [module for modules in groups.values() for module in modules]
        assert sorted(grouped) == sorted(package._HOME), "each module with public names wants a group in api_page.py"
        for title, modules in groups.items():
            parts.append(f"## {title}: `{package.__name__}`\n")
            for module in modules:
                path = ROOT / package.__name__ / f"{module}.py"
                source = path.read_text(encoding="utf-8")
                known = definitions(source)
                link = f"[{module}.py]({'..' if package is svgf_jax else '../../tune'}/{module}.py)"
                for name in sorted(package._HOME[module], key=lambda name, known=known: known[name][0].lineno):
                    node, text = known[name]
                    assert text, f"{name} of {path.name} has no docstring"
                    first = " ".join(text.split("\n\n")[0].split())
                    parts.append(f"### `{name}`\n\n```python\n{signature(node, source)}\n```\n\n{first} ({link})\n")
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(f"{PAGE.name}: {len(PAGE.read_text(encoding='utf-8').splitlines())} lines")
