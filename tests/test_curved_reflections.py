"""Reflections in a ball and in a bowl, traced by hand: where the motion leads, the frame before shows the same reflected point."""

import numpy as np
import pytest

import svgf_jax as sj
from svgf_jax.cameras import Camera, Cameras

HEIGHT, WIDTH, FOCAL = 24, 32, 36.0
EYES = (np.array([0.0, 0.0, 0.0]), np.array([0.1, -0.03, 0.02]))
CENTRE, RADIUS, ROOM = np.array([0.2, 0.1, 4.0]), 1.2, 7.0  # of the ball; the room is a ball around the origin
CENTRES = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1)


def lens(eye):
    to_camera = np.eye(4)
    to_camera[:3, 3] = -eye
    to_screen = np.array([[FOCAL, 0, WIDTH / 2, 0], [0, FOCAL, HEIGHT / 2, 0], [0, 0, 1, 0], [0, 0, 1, 0]])
    return Camera(to_camera, to_screen, {}, {})


def trace(eye, pixel, *, hollow):
    """(whether the ball is hit, the point on it, its normal, hit distance, reflected point) through pixel positions."""
    ray = np.concatenate([(pixel - [WIDTH / 2, HEIGHT / 2]) / FOCAL, np.ones((*pixel.shape[:-1], 1))], -1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    middle = ((CENTRE - eye) * ray).sum(-1)
    beside = (CENTRE - eye) @ (CENTRE - eye) - middle**2
    half = np.sqrt(np.maximum(RADIUS**2 - beside, 0))
    point = eye + (middle + half if hollow else middle - half)[..., None] * ray
    normal = (point - CENTRE) / RADIUS * (-1 if hollow else 1)
    bounced = ray - 2 * (ray * normal).sum(-1, keepdims=True) * normal
    along = (point * bounced).sum(-1)
    reach = -along + np.sqrt(along**2 + ROOM**2 - (point**2).sum(-1))
    slant = -(ray * normal).sum(-1)
    return (beside < RADIUS**2) & (slant > 0.5), point, normal, reach, point + reach[..., None] * bounced


@pytest.mark.parametrize("hollow", [False, True], ids=["ball", "bowl"])
def test_a_curved_mirror_moves_its_picture_as_its_curvature_says(hollow):
    cameras = Cameras("", {t: lens(eye) for t, eye in enumerate(EYES)}, None)
    hit, point, normal, reach, seen = trace(EYES[1], CENTRES, hollow=hollow)
    ids, depth = np.where(hit, 1, -1), np.where(hit, point[..., 2] - EYES[1][2], 1.0)

    def apart(normals):
        """How far apart, as seen in the mirror: the reflected point now, and where the motion leads."""
        got = sj.trace_reflections(cameras, depth, normals, ids, reach, number=1, previous=0)
        then = trace(EYES[0], CENTRES + np.nan_to_num(got.reflected_motion), hollow=hollow)[4]
        one_pixel = np.linalg.norm(np.gradient(seen, axis=1), axis=-1)
        return (np.linalg.norm(then - seen, axis=-1) / one_pixel)[hit]

    facing = np.broadcast_to([0.0, 0.0, -1.0], normal.shape)
    pixels = apart(normal)
    assert pixels.size > 200
    assert np.median(pixels) < 0.01
    assert np.percentile(pixels, 90) < 0.05
    assert np.median(apart(facing)) > 0.5  # as if it were flat


def test_a_facet_is_flat_up_to_its_edge_and_a_pixel_alone_is_flat():
    """Normals that jump from facet to facet, or to another object, bend nothing: of two neighbours the nearer normal counts."""
    cameras = Cameras("", {t: lens(eye) for t, eye in enumerate(EYES)}, None)
    ids = np.zeros((HEIGHT, WIDTH), np.int32)
    ids[3, 4], ids[7:] = 5, 2
    depth, reach = np.full(ids.shape, 3.0), np.full(ids.shape, 2.0)
    flat = np.broadcast_to([0.0, 0.0, -1.0], (*ids.shape, 3)).copy()
    facets = flat.copy()
    facets[:, WIDTH // 2 :] = 0.6, 0.0, -0.8
    facets[7:] = 0.0, 0.6, -0.8
    facets[3, 4] = 0.0, -0.8, -0.6
    facets[11, 5] = np.nan
    one, other = (
        sj.trace_reflections(cameras, depth, n, ids, reach, number=1, previous=0).reflected_motion
        for n in (flat, facets)
    )
    known = np.isfinite(facets).all(-1)
    np.testing.assert_allclose(other[known], one[known], atol=1e-5)


def test_samples_jittered_within_their_pixels_move_as_they_would_unjittered():
    jitter = np.random.default_rng(3).uniform(-0.4, 0.4, CENTRES.shape)
    cameras = Cameras("", {t: lens(eye) for t, eye in enumerate(EYES)}, None)
    ids, found = np.zeros((HEIGHT, WIDTH), np.int32), []
    for at in (CENTRES, CENTRES + jitter):  # on a flat mirror all around the room: the motion is smooth
        ray = np.concatenate([(at - [WIDTH / 2, HEIGHT / 2]) / FOCAL, np.ones((*ids.shape, 1))], -1)
        point = (EYES[1] + 3.0 * ray).astype(np.float32)
        normal = np.broadcast_to([0.0, 0.0, -1.0], point.shape)
        where = {"number": 1, "previous": 0, "position": point}
        depth, reach = np.full(ids.shape, 3.0), np.full(ids.shape, 2.0)
        found.append(sj.trace_reflections(cameras, depth, normal, ids, reach, **where).reflected_motion)
    assert np.abs(found[1] - found[0]).max() < 0.02  # pixels; the jitter itself is 0.4


def test_in_the_focus_of_a_hollow_mirror_there_is_no_previous_pixel():
    """The eye in the middle of a bowl sees itself everywhere; `reproject_reflections` then takes the surface's history."""
    eyes = (np.array([0.0, 0.0, 0.0]), np.array([0.01, 0.0, 0.0]))
    cameras = Cameras("", {t: lens(eye) for t, eye in enumerate(eyes)}, None)
    depth = np.full((HEIGHT, WIDTH), 4.0)
    point = np.concatenate([(CENTRES - [WIDTH / 2, HEIGHT / 2]) / FOCAL * 4.0, depth[..., None]], -1) + eyes[1]
    to_eye = eyes[1] - point
    reach = np.linalg.norm(to_eye, axis=-1)
    ids = np.zeros(depth.shape, np.int32)
    got = sj.trace_reflections(cameras, depth, to_eye / reach[..., None], ids, reach, number=1, previous=0)
    assert (got.reflected_motion < -1e3).all()
