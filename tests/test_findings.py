"""The words in which an inspection's findings are told, and the page about them."""

import re
from pathlib import Path

from test_dry_run import run

from svgf_jax import sample
from svgf_jax.commands.inspect import _sentence
from svgf_jax.findings import Finding, verdict
from svgf_jax.remedies import REMEDIES, remedy


def test_every_remedy_says_something_to_do():
    for topic, by_renderer in REMEDIES.items():
        assert "" in by_renderer, topic
        for renderer, text in by_renderer.items():
            assert re.fullmatch(r"\S.*[.)]", text), (topic, renderer)
            assert remedy(topic, renderer) == text


def test_a_sentence_begins_with_a_capital_letter_but_a_path_does_not():
    for text in ("gaps/frame_0001.exr: cut off", "my shots/a.exr: cut off", "room.0001.exr: cut off"):
        assert _sentence(text) == text
    assert _sentence("frames 3 are missing.") == "Frames 3 are missing."
    assert _sentence("no albedo: taken as 1.") == "No albedo: taken as 1."
    assert _sentence("fast: 1/2") == "Fast: 1/2"


def test_a_verdict_counts():
    error, warning, note = (Finding(level, "", "", "") for level in ("error", "warning", "note"))
    assert verdict((note,)) == "ready"
    assert verdict((warning, note)) == "can run, 1 thing to mend"
    assert verdict((error, warning, warning)) == "cannot run: 1 error, 2 things to mend"
    assert verdict((error, error)) == "cannot run: 2 errors"


DOCS = Path(__file__).parents[1] / "svgf_jax" / "docs"


def test_the_page_shows_what_it_prints(capsys):
    """Labels and sentences; numbers may differ in their last digit."""
    page = (DOCS / "inspect.md").read_text(encoding="utf-8")
    shown = re.search(r"```text\n(.*?)```", page, flags=re.DOTALL).group(1)
    out = run(capsys, "inspect", sample(), "--motion", "y-up")[1]
    words = [re.sub(r"\S*/\S*/\S*|[-\d.e]+", "", text).split() for text in (shown, out)]
    assert words[0] == words[1]
