"""GAMES202's files as they are: found without being named, matrices read and checked, motion and previous depth exact."""

import re
import shutil

import games202
import numpy as np
import pytest

from svgf_jax import SvgfError, exr
from svgf_jax.frames import load_sequence, open_source, read_frame
from svgf_jax.types import Frame


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    return games202.write_shot(tmp_path_factory.mktemp("box"))


@pytest.mark.parametrize("place", ["", "input", "input/beauty_#.exr", "input/beauty_%d.exr"])
def test_the_folder_is_enough(shot, place):
    source = open_source(shot / place)
    assert [number for number, _ in source.sequence.files] == [0, 1, 2, 3]
    assert {role for role, layer in source.roles.layers.items() if layer.own_file} == {
        "normal",
        "position",
        "depth",
        "id",
    }
    assert [text.split(":")[0] for text in source.warnings] == ["no albedo"]
    frame = read_frame(source, 0).frame
    assert frame.position is None
    assert (frame.object_id[:, :2] == -1).all()
    assert set(np.unique(frame.object_id)) == {-1, 0, 1}


def test_motion_is_that_of_the_matrices(shot):
    """Screen_{i-1} = P_{i-1} V_{i-1} M_{i-1} M_i^{-1} World_i, a point at a time."""
    frames = load_sequence(shot, position=True)
    assert not frames.motion[0].any()
    for i in (1, 2, 3):
        before, now = games202.matrices(i - 1), games202.matrices(i)
        for y, x in ((0, 2), (7, 8), (3, 15), (13, 17)):
            m, past = (np.asarray(side[frames.object_id[i, y, x]], np.float64) for side in (now, before))
            point = past @ np.linalg.inv(m) @ np.append(frames.position[i, y, x], 1.0)
            screen = before[-1].astype(np.float64) @ point
            np.testing.assert_allclose(frames.motion[i, y, x], screen[:2] / screen[3] - [x + 0.5, y + 0.5], atol=1e-4)
            np.testing.assert_allclose(frames.prev_depth[i, y, x], before[-2][2].astype(np.float64) @ point, rtol=1e-5)
    assert np.abs(frames.motion[1:]).max() > 1


def test_positions_come_from_depth_where_there_are_none(shot, tmp_path):
    bare = shutil.copytree(shot, tmp_path / "bare")
    for file in bare.glob("input/position_*"):
        file.unlink()
    given, derived = (load_sequence(folder, position=True, frames="1-2") for folder in (shot, bare))
    surface = given.object_id != -1
    np.testing.assert_allclose(derived.position[surface], given.position[surface], atol=1e-5)
    np.testing.assert_allclose(derived.motion[surface], given.motion[surface], atol=1e-3)
    for file in bare.glob("input/matrix_*"):
        file.unlink()
    with pytest.raises(SvgfError, match=r"beauty_0\.exr: no positions"):
        open_source(bare, position=True)


GOOD = games202.matrices(0)
NAN = np.where(np.eye(4) == 1, np.nan, 0)
BROKEN = {
    "empty": (b"", "wanted an int32 n"),
    "short": (games202.pack(*GOOD)[:-3], "257 bytes that begin with 2"),
    "long": (games202.pack(*GOOD) + b"\0", "64 n"),
    "n too large": (games202.pack(*GOOD, count=2**31 - 1), "begin with 2147483647"),
    "n below 0": (games202.pack(*GOOD, count=-7), "begin with -7"),
    "NaN": (games202.pack(GOOD[0], NAN, *GOOD[2:]), "object 1 to world is not finite"),
    "object squashed": (
        games202.pack(GOOD[0], np.diag([1, 1, 0, 1]), *GOOD[2:]),
        "object 1 to world cannot be inverted",
    ),
    "no camera": (games202.pack(*GOOD[:2], np.ones((4, 4)), GOOD[3]), "world to camera cannot be inverted"),
    "no screen": (games202.pack(*GOOD[:3], np.zeros((4, 4))), "world to screen cannot be inverted"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_matrices_are_told_before_any_work(shot, tmp_path, name):
    content, complaint = BROKEN[name]
    broken = shutil.copytree(shot, tmp_path / "broken")
    (broken / "input" / "matrix_2.mat").write_bytes(content)
    with pytest.raises(SvgfError, match=r"matrix_2\.mat.*--cameras none") as error:
        open_source(broken)
    assert complaint in str(error.value)
    assert open_source(broken, cameras=None).cameras is None


def test_a_missing_matrix_is_told(shot, tmp_path):
    broken = shutil.copytree(shot, tmp_path / "broken")
    (broken / "input" / "matrix_1.mat").unlink()
    with pytest.raises(SvgfError, match=r"matrix_#\.mat: frames 1 of .*beauty_#\.exr are missing"):
        open_source(broken)


def replaced(shot, folder, name, change):
    """A copy of the shot whose images `name` were changed."""
    copy = shutil.copytree(shot, folder)
    for path in copy.glob(f"input/{name}_*.exr"):
        image = exr.read(path)
        exr.write(path, image._replace(channels={c: change(v).astype(np.float32) for c, v in image.channels.items()}))
    return copy


def test_cameras_of_another_picture_are_told_once(shot, tmp_path):
    upside_down = replaced(shot, tmp_path / "flipped", "position", lambda v: v[::-1].copy())
    with pytest.warns(UserWarning, match=r"matrix_#\.mat: positions are shown more than 0\.1 pixels beside") as told:
        load_sequence(upside_down)
    assert len(told) == 1
    share, most = re.search(
        r" In frame 0: ([\d.]+) % of .* at most ([\d.]+) pixels beside\.$", str(told[0].message)
    ).groups()
    assert 90 < float(share) <= 100
    assert games202.SIZE[0] / 2 < float(most) < 2 * games202.SIZE[0]


def test_a_depth_that_is_no_z_is_told(shot, tmp_path):
    distance = replaced(shot, tmp_path / "distance", "depth", lambda v: 1.2 * v)
    notes = read_frame(open_source(distance), 1).notes
    assert len(notes) == 1
    assert "depth is not the camera's z" in notes[0]
    assert notes[0].endswith("In frame 1: 100 % of the pixels with a surface are more than 1 % off.")


def test_what_is_in_the_file_or_given_by_hand_comes_first(shot, tmp_path):
    (tmp_path / "flat").mkdir()
    games202.write(tmp_path / "flat" / "n.exr", {c: np.full(games202.SIZE, float(c == "B"), np.float32) for c in "RGB"})
    source = open_source(shot, file={"normal": tmp_path / "flat" / "n.exr"})
    normal = read_frame(source, 0).frame.normal
    np.testing.assert_array_equal(normal[5, 5], [0, 0, 1])


def test_the_homework_itself(data):
    """The real files: what the projections say of every pixel, and how far the ball moves."""
    source = open_source(data / "games202-box")
    items = [read_frame(source, index) for index in (0, 3)]
    assert [item.notes for item in items] == [(), ()]
    assert [item.counts for item in items] == [{}, {}]
    frame: Frame = items[1].frame
    moving = frame.object_id == 6
    assert np.abs(frame.motion[~moving & (frame.object_id != -1)]).max() < 1e-3
    assert 20 < np.abs(frame.motion[moving]).max() < 40
    assert np.abs(frame.prev_depth - frame.depth)[moving].max() > 0.1
