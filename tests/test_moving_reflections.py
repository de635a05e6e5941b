"""Reflections of things that move, and in mirrors that do: a floor that mirrors a wall, traced by hand."""

import numpy as np
import pytest

import svgf_jax as sj
from svgf_jax.cameras import Camera, Cameras

HEIGHT, WIDTH, FOCAL = 24, 32, 30.0
FLOOR, WALL, POST = 0, 1, 2
FLOOR_Y, WALL_Z, POST_Z = 1.0, 6.0, 3.0  # y points down
EYES = (np.array([0.0, 0.0, 0.0]), np.array([0.3, -0.1, 0.2]))
CENTRES = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1)
UP = np.array([0.0, -1.0, 0.0])


def lens(eye, moved):
    to_camera = np.eye(4)
    to_camera[:3, 3] = -eye
    to_screen = np.array([[FOCAL, 0, WIDTH / 2, 0], [0, FOCAL, HEIGHT / 2, 0], [0, 0, 1, 0], [0, 0, 1, 0]])
    motion = {key: np.block([[np.eye(3), np.array(by)[:, None]], [np.zeros((1, 3)), 1]]) for key, by in moved.items()}
    return Camera(to_camera, to_screen, motion, {})


def project(point, eye):
    return (point - eye)[..., :2] / (point - eye)[..., 2:] * FOCAL + [WIDTH / 2, HEIGHT / 2]


def trace(eye):
    """(depth, normal, ids, hit distance, reflected point); a post without a reflection stands before a part of the wall."""
    ray = np.concatenate([(CENTRES - [WIDTH / 2, HEIGHT / 2]) / FOCAL, np.ones((HEIGHT, WIDTH, 1))], -1)
    down = np.maximum(ray[..., 1], 1e-9)
    to_floor = (FLOOR_Y - eye[1]) / down
    floor = to_floor < WALL_Z - eye[2]
    depth = np.where(floor, to_floor, WALL_Z - eye[2])
    point = eye + depth[..., None] * ray
    bounced = ray - 2 * (ray @ UP)[..., None] * UP
    seen = point + (WALL_Z - point[..., 2])[..., None] * bounced  # z of a ray is 1
    hit = np.where(floor, np.linalg.norm(seen - point, axis=-1), 0.0)
    ids = np.where(floor, FLOOR, WALL)
    post = (ids == WALL) & (CENTRES[..., 0] > 18) & (CENTRES[..., 0] < 23)
    normal = np.where(floor[..., None], UP, [0.0, 0.0, -1.0])
    return np.where(post, POST_Z, depth), normal, np.where(post, POST, ids), hit, seen


@pytest.mark.parametrize(
    "moved",
    [{}, {WALL: (0.2, 0.15, -0.1)}, {FLOOR: (0.0, 0.1, 0.0)}, {FLOOR: (0.3, -0.1, 0.1), WALL: (-0.1, 0.1, 0.2)}],
    ids=["still", "thing", "mirror", "both"],
)
def test_the_picture_of_what_moves_moves_as_its_mirror_image(moved):
    depth, normal, ids, hit, seen = trace(EYES[1])
    moves = {
        **moved,
        POST: (3.0, 0.0, 0.0),
    }  # which the mirror doesn't show, though its pixels are where the wall would be
    cameras = Cameras("", {0: lens(EYES[0], {}), 1: lens(EYES[1], moves)}, None)
    got = sj.trace_reflections(cameras, depth, normal, ids, hit, number=1, previous=0).reflected_motion
    at = project(seen, EYES[1])
    shown = (ids == FLOOR) & (at > 0.5).all(-1) & (at < [WIDTH - 0.5, HEIGHT - 0.5]).all(-1)
    shown &= (at[..., 0] < 17.5) | (at[..., 0] > 23.5)
    hidden = (ids == FLOOR) & ((at < 0).any(-1) | (at > [WIDTH, HEIGHT]).any(-1) | (abs(at[..., 0] - 20.5) < 2))
    mirror = FLOOR_Y + np.array(moved.get(FLOOR, (0, 0, 0)))[1]
    for where, of_wall in ((shown, moved.get(WALL, (0, 0, 0))), (hidden, (0, 0, 0))):
        assert where.sum() > 15
        image = (seen + of_wall) * [1, -1, 1] + [0, 2 * mirror, 0]
        wanted = project(image, EYES[0]) - CENTRES
        np.testing.assert_allclose(got[where], wanted[where], atol=1e-4)
