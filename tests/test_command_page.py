"""Commands and flags are what the page says they are, defaults and all: none changes by accident."""

import command_page


def test_the_page_is_current():
    page = command_page.page()
    assert command_page.PAGE.read_text(encoding="utf-8") == page, "run python tests/command_page.py"
    assert all(f"## `svgf-{name}`" in page for name in ("jax denoise", "jax params diff", "tune"))


def test_a_flag_is_told_with_what_it_takes_and_its_default():
    lines = command_page.page().splitlines()
    assert any(line.startswith("- `--checkpoint-every FRAMES` [8]: Save the history") for line in lines)
    assert any(line.startswith("- `--resume`: ") for line in lines)
    assert any(line.startswith("- `--out, -o FOLDER` (needed): ") for line in lines)
    assert any(line.startswith("- `--config ") for line in lines)
