"""Every page says what is so: links and files exist, commands parse, flags and names are real, what is generated is current."""

import ast
import importlib.util
import re
import shlex
import tomllib
from functools import cache
from pathlib import Path

import api_page
import pytest
from cyclopts import CycloptsError

import svgf_jax
from svgf_jax.cli import app
from svgf_jax.methods import METHOD_CHOICES, METHODS, method
from svgf_jax.parameters import PRESETS
from svgf_jax.types import Config, Params
from tune.__main__ import app as tune_app

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "svgf_jax" / "docs"
PAGES = [ROOT / "README.md", ROOT / "svgf_jax" / "sample" / "README.md", *sorted(DOCS.glob("*.md"))]
EVERY_PAGE = pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```|^((?:    [^\n]*\n|\n(?=    ))+)", flags=re.MULTILINE | re.DOTALL)
LISTS = re.compile(r"^(?:  )+(?=\|)", flags=re.MULTILINE)  # a table inside a list is no block of code
CODE = re.compile(r"`([^`]+)`")
COMMAND = re.compile(r"svgf-(?:jax|tune)(?=[ \n])(?:(?!\s# )[^|&>`)\n])*")
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
PLACEHOLDER = re.compile(r"(?<!\w)\.\.\.")
SETTINGS = {*Params._fields, *Config._fields, *METHOD_CHOICES}.union(*(method(name)[0]._fields for name in METHODS))


@cache
def blocks(page):
    """(language, text) of each block of code; "" = indented or without a language."""
    found = BLOCK.findall(LISTS.sub("", page.read_text(encoding="utf-8")))
    return [(language, fenced or indented) for language, fenced, indented in found]


@cache
def prose(page):
    return BLOCK.sub("", LISTS.sub("", page.read_text(encoding="utf-8")))


def spans(page):
    return [" ".join(span.split()) for span in CODE.findall(prose(page))]


def commands(text):
    """The calls of the two commands in a text: no comments, pipes or redirections, lines put together."""
    return [call.strip() for call in COMMAND.findall(text.replace("\\\n", " "))]


@cache
def anchors(page):
    """What the headings are called in links: lower case, hyphens for spaces, no punctuation; repeated ones numbered."""
    fenced = re.compile(r"^```.*?^```", flags=re.MULTILINE | re.DOTALL)
    found, seen = set(), {}
    for title in re.findall(r"^#+ (.*)", fenced.sub("", page.read_text(encoding="utf-8")), flags=re.MULTILINE):
        plain = re.sub(r"\[(.*?)\]\(.*?\)", r"\1", title).replace("`", "").strip().lower()
        slug = re.sub(r"[^\w\- ]", "", plain).replace(" ", "-")
        found.add(f"{slug}-{seen[slug]}" if slug in seen else slug)
        seen[slug] = seen.get(slug, 0) + 1
    return found


APPS = {"svgf-jax": app, "svgf-tune": tune_app}


def called(words):
    """The command that these words call, as words: of `svgf-jax params list x` the first three."""
    found, count = APPS[words[0]], 1
    while count < len(words) and not words[count].startswith("-") and words[count] in found:
        found, count = found[words[count]], count + 1
    return tuple(words[:count])


@cache
def flags_of(command):
    """A command's own flags, and those that every command has."""
    found = APPS[command[0]]
    for word in command[1:]:
        found = found[word]
    names = {name for argument in found.assemble_argument_collection() for name in argument.names}
    every = {name for argument in APPS[command[0]].meta.assemble_argument_collection() for name in argument.names}
    return names | every | {"--help", "-h", "--version"}


@cache
def every_flag():
    """The flags of all commands."""
    ours = [("svgf-jax", name) for name in app if not name.startswith("-") and name != "params"]
    ours += [("svgf-jax", "params", name) for name in app["params"] if not name.startswith("-")]
    return set().union(*(flags_of(command) for command in [*ours, ("svgf-tune",)]))


def test_there_is_something_to_test():
    text = "svgf-jax denoise a -o b --png   # c --d\nsvgf-jax params show x > y\nsvgf-tune a \\\n  --second b\n"
    assert commands(text) == ["svgf-jax denoise a -o b --png", "svgf-jax params show x", "svgf-tune a    --second b"]
    assert "--tonemap" in flags_of(called(["svgf-jax", "denoise", "x"]))
    assert "--set" in flags_of(called(["svgf-jax", "params", "show"]))
    assert "--per-level" in every_flag() > flags_of(("svgf-jax", "compare"))
    assert "blender-cycles" in anchors(DOCS / "renderers.md")
    assert sum(len(commands(text)) for page in PAGES for _, text in blocks(page)) > 30


@EVERY_PAGE
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if target.startswith(("http:", "https:")):
            continue
        path, _, anchor = target.partition("#")
        found = (page.parent / path).resolve() if path else page
        assert found.exists(), target
        assert not anchor or anchor in anchors(found), target


@EVERY_PAGE
def test_files_that_are_named_exist(page):
    named = re.findall(
        r"\b((?:tests|svgf_jax|tune)/[a-z0-9_/]+\.(?:py|md|toml|json|png))\b", page.read_text(encoding="utf-8")
    )
    assert not [path for path in named if not (ROOT / path).exists()]


@EVERY_PAGE
def test_commands_in_blocks_parse(page):
    for language, text in blocks(page):
        for call in commands(text) if language not in ("python", "toml", "text") else ():
            words = shlex.split(call)
            assert set(FLAG.findall(call)) <= flags_of(called(words)), call
            if not PLACEHOLDER.search(call):
                try:
                    APPS[words[0]].parse_args(words[1:], exit_on_error=False, print_error=False)
                except CycloptsError as error:
                    pytest.fail(f"{call}\n{error}")


@EVERY_PAGE
def test_commands_and_flags_in_the_text_are_real(page):
    known = every_flag()
    for span in spans(page):
        for call in commands(span + " "):
            words = call.split()
            assert called(words) != ("svgf-jax",) or words[1].startswith("-"), f"no such command: {span}"
            assert set(FLAG.findall(call)) <= flags_of(called(words)), span
        first = span.split()[0]
        if first.startswith("--"):
            assert set(FLAG.findall(span)) <= known, span
        elif first in app and " --" in span:
            assert set(FLAG.findall(span)) <= flags_of(("svgf-jax", first)), span


@EVERY_PAGE
def test_settings_and_presets_are_real(page):
    text = page.read_text(encoding="utf-8")
    assert set(re.findall(r"--set (\w+)=", text)) - {"NAME"} <= SETTINGS
    assert set(re.findall(r"--preset (\w+)", text)) - {"NAME"} <= set(PRESETS)
    assert set(re.findall(r"--method ([\w-]+)", text)) - {"NAME"} <= {"svgf", *METHODS}


def test_parameter_and_project_files_on_the_pages_are_right(tmp_path):
    kinds = set()
    for page in PAGES:
        for text in (text for language, text in blocks(page) if language == "toml"):
            tables = tomllib.loads(text)
            if "params" in tables:
                (tmp_path / "mine.toml").write_text(text)
                params, config = svgf_jax.load_params(tmp_path / "mine.toml")
                assert (params, config) != (Params(), Config())
                kinds.add("parameters")
                continue
            for command in (name for name in tables if name in app):
                assert {f"--{key}" for key in tables[command]} <= flags_of(("svgf-jax", command))
                kinds.add("project")
    assert kinds == {"parameters", "project"}


def test_the_index_leads_to_every_page():
    index = (DOCS / "README.md").read_text(encoding="utf-8")
    assert not [page.name for page in DOCS.glob("*.md") if page.name != "README.md" and f"({page.name})" not in index]
    assert "(svgf_jax/docs/README.md)" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_api_page_is_current():
    current = (DOCS / "api.md").read_text(encoding="utf-8")
    assert current == api_page.page(), "run python tests/api_page.py"


def test_the_drawing_is_current_and_names_public_functions():
    spec = importlib.util.spec_from_file_location("draw_pipeline", ROOT / "tests" / "bench" / "draw_pipeline.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    current = (DOCS / "pipeline.svg").read_text(encoding="utf-8")
    assert current == script.drawing(), "run python tests/bench/draw_pipeline.py"
    names = [stage[0] for stage in script.STAGES]
    assert set(names) - set(svgf_jax.__all__) == {"follow the light"}
    assert (DOCS / "stages.jpg").stat().st_size < 250_000
    calls = [
        node.func.id for node in ast.walk(step()) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    ]
    order = [name.replace("follow the light", "follow_light") for name in names]
    assert [name for name in calls if name in order] == order


def step():
    """The source of `svgf_jax.step`, whose calls in order are the stages."""
    nodes = ast.parse((ROOT / "svgf_jax" / "pipeline.py").read_text(encoding="utf-8")).body
    return next(node for node in nodes if isinstance(node, ast.FunctionDef) and node.name == "step")
