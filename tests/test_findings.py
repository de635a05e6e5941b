"""The words in which an inspection's findings are told."""

import re

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
