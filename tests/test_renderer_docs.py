"""The page about renderers says what is so: its tables are all there, its commands exist, its table of one's own loads."""

import ast
import re
from pathlib import Path

import pytest

from svgf_jax.cli import main
from svgf_jax.renderers import load_table, renderer_names

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "svgf_jax" / "docs" / "renderers.md").read_text(encoding="utf-8")
MULTIPART = ROOT / "tests" / "data" / "cycles"


def test_every_renderer_is_on_the_page():
    assert not [name for name in renderer_names()[1:] if f"`{name}`" not in PAGE]


def test_the_table_on_the_page_loads(tmp_path):
    (text,) = re.findall(r"```toml\n(.*?)```", PAGE, flags=re.DOTALL)
    (tmp_path / "ours.toml").write_text(text)
    assert load_table(str(tmp_path / "ours.toml")).meaning == {"motion": "pixel y-up from-previous"}


def test_the_camera_of_the_page_is_the_one_that_made_the_test_files():
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    script = ast.parse((ROOT / "tests" / "bench" / "render_mitsuba.py").read_text(encoding="utf-8"))
    (there,) = [node for node in script.body if isinstance(node, ast.FunctionDef) and node.name == "matrices"]
    there.body = there.body[1:]  # its docstring
    assert ast.dump(ast.parse(code).body[0]) == ast.dump(there)


def test_the_options_of_the_command(tmp_path, capsys):
    def run(*arguments):
        with pytest.raises(SystemExit) as stopped:
            main(["denoise", *map(str, arguments), "-o", str(tmp_path / "out"), "--dry-run"])
        return stopped.value.code, capsys.readouterr().err

    code, told = run(MULTIPART / "layers")
    assert code != 0
    assert "2 view layers: 'Other', 'ViewLayer'. Say which: --layer NAME" in " ".join(told.split())
    code, told = run(MULTIPART / "layers", "--layer", "Other")
    assert code == 0, told
    assert "glossy_direct Other.Glossy Direct.RGB, albedo Other.Glossy Color.RGB" in " ".join(told.split())
    code, told = run(MULTIPART / "multipart", "--renderer", "cycles", "--motion", "ndc")
    assert code == 0, told
    assert "ViewLayer.Vector.XY (cycles name; ndc y-down to-previous)" in told
    code, told = run(MULTIPART / "multipart", "--motion", "sideways")
    assert code != 0
    assert "'sideways' is not known; wanted one each of pixel|fraction|ndc|world" in " ".join(told.split())
