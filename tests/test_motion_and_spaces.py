"""What the numbers in files mean: motion in world space and in the frame before, distances, normals in camera space."""

import json

import numpy as np
import pytest
from test_renderer_tables import rotation
from test_renderers import H, W, planes, put

from svgf_jax import SvgfError
from svgf_jax.frames import open_source, read_frame


def native(number, **more):
    channels = planes("", 1) | planes("depth", 4, "Z") | planes("normal", [0, 0, -1], "XYZ")
    return channels | more


def camera_file(folder, numbers):
    """Cameras that go to the right by 0.1 a frame."""
    screen = [[10, 0, W / 2, 0], [0, 10, H / 2, 0], [0, 0, 1, -0.1], [0, 0, 1, 0]]
    entries = []
    for number in numbers:
        matrix = np.eye(4)
        matrix[0, 3] = -0.1 * number
        entries.append({"frame": number, "world_to_camera": matrix.tolist(), "camera_to_screen": screen})
    (folder / "cameras.json").write_text(json.dumps({"per_frame": entries}))


@pytest.mark.parametrize("words", ["world", "world from-previous"])
def test_motion_in_world_space(tmp_path, words):
    sign = -1 if "from" in words else 1
    for number in (0, 1):
        put(tmp_path, native(number) | planes("motion", [0.2 * sign, 0, 0.4 * sign], "XYZ"), f"frame_{number}.exr")
    with pytest.raises(SvgfError, match="motion in world space needs cameras, and positions or depth"):
        open_source(tmp_path, motion=words)
    camera_file(tmp_path, [0, 1])
    source = open_source(tmp_path, motion=words)
    frame = read_frame(source, 1).frame
    x = (2.5 - W / 2) * 4 / 10  # of the point seen at pixel 2, in camera space; the camera before was 0.1 further left
    np.testing.assert_allclose(frame.motion[0, 2, 0], 10 * (x + 0.1 + 0.2) / 4.4 + W / 2 - 2.5, rtol=1e-5)
    np.testing.assert_allclose(frame.prev_depth, 4.4, rtol=1e-6)
    assert not read_frame(source, 0).frame.motion.any()


def test_motion_that_stands_in_the_frame_before(tmp_path):
    for number in (0, 1, 2):
        put(tmp_path, native(number) | planes("motion", [number + 1, 0], "XY"), f"frame_{number}.exr")
    source = open_source(tmp_path, motion="to-next")
    assert [read_frame(source, i).frame.motion[0, 0, 0] for i in range(3)] == [0, -1, -2]
    held = open_source(tmp_path, motion="to-next", frames="0,2")
    assert not read_frame(held, 1).frame.motion.any()


def test_depth_along_the_ray_becomes_z(tmp_path):
    y, x = np.mgrid[:H, :W]
    along = np.sqrt(1 + ((x + 0.5 - W / 2) / 10) ** 2 + ((y + 0.5 - H / 2) / 10) ** 2)
    far = planes("", 1) | {"dist.T": (4 * along).astype(np.float32), "nn.X": 0 * x.astype(np.float32)}
    far |= {"nn.Y": far["nn.X"], "nn.Z": far["nn.X"] - 1}
    put(tmp_path, far, "frame_0.exr")
    camera_file(tmp_path, [0])
    frame = read_frame(open_source(tmp_path, renderer="mitsuba"), 0).frame
    np.testing.assert_allclose(frame.depth, 4, rtol=1e-6)


def test_normals_in_camera_space_come_to_the_world(tmp_path):
    """Camera turned about y; a table says where its z points."""
    turn = rotation(0.3)
    entry = {"frame": 0, "world_to_camera": turn.tolist()}
    entry["camera_to_screen"] = [[10, 0, W / 2, 0], [0, 10, H / 2, 0], [0, 0, 1, -0.1], [0, 0, 1, 0]]
    wanted = np.array([0.6, -0.48, -0.64])
    for words, sign in (("camera", 1), ("camera z-back", -1)):
        mine = (turn[:3, :3] @ wanted) * [1, -1, sign]  # y up
        folder = put(tmp_path / str(sign), native(0) | planes("normal", mine, "XYZ"), "frame_0.exr")
        (folder / "cameras.json").write_text(json.dumps({"per_frame": [entry]}))
        (tmp_path / "mine.toml").write_text(f'[meaning]\nnormal = "{words}"\n')
        table = str((tmp_path / "mine.toml").rename(tmp_path / f"mine{sign}.toml"))
        frame = read_frame(open_source(folder, renderer=table), 0).frame
        np.testing.assert_allclose(frame.normal, np.broadcast_to(wanted, (H, W, 3)), atol=1e-6)
        (told,) = [text for text in open_source(folder, renderer=table, cameras=None).warnings if "space" in text]
        assert told.startswith("normals are in camera space, and no camera is known")
