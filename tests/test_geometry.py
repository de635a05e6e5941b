"""What is said of a frame's guides, against guides that are known."""

import numpy as np
import oracle
import pytest
import scenes
from bridge import to_frame
from rooms import SIZE, camera, room
from test_noise import frame_of

from svgf_jax import geometry
from svgf_jax.cameras import Camera
from svgf_jax.geometry import RAY_DISTANCE, VIEW_Z, Z_BUFFER


@pytest.fixture(scope="module")
def planes():
    return room(3)


def camera_of(number):
    return Camera(*camera(number), {}, {})


@pytest.mark.parametrize("name", geometry.CAMERA_AXES)
def test_normals_in_camera_space_are_told_from_those_in_world_space(planes, name):
    frame, seen = frame_of(planes), camera_of(3)
    fit = geometry.normal_space(frame, planes["position"], seen)
    assert fit.best == ("world space",)
    assert fit.misfit["world space"] < 0.1
    turned = planes["normal"] @ seen.world_to_camera[:3, :3].T * geometry.CAMERA_AXES[name]
    fit = geometry.normal_space(frame._replace(normal=turned.astype(np.float32)), planes["position"], seen)
    assert name in fit.best
    assert "world space" not in fit.best
    assert fit.misfit["world space"] > 5


def test_normals_that_face_away_are_the_same(planes):
    frame = frame_of(planes)._replace(normal=-planes["normal"])
    assert geometry.normal_space(frame, planes["position"], camera_of(3)).best == ("world space",)


def test_normals_of_something_else_fit_nowhere(planes):
    rolled = frame_of(planes)._replace(normal=np.roll(planes["normal"], 1, -1))
    assert geometry.normal_space(rolled, planes["position"], camera_of(3)).best == ()


def test_of_a_camera_along_the_axes_the_space_cannot_be_told(planes):
    seen = camera_of(3)
    fit = geometry.normal_space(frame_of(planes), planes["position"], seen._replace(world_to_camera=np.eye(4)))
    assert len(fit.best) > 1


def test_without_surfaces_nothing_is_said(planes):
    frame = frame_of(planes)
    empty = frame._replace(object_id=np.full(SIZE, -1, np.int32))
    where = np.asarray(empty.object_id) != -1
    assert geometry.normal_space(empty, planes["position"], camera_of(3)) is None
    assert geometry.depth_by_planes(frame.depth, empty, camera=None) is None
    assert geometry.depth_by_position(frame.depth, planes["position"], camera_of(3), where) is None
    assert geometry.continuity(empty, empty) == (0, 1)


def depths(planes, kind):
    z, seen = planes["depth"][..., 0].astype(float), camera_of(3)
    there = planes["position"] @ seen.world_to_camera[:3, :3].T + seen.world_to_camera[:3, 3]
    with np.errstate(all="ignore"):
        buffer = (100 - 10 / z) / 99.9  # near 0.1, far 100
    return {VIEW_Z: z, RAY_DISTANCE: np.linalg.norm(there, axis=-1), Z_BUFFER: buffer}[kind].astype(np.float32)


@pytest.mark.parametrize("kind", [VIEW_Z, RAY_DISTANCE])
def test_the_kind_of_depth_is_told_by_positions(planes, kind):
    where = planes["id"][..., 0] != -1
    assert geometry.depth_by_position(depths(planes, kind), planes["position"], camera_of(3), where).best == (kind,)


@pytest.mark.parametrize("with_camera", [True, False])
@pytest.mark.parametrize("kind", [VIEW_Z, RAY_DISTANCE, Z_BUFFER])
def test_the_kind_of_depth_is_told_by_flat_surfaces(planes, kind, with_camera):
    fit = geometry.depth_by_planes(depths(planes, kind), frame_of(planes), camera=camera_of(3) if with_camera else None)
    assert fit.best == (kind,)


def test_a_crop_is_seen_by_its_place_on_the_screen(planes):
    frame = frame_of({name: plane[10:, 20:] for name, plane in planes.items()})
    cut = depths(planes, RAY_DISTANCE)[10:, 20:]
    right, wrong = (geometry.depth_by_planes(cut, frame, camera=camera_of(3), origin=at) for at in ((20, 10), (0, 0)))
    assert right.best == (RAY_DISTANCE,)
    assert right.misfit[RAY_DISTANCE] < 0.01 * wrong.misfit[RAY_DISTANCE]


def test_a_depth_that_is_neither_fits_nothing(planes):
    rough = depths(planes, VIEW_Z) * np.random.default_rng(0).uniform(0.95, 1.05, SIZE)
    assert geometry.depth_by_planes(rough, frame_of(planes), camera=None).best == ()


def test_a_frontal_wall_is_flat():
    wall = frame_of(room(0))._replace(object_id=np.zeros(SIZE, np.int32), normal=np.full((*SIZE, 3), [0, 0, -1.0]))
    assert VIEW_Z in geometry.depth_by_planes(np.full(SIZE, 3.0), wall, camera=None).best


@pytest.mark.parametrize("seed", range(3))
def test_history_is_found_where_the_filter_finds_it(seed):
    scene = scenes.synthetic(seed, 24, 32, frames=2)
    output = oracle.denoise(scene, oracle.PAPER, oracle.PAPER_CONFIG | {"levels": 0})[1]
    previous, current = (to_frame(frame, np.float32) for frame in scene)
    found = geometry.continuity(previous, current)
    assert found.share == output["valid"][current.object_id != -1].mean()
    assert 0.5 < found.share < 1
    assert found.still < 0.1


def test_wrong_motion_loses_history():
    previous, current = frame_of(room(3, speed=4)), frame_of(room(4, speed=4))
    right = geometry.continuity(previous, current).share
    assert geometry.continuity(previous, current._replace(motion=-5 * current.motion)).share < right - 0.1


def test_expected_length_is_that_of_a_chain():
    assert geometry.expected_length(1.0, frames=4, most=32) == pytest.approx((1 + 2 + 3 + 4) / 4)
    assert geometry.expected_length(1.0, frames=4, most=2) == pytest.approx((1 + 2 + 2 + 2) / 4)
    assert geometry.expected_length(0.0, frames=9, most=32) == 1
    assert geometry.expected_length(0.9, frames=1000, most=32) == pytest.approx(10, rel=0.02)
