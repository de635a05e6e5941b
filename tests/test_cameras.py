"""Exact previous positions from cameras.json, on invented scenes and on the real ones."""

import json

import numpy as np
import pytest

from svgf_jax import SvgfError, exr
from svgf_jax.cameras import (
    find_camera,
    load_cameras,
    pixel_centres,
    position_from_depth,
    position_residual,
    previous_depth,
    reproject,
)

SEQUENCES = ["cornell-dolly", "gallery-pan", "lights-flicker"]
H, W = 27, 48


def turn(angle, x=0.0, y=0.0, z=0.0):
    """Rotation about the vertical axis, then a shift."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s, x], [0, 1, 0, y], [-s, 0, c, z], [0, 0, 0, 1]])


PERSPECTIVE = np.array([[40, 0, W / 2, 0], [0, 40, H / 2, 0], [0, 0, 1, -0.05], [0, 0, 1, 0]])
PARALLEL = np.array([[9, 0, 0, W / 2], [0, 9, 0, H / 2], [0, 0, 1, 0], [0, 0, 0, 1]])


def entry(number, camera, *, screen=PERSPECTIVE, **objects):
    matrices = {key: {str(k): m.tolist() for k, m in value.items()} for key, value in objects.items()}
    return {"frame": number, "world_to_camera": camera.tolist(), "camera_to_screen": screen.tolist(), **matrices}


@pytest.fixture
def make(tmp_path):
    """Cameras from a list of entries, by way of the file."""

    def make(*entries, **top):
        (tmp_path / "cameras.json").write_text(json.dumps({"per_frame": list(entries), **top}))
        return load_cameras(tmp_path / "cameras.json")

    return make


def scene():
    rng = np.random.default_rng(0)
    return rng.uniform(2, 9, (H, W)), rng.integers(0, 3, (H, W)).astype(np.int32)


@pytest.mark.parametrize("screen", [PERSPECTIVE, PARALLEL])
@pytest.mark.parametrize("origin", [(0, 0), (7, -3)])
def test_a_position_from_depth_lands_on_its_pixel_at_that_depth(make, screen, origin):
    camera = find_camera(make(entry(0, turn(0.4, 1, 2, 3), screen=screen)), 0)
    depth, _ = scene()
    position = position_from_depth(camera, depth, origin=origin)
    assert position_residual(camera, position, origin=origin).max() < 1e-9
    z = position @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    np.testing.assert_allclose(z, depth, rtol=1e-12)


def test_a_still_camera_and_scene_has_no_motion(make):
    cameras = make(entry(0, turn(0.3, 1)), entry(1, turn(0.3, 1)))
    depth, ids = scene()
    ids[:5] = -1
    prev_depth, motion = reproject(cameras, depth, ids, number=1, previous=0)
    np.testing.assert_allclose(motion, 0, atol=1e-5)
    np.testing.assert_allclose(prev_depth[5:], depth[5:], rtol=1e-6)
    np.testing.assert_array_equal(prev_depth[:5], 0)
    assert prev_depth.dtype == motion.dtype == np.float32


def test_a_dolly_adds_its_way_to_the_depth_and_spreads_from_the_middle(make):
    cameras = make(entry(0, turn(0)), entry(1, turn(0, z=-0.5)))  # half a unit forward: things come nearer
    depth, ids = scene()
    prev_depth, motion = reproject(cameras, depth, ids, number=1, previous=0)
    np.testing.assert_allclose(prev_depth, depth + 0.5, rtol=1e-6)
    from_middle = pixel_centres((H, W)) - [W / 2, H / 2]
    np.testing.assert_allclose(motion, from_middle * (depth / (depth + 0.5) - 1)[..., None], atol=1e-4)


def test_motion_agrees_with_a_loop_over_points_of_moving_objects(make):
    move = {1: turn(0.2, 0.1, 0.2, -0.1), 2: turn(-0.1, z=0.3)}
    cameras = make(entry(4, turn(0.1)), entry(5, turn(0.15, 0.2, 0, -0.3), object_motion=move))
    depth, ids = scene()
    prev_depth, motion = reproject(cameras, depth, ids, number=5, previous=4)
    position = position_from_depth(cameras.frames[5], depth)
    for y, x in [(0, 0), (13, 20), (26, 47), (5, 30)]:
        point = move.get(ids[y, x], np.eye(4)) @ [*position[y, x], 1]
        there = cameras.frames[4].world_to_camera @ point
        screen = PERSPECTIVE @ there
        np.testing.assert_allclose(prev_depth[y, x], there[2], rtol=1e-6)
        np.testing.assert_allclose(motion[y, x] + [x + 0.5, y + 0.5], screen[:2] / screen[3], atol=1e-4)
    np.testing.assert_allclose(previous_depth(cameras, depth, ids, number=5, previous=4), prev_depth, rtol=1e-6)
    given, same = reproject(cameras, depth, ids, number=5, previous=4, position=position)
    np.testing.assert_allclose(given, prev_depth, rtol=1e-6)
    np.testing.assert_allclose(same, motion, atol=1e-4)


def test_several_frames_back_and_object_to_world_say_the_same(make):
    poses = [turn(0.1 * i, 0.2 * i, 0, 5) for i in range(4)]
    lookout = [turn(0.05 * i) for i in range(4)]
    steps = [np.eye(4)] + [poses[i - 1] @ np.linalg.inv(poses[i]) for i in range(1, 4)]
    depth, ids = scene()
    by_motion = make(*(entry(i, lookout[i], object_motion={1: steps[i]}) for i in range(4)))
    by_pose = make(*(entry(i, lookout[i], object_to_world={1: poses[i]}) for i in range(4)))
    for got, want in zip(*(reproject(c, depth, ids, number=3, previous=0) for c in (by_motion, by_pose)), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-5)


def test_world_to_screen_may_stand_for_camera_to_screen(make):
    whole = entry(0, turn(0.4, 1))
    other = {**whole, "world_to_screen": (PERSPECTIVE @ turn(0.4, 1)).tolist()}
    del other["camera_to_screen"]
    np.testing.assert_allclose(make(other).frames[0].camera_to_screen, PERSPECTIVE, atol=1e-12)


def test_sky_turns_with_the_camera_and_does_not_shift_with_it(make):
    cameras = make(entry(0, turn(0.1, 5, 0, 2)), entry(1, turn(0.15)), entry(2, turn(0.1)))
    sky = np.full((H, W), -1)
    _, motion = reproject(cameras, np.zeros((H, W)), sky, number=1, previous=0)
    far, ids = np.full((H, W), 1e7), np.zeros((H, W), int)
    _, want = reproject(cameras, far, ids, number=1, previous=0)
    np.testing.assert_allclose(motion, want, atol=1e-3)
    _, shifted = reproject(cameras, np.zeros((H, W)), sky, number=2, previous=0)
    np.testing.assert_allclose(shifted, 0, atol=1e-4)


def test_points_behind_the_previous_camera_come_from_far_outside(make):
    cameras = make(entry(0, turn(0, z=-20)), entry(1, turn(0)))
    depth, ids = scene()
    prev_depth, motion = reproject(cameras, depth, ids, number=1, previous=0)
    assert (prev_depth < 0).all()
    np.testing.assert_allclose(motion + pixel_centres((H, W)), -1e4, rtol=1e-6)


def test_a_position_that_is_not_finite_gives_no_previous_depth(make):
    cameras = make(entry(0, turn(0)), entry(1, turn(0.1)))
    depth, ids = scene()
    position = position_from_depth(cameras.frames[1], depth)
    position[3, 4] = np.nan
    prev_depth, _ = reproject(cameras, depth, ids, number=1, previous=0, position=position)
    assert np.isnan(prev_depth[3, 4])
    assert np.isfinite(prev_depth).sum() == H * W - 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not valid JSON"),
        ("[]", 'no list "per_frame"'),
        ('{"per_frame": []}', 'no list "per_frame"'),
        ('{"per_frame": [{"frame": "a"}]}', r"per_frame\[0\] has \"frame\": 'a'"),
        ('{"per_frame": [{"frame": 3}]}', 'frame 3: "world_to_camera" is missing; wanted 4 x 4'),
        ('{"per_frame": [{"frame": 3, "world_to_camera": [[1, 2], [3]]}]}', "is wrong; wanted 4 x 4"),
        ('{"per_frame": [{"frame": 3, "world_to_camera": "EYE"}]}', r"\(or \"world_to_screen\"\) is missing"),
        ('{"per_frame": [{"frame": 3, "world_to_camera": "ZERO"}]}', "cannot be inverted"),
        ('{"per_frame": [{"frame": 3, "world_to_camera": "NAN"}]}', "finite numbers"),
        (
            '{"per_frame": [{"frame": 3, "world_to_camera": "EYE", "world_to_screen": "EYE", '
            '"object_motion": {"x": 1}}]}',
            "wants matrices by object id",
        ),
    ],
)
def test_schema_errors_name_the_file_and_the_place(tmp_path, content, message):
    for name, matrix in {"EYE": np.eye(4), "ZERO": np.zeros((4, 4)), "NAN": np.full((4, 4), np.nan)}.items():
        content = content.replace(f'"{name}"', json.dumps(matrix.tolist()))
    (tmp_path / "cameras.json").write_text(content)
    with pytest.raises(SvgfError, match=rf"cameras\.json: .*{message}"):
        load_cameras(tmp_path / "cameras.json")


def test_a_frame_without_a_camera_and_a_frame_twice(make, tmp_path):
    with pytest.raises(SvgfError, match="no camera for frame 9; it has frames 0 to 1"):
        find_camera(make(entry(0, turn(0)), entry(1, turn(0))), 9)
    with pytest.raises(SvgfError, match="each only once"):
        make(entry(0, turn(0)), entry(0, turn(0)))
    with pytest.raises(SvgfError, match=r"none\.json: cannot be read"):
        load_cameras(tmp_path / "none.json")


def planes(path):
    channels = exr.read(path).channels
    position = np.stack([channels[f"position.{c}"] for c in "XYZ"], -1) if "position.X" in channels else None
    motion = np.stack([channels["motion.X"], channels["motion.Y"]], -1)
    return channels["depth.Z"], channels["id.I"].astype(np.int32), motion, position


@pytest.mark.parametrize("name", SEQUENCES)
def test_the_real_motion_vectors_follow_from_the_cameras(data, name):
    cameras = load_cameras(data / name / "cameras.json")
    assert cameras.size == (480, 270)
    for number in (1, 3, 9):
        depth, ids, motion, position = planes(data / name / f"frame_{number:04d}.exr")
        got = [reproject(cameras, depth, ids, number=number, previous=number - 1)]
        if position is not None:
            got.append(reproject(cameras, depth, ids, number=number, previous=number - 1, position=position))
            np.testing.assert_allclose(got[0][0], got[1][0], rtol=1e-3)
        for _, derived in got:
            error = np.abs(derived - motion).max(-1)
            assert np.quantile(error, 0.999) < 0.02
            assert error.max() < 0.2


def test_the_real_positions_land_on_their_pixels(data):
    cameras = load_cameras(data / "cornell-dolly" / "cameras.json")
    for number in (0, 7):
        _, ids, _, position = planes(data / "cornell-dolly" / f"frame_{number:04d}.exr")
        residual = position_residual(cameras.frames[number], position)
        assert residual[ids >= 0].max() < 0.1


@pytest.mark.parametrize("name", SEQUENCES)
def test_previous_depth_is_what_the_real_previous_frame_shows_there(data, name):
    cameras = load_cameras(data / name / "cameras.json")
    depth, ids, motion, position = planes(data / name / "frame_0004.exr")
    before, before_ids, _, _ = planes(data / name / "frame_0003.exr")
    prev_depth, _ = reproject(cameras, depth, ids, number=4, previous=3, position=position)
    place = pixel_centres(depth.shape) + motion - 0.5
    corner = np.floor(place).astype(int)
    inside = ((corner >= 0) & (corner < np.array(depth.shape)[::-1] - 1)).all(-1) & (ids >= 0)
    corner[~inside] = 0
    weight = place - corner
    sampled = np.zeros(depth.shape)
    same = inside.copy()
    for dx, dy in [(0, 0), (1, 0), (0, 1), (1, 1)]:
        x, y = corner[..., 0] + dx, corner[..., 1] + dy
        share = np.abs(1 - dx - weight[..., 0]) * np.abs(1 - dy - weight[..., 1])
        sampled += share / np.where(before[y, x] > 0, before[y, x], 1)  # 1 / z is linear on the screen
        same &= before_ids[y, x] == ids
    error = np.abs(1 / sampled[same] - prev_depth[same]) / prev_depth[same]
    assert same.mean() > 0.5
    assert np.quantile(error, 0.9) < 2e-3
