"""What an inspection says where it cannot be sure, or where one thing wrong makes others look so."""

import math

import numpy as np
import pytest
from rooms import write_room

from svgf_jax.commands.inspect import _motion
from svgf_jax.findings import judge
from svgf_jax.frames import open_source
from svgf_jax.inspection import inspect_source
from svgf_jax.motion import parse_convention
from svgf_jax.warping import FARTHEST, Residual, Verdict, shown


@pytest.fixture(scope="module")
def facts(tmp_path_factory):
    return inspect_source(open_source(write_room(tmp_path_factory.mktemp("room"), range(2)), motion="from-previous"))


def topics(facts):
    return {one.topic: one for one in judge(facts)}


def test_of_several_conventions_that_fit_it_names_none_as_the_one_to_take(facts):
    assert topics(facts)["motion"].remedy == "Say so: --motion 'pixel y-down to-previous'."
    both = (*facts.motion.fits, parse_convention("y-up"))
    found = topics(facts._replace(motion=facts.motion._replace(fits=both)))["motion"]
    assert all(f"'{one}'" in found.text for one in both)
    assert "do not tell which" in found.remedy
    assert "to-previous" not in found.remedy


def test_conventions_are_told_side_by_side_and_none_more_exactly_than_it_is_known(facts):
    own, up, far, out = (parse_convention(text) for text in ("", "y-up", "ndc", "fraction"))
    residuals = {own: Residual(0.1, 1.0, ("normal", "id"), 99), up: Residual(0.1, 1.0, ("normal", "id"), 99)}
    residuals |= {None: Residual(2.0, 1.0, ("normal",), 99), far: Residual(FARTHEST, 1.0, ("normal",), 99)}
    verdict = Verdict(residuals | {out: Residual(FARTHEST, 0.0, (), 99)}, (own, up))
    rows = list(_motion(facts._replace(motion=verdict)))
    assert rows[:3] == [
        ("tried", f"{own} (fits), {up} (fits): 0.1 pixels off (by normal, id)"),
        ("", "no motion at all: 2 pixels off (by normal)"),
        ("", f"{far}, {out}: 4 or more pixels off"),
    ]
    assert shown(3.97) == "4 or more"
    assert shown(3.5) == "3.5"


def test_little_noise_is_not_accused(facts):
    for spread, level in ((0.05, "note"), (0.13, "warning")):
        found = topics(facts._replace(correlation=0.5, spread=spread))["correlated noise"]
        assert found.level == level
    assert facts.spread > 0.13


def test_one_thing_is_said_once(facts):
    black = topics(facts._replace(psnr=math.inf))
    assert "does not vary" in black["noise"].text
    assert "motion" not in topics(facts._replace(background=1.0))


def test_the_test_that_loses_history_is_named(tmp_path):
    def shuffle(number, planes):
        planes["id"] += 10 * number * (planes["id"] != -1)

    def grow(number, planes):
        planes["depth"] *= 1 + number

    for change, lost in ((shuffle, "id"), (grow, "depth")):
        folder = write_room(tmp_path / lost, range(2), change=change, cameras=False)
        facts = inspect_source(open_source(folder))
        assert facts.lost == lost
        assert f"{lost}s differ" in topics(facts)["history"].text
    assert "--channel id=none" in topics(inspect_source(open_source(tmp_path / "id")))["history"].remedy
    facts = inspect_source(open_source(tmp_path / "id", channel={"id": ["none"]}))
    assert "history" not in topics(facts)
    assert np.isclose(facts.continuity.share, 1, atol=0.05)
