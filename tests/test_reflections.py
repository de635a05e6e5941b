"""Reflections move as their virtual point does: a flat mirror traced by hand, in the pipeline, and out of files."""

import json

import bridge
import jax
import numpy as np
import pytest
import scenes

import svgf_jax as sj
from svgf_jax import exr
from svgf_jax.accumulation import accumulate
from svgf_jax.cameras import Camera, Cameras
from svgf_jax.frames import open_source, read_frame
from svgf_jax.types import Config, Reprojected

HEIGHT, WIDTH = 20, 26
FOCAL = 30.0
TILT = np.array([0.0, -0.8, -0.6])  # the mirror's normal, towards the camera (y points down)
POINT = np.array([0.0, 1.0, 4.0])  # on the mirror
WALL = 3.0  # the reflected wall is the plane y = -WALL, above the camera
EYES = (np.array([0.0, 0.0, 0.0]), np.array([0.7, -0.1, 0.2]))


def lens(eye):
    to_camera = np.eye(4)
    to_camera[:3, 3] = -eye
    to_screen = np.array([[FOCAL, 0, WIDTH / 2, 0], [0, FOCAL, HEIGHT / 2, 0], [0, 0, 1, 0], [0, 0, 1, 0]])
    return Camera(to_camera, to_screen, {}, {})


CAMERAS = Cameras("", {t: lens(eye) for t, eye in enumerate(EYES)}, None)


def project(point, eye):
    return (point - eye)[..., :2] / (point - eye)[..., 2:] * FOCAL + [WIDTH / 2, HEIGHT / 2]


def trace(eye, pixel=None):
    """(point on the mirror, hit distance, reflected point) through pixel positions `[..., 2]`."""
    if pixel is None:
        pixel = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1)
    ray = np.concatenate([(pixel - [WIDTH / 2, HEIGHT / 2]) / FOCAL, np.ones((*pixel.shape[:-1], 1))], -1)
    mirror = eye + ray * ((POINT - eye) @ TILT / (ray @ TILT))[..., None]
    bounced = ray - 2 * (ray @ TILT)[..., None] * TILT
    reach = (-WALL - mirror[..., 1]) / bounced[..., 1]
    assert (reach > 0).all()
    return mirror, reach * np.linalg.norm(bounced, axis=-1), mirror + reach[..., None] * bounced


def picture(wall):
    """What is painted on the wall, with a structure of a few pixels."""
    return 1.0 + 0.9 * np.stack([np.sin(3 * wall[..., 0]), np.cos(3 * wall[..., 2]), np.sin(3 * wall[..., 0] + 1)], -1)


def guides(eye):
    mirror, hit, wall = trace(eye)
    return mirror[..., 2] - eye[2], np.broadcast_to(TILT, mirror.shape), np.zeros(hit.shape, np.int32), hit, wall


def test_a_flat_mirror_moves_its_picture_as_the_mirror_image_of_the_thing_moves():
    depth, normal, ids, hit, wall = guides(EYES[1])
    got = sj.trace_reflections(CAMERAS, depth, normal, ids, hit, number=1, previous=0)
    image = wall - 2 * ((wall - POINT) @ TILT)[..., None] * TILT  # behind the mirror
    wanted = project(image, EYES[0])
    centres = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1)
    np.testing.assert_allclose(got.reflected_motion, wanted - centres, atol=2e-5)
    then, _, same = trace(EYES[0], wanted)
    np.testing.assert_allclose(same, wall, atol=1e-9)  # the first camera does see it there
    np.testing.assert_allclose(got.reflected_prev_depth, then[..., 2] - EYES[0][2], rtol=1e-6)
    assert (got.longest_history == 1e6).all()
    on_mirror, _ = sj_motion(depth, ids)
    assert np.hypot(*np.moveaxis(on_mirror - got.reflected_motion, -1, 0)).max() > 1.5  # pixels: it does matter


def sj_motion(depth, ids):
    from svgf_jax.cameras import reproject

    prev_depth, motion = reproject(CAMERAS, depth, ids, number=1, previous=0)
    return motion, prev_depth


def test_roughness_brings_the_picture_to_the_surface_and_shortens_its_history():
    depth, normal, ids, hit, _ = guides(EYES[1])
    ids = ids.copy()
    ids[0] = -1
    hit = hit.copy()
    hit[1] = np.nan
    found = [
        sj.trace_reflections(CAMERAS, depth, normal, ids, hit, roughness=r, number=1, previous=0)
        for r in (0, 0.3, 0.6, 1)
    ]
    assert all(np.isnan(f.reflected_motion[:2]).all() and np.isfinite(f.reflected_motion[2:]).all() for f in found)
    motion, prev_depth = sj_motion(depth, ids)
    np.testing.assert_allclose(found[3].reflected_motion[2:], motion[2:], atol=1e-4)  # matt
    np.testing.assert_allclose(found[3].reflected_prev_depth[2:], prev_depth[2:], rtol=1e-5)
    away = [np.linalg.norm(f.reflected_motion[2:] - motion[2:], axis=-1).mean() for f in found]
    assert away == sorted(away, reverse=True)
    lengths = [np.median(f.longest_history[2:]) for f in found]
    assert min(lengths[0], lengths[3]) > 1e3
    assert 1 < max(lengths[1:3]) < 32
    still = sj.trace_reflections(Cameras("", dict.fromkeys((0, 1), lens(EYES[1])), None), depth, normal, ids, hit, roughness=0.5,
                                 number=1, previous=0)  # fmt: skip
    assert (still.longest_history[2:] > 1e3).all()  # no parallax, no drift


def frames_of_a_mirror(reflected=True):
    """The two frames, noise-free: a matt signal of 1, and the mirror's."""
    out = []
    for t, eye in enumerate(EYES):
        depth, normal, ids, hit, wall = guides(eye)
        found = sj.trace_reflections(CAMERAS, depth, normal, ids, hit, number=t, previous=0)
        motion, prev_depth = sj_motion(depth, ids) if t else (np.zeros((HEIGHT, WIDTH, 2)), depth)
        fields = {name: np.stack([np.full_like(a, np.nan if "motion" in name else 1e6), a])
                  for name, a in found._asdict().items()}  # fmt: skip
        if not reflected:
            fields["reflected_motion"] = np.full_like(fields["reflected_motion"], np.nan)
        light = np.stack([np.ones((HEIGHT, WIDTH, 3)), picture(wall)])
        out.append({**scenes.flat(HEIGHT, WIDTH, signals=2), "radiance": light, "normal": normal, "depth": depth,
                    "prev_depth": prev_depth, "motion": motion, "object_id": ids, **fields})  # fmt: skip
    return [bridge.to_frame(f, np.float32) for f in out]


def test_the_history_of_a_reflection_is_where_it_was():
    step, errors = bridge.jitted_step(Config(levels=0, variance="temporal")), {}
    for reflected in (True, False):
        frames = frames_of_a_mirror(reflected)
        history = sj.init(frames[0])
        for frame in frames:
            history, output = step(history, frame, params=sj.Params())
        errors[reflected] = np.abs(np.asarray(output.illumination) - frames[1].radiance)[:, 3:-3, 3:-3]
        np.testing.assert_allclose(output.illumination[0], 1.0, rtol=1e-5)  # the matt signal keeps to its surface
    assert errors[False][1].mean() > 0.2
    assert np.median(errors[True][1]) < 0.03  # what two bilinear pixels make of a sine


def test_a_history_not_worth_keeping_is_kept_shorter():
    """max(alpha, 1 / min(h, longest)) of this frame, per signal; the moments too."""
    rng = np.random.default_rng(0)
    shape = (3, HEIGHT, WIDTH)
    longest = np.stack([np.full(shape[1:], n) for n in (1e6, 2.0, 1.0)])
    frame = bridge.to_frame({**scenes.flat(*shape[1:], signals=3), "longest_history": longest})
    light, old, moments = rng.gamma(1.0, 1.0, (*shape, 3)), rng.gamma(1.0, 1.0, (*shape, 3)), rng.random((*shape, 2))
    valid = rng.random(shape[1:]) < 0.9
    previous = Reprojected(old, moments, np.full(shape[1:], 9.0), valid)
    got = jax.jit(lambda *a: accumulate(*a, params=sj.Params()))(light, previous, frame)
    luma = light @ [0.2126, 0.7152, 0.0722]
    for s, most in enumerate((0.2, 0.5, 1.0)):
        weight = np.where(valid, most, 1.0)
        blended = (1 - weight[..., None]) * old[s] + weight[..., None] * light[s]
        np.testing.assert_allclose(got.illumination[s], blended, rtol=1e-6, atol=1e-9)
        for which, new in enumerate((luma[s], luma[s] ** 2)):
            wanted = (1 - weight) * moments[s, ..., which] + weight * new
            np.testing.assert_allclose(got.moments[s, ..., which], wanted, rtol=1e-6, atol=1e-9)


def test_a_reflection_that_is_nowhere_moves_with_its_surface():
    depths = np.full((2, HEIGHT, WIDTH), 2.0)
    depths[1, 0, :3] = np.nan, np.inf, 1e30
    fields = {
        "reflected_motion": np.zeros((*depths.shape, 2)),
        "reflected_prev_depth": depths,
        "longest_history": depths,
    }
    frame = bridge.to_frame({**scenes.flat(HEIGHT, WIDTH, signals=2), **fields}, np.float32)
    clean, _ = jax.jit(sj.sanitise)(frame)
    np.testing.assert_array_equal(clean.reflected_prev_depth == 0, depths != 2)
    np.testing.assert_array_equal(
        clean.reflected_motion != 0, np.broadcast_to(depths[..., None] != 2, (*depths.shape, 2))
    )


def test_files_with_hit_distances_give_frames_their_reflections(tmp_path):
    for t, eye in enumerate(EYES):
        depth, normal, ids, hit, wall = guides(eye)
        planes = {"depth.Z": depth, "id.I": ids, "hit_distance.Z": hit, "roughness.Y": np.full_like(hit, 0.2)}
        planes |= {f"normal.{c}": normal[..., i] for i, c in enumerate("XYZ")}
        planes |= {
            f"{role}.{c}": picture(wall)[..., i]
            for role in ("diffuse_direct", "diffuse_albedo", "specular_direct")
            for i, c in enumerate("RGB")
        }
        planes = {name: np.ascontiguousarray(p, np.float32) for name, p in planes.items()}
        exr.write(tmp_path / f"f.{t:04d}.exr", exr.new_image(planes))
    entries = [{"frame": t, "world_to_camera": lens(e).world_to_camera.tolist(),
                "camera_to_screen": lens(e).camera_to_screen.tolist()} for t, e in enumerate(EYES)]  # fmt: skip
    (tmp_path / "cameras.json").write_text(json.dumps({"width": WIDTH, "height": HEIGHT, "per_frame": entries}))
    source = open_source(tmp_path, renderer="arnold")
    assert source.roles.signals == ("diffuse_direct", "specular_direct")
    first, second = (read_frame(source, i).frame for i in (0, 1))
    wanted = sj.trace_reflections(
        CAMERAS, second.depth, second.normal, second.object_id, hit, roughness=0.2, number=1, previous=0
    )
    np.testing.assert_allclose(second.reflected_motion[1], wanted.reflected_motion, atol=1e-3)
    np.testing.assert_allclose(second.longest_history[1], wanted.longest_history, rtol=1e-3)
    assert np.isnan(second.reflected_motion[0]).all()
    assert np.isnan(first.reflected_motion).all()
    assert (second.albedo[1] == 1).all()
    assert (second.albedo[0] != 1).any()
    assert read_frame(open_source(tmp_path, renderer="arnold", cameras=None), 1).frame.reflected_motion is None


def test_some_but_not_all_of_the_reflections_fields_are_an_error():
    frame = frames_of_a_mirror()[0]
    with pytest.raises(sj.SvgfError, match="of reflections there is"):
        sj.init(frame._replace(longest_history=None))


def test_the_variance_of_a_signal_whose_history_is_not_worth_keeping_is_that_of_its_surroundings():
    """As if the history were that short; the moments of one frame have no variance of their own."""
    rng = np.random.default_rng(1)
    longest = np.stack([np.full((HEIGHT, WIDTH), n) for n in (1e6, 2.0)])
    moments, length = rng.random((2, HEIGHT, WIDTH, 2)), np.full((HEIGHT, WIDTH), 9.0)
    frame = bridge.to_frame(scenes.flat(HEIGHT, WIDTH, signals=2))
    without = frame._replace(longest_history=np.full_like(longest, 1e6))  # one program for both
    for variance in ("svgf", "temporal"):
        config = Config(variance=variance)
        estimate = jax.jit(lambda *a, config=config: sj.estimate_variance(*a, params=sj.Params(), config=config))
        for most in (longest, longest / 2):
            got = estimate(moments, length, frame._replace(longest_history=most))
            for s in (0, 1):
                wanted = estimate(moments, np.minimum(length, most[s]), without)[s]
                np.testing.assert_allclose(got[s], wanted, rtol=1e-12)
