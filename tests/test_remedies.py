"""What an inspection advises, done: afterwards there is nothing to mend, and the filter gets what it would have got."""

import re
import shlex

import numpy as np
import pytest
from rooms import SIZE, camera, write_room

from svgf_jax import SvgfError
from svgf_jax.findings import judge
from svgf_jax.frames import open_source, read_frame
from svgf_jax.inspection import inspect_source


def turned(*signs):
    def change(number, planes):
        planes["normal"][:] = planes["normal"] @ camera(number)[0][:3, :3].T * signs

    return change


def stretch(number, planes):
    """Depth as the length of the ray."""
    to_camera = camera(number)[0]
    there = planes["position"] @ to_camera[:3, :3].T + to_camera[:3, 3]
    planes["depth"][..., 0] = np.where(planes["id"][..., 0] == -1, 0, np.linalg.norm(there, axis=-1))


def negate(_, planes):
    planes["depth"] *= -1


def buffer(_, planes):
    planes["depth"][..., 0] = np.where(planes["depth"][..., 0] > 0, 1 - 0.5 / planes["depth"][..., 0].clip(0.5), 0)


def roughen(number, planes):
    planes["depth"] *= np.random.default_rng(number).uniform(0.8, 1.2, (*SIZE, 1))


def from_previous(_, planes):
    planes["motion"] *= -1


def scramble(_, planes):
    planes["motion"][:] = np.random.default_rng(0).normal(0, 5, planes["motion"].shape)


def zero(_, planes):
    planes["motion"][:] = 0


NO_POSITION = ("position",)
# case -> (how to write the frames, options they are opened with, topic, line that is advised)
LINES = {
    "y down": ({"change": turned(1, 1, 1)}, {}, "normals", "--meaning 'normal=camera y-down'"),
    "z back": ({"change": turned(1, -1, -1)}, {}, "normals", "--meaning 'normal=camera z-back'"),
    "y up": ({"change": turned(1, -1, 1)}, {}, "normals", "--meaning normal=camera"),
    "y up for y down": (
        {"change": turned(1, 1, 1)},
        {"meaning": {"normal": "camera"}},
        "normals",
        "--meaning 'normal=camera y-down'",
    ),
    "camera for world": ({}, {"meaning": {"normal": "camera z-back"}}, "normals", "--meaning normal=world"),
    "ray": ({"change": stretch, "drop": NO_POSITION}, {}, "depth", "--meaning depth=distance"),
    "no ray": ({"drop": NO_POSITION}, {"meaning": {"depth": "distance"}}, "depth", "--meaning depth=z"),
    "back": ({"change": negate, "drop": NO_POSITION}, {}, "depth sign", "--meaning depth=z-back"),
    "not back": ({}, {"meaning": {"depth": "z-back"}}, "depth sign", "--meaning depth=z"),
    "motion": ({"change": from_previous}, {}, "motion", "--motion 'pixel y-down from-previous'"),
    "vectors of something else": ({"change": scramble}, {}, "motion", "--channel motion=none"),
    "no vectors": ({"change": zero}, {}, "motion", "--channel motion=none"),
    "albdo": (
        {"rename": ("albedo", "albdo")},
        {},
        "no albedo",
        "--channel albedo=albdo.R,albdo.G,albdo.B",
    ),
}


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    return opened(write_room(tmp_path_factory.mktemp("clean"), range(2)))


def opened(folder, **options):
    """(the second frame, findings to be mended by topic)."""
    source = open_source(folder, **options)
    found = {one.topic: one for one in judge(inspect_source(source)) if one.level != "note"}
    return read_frame(source, 1).frame, found


def with_line(line, options):
    """What the line adds to the options."""
    option, text = shlex.split(line)
    role, _, words = text.partition("=")
    given = {"meaning": (role, words), "channel": (role, words.split(","))}.get(option[2:])
    return options | ({option[2:]: dict([given])} if given else {option[2:]: text})


@pytest.mark.parametrize("case", LINES)
def test_after_the_line_that_is_advised_all_is_well(tmp_path, clean, case):
    written, options, topic, line = LINES[case]
    folder = write_room(tmp_path, range(2), **written)
    said = opened(folder, **options)[1][topic].remedy
    assert re.search(rf"{re.escape(line)}(?=[.?]$)", said), said
    frame, found = opened(folder, **with_line(line, options))
    assert not found
    for name in ("normal", "depth", "motion", "object_id", "albedo"):
        there, wanted = getattr(frame, name), getattr(clean[0], name)
        surface = wanted if name == "object_id" else clean[0].object_id
        where = (slice(None), surface != -1) if name == "albedo" else surface != -1
        np.testing.assert_allclose(there[where], wanted[where], atol=2e-3 if name == "motion" else 1e-5, rtol=1e-5)


def test_where_no_line_helps_none_is_advised(tmp_path):
    for change, text in ((buffer, "No --meaning makes z of a z buffer"), (roughen, "Is this channel depth at all")):
        folder = write_room(tmp_path / change.__name__, range(2), change=change, drop=NO_POSITION)
        found = opened(folder)[1]
        assert text in found["depth"].remedy
        assert "linear view z" in found["depth"].remedy
        assert found.keys() <= {"depth", "normals", "motion", "history"}
        for topic in found.keys() & {"normals", "motion"}:
            assert "Mend depth first" in found[topic].remedy
    folder = write_room(tmp_path / "alone", range(2), change=stretch, cameras=False)
    assert "give a cameras.json, and say so: --meaning depth=distance" in opened(folder)[1]["depth"].remedy
    found = opened(folder, meaning={"depth": "distance"})[1]
    assert found.keys() == {"reading"}
    assert "Give a cameras.json" in found["reading"].text


def test_a_role_may_be_left_out_though_it_is_there(tmp_path):
    folder = write_room(tmp_path, range(1))
    roles = open_source(folder, channel={"motion": ["none"], "id": ["none"]}).roles
    assert not roles.layers.keys() & {"motion", "id"}
    assert "says" in roles.derived["motion"]


def test_meanings_that_are_none_are_refused(tmp_path):
    folder = write_room(tmp_path, range(1))
    for meaning, said in (
        ({"depth": "ray"}, "depth means 'ray'; wanted z, z-back, distance"),
        ({"albedo": "sRGB"}, "no meanings of 'albedo' are known; only of motion, depth"),
    ):
        with pytest.raises(SvgfError, match=re.escape(said)):
            open_source(folder, meaning=meaning)
