"""What the README shows works: its example runs, its commands are the ones that run here."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"^```python\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL)


def test_the_readme_has_an_example():
    assert EXAMPLES


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda text: text.splitlines()[-1][:40])
def test_example_runs(example, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "README.md", "exec"), {})
    output = capsys.readouterr().out
    assert all(float(number) != 0 for number in re.findall(r"Array\((\S+?),", output))  # a derivative that acts
    printed = output.splitlines()
    claimed = re.findall(r"print\(.*\)  # (\(.*?\))", example)
    assert all(claim in printed for claim in claimed)


def test_ci_runs_the_test_command_of_the_readme():
    command = re.search(r"## Test it\n\n```sh\n(.*?)\n```", README, flags=re.DOTALL).group(1)
    assert f"\n    {command}\n" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")
