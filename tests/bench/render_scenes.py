"""Render moving scenes at one sample a pixel, with references: sequences that no preset of this library was chosen on.

    pip install mitsuba            (3.9 was used; the variant llvm_ad_rgb needs an LLVM shared library)
    python tests/bench/render_scenes.py FOLDER [spheres] [stairs] [--frames 12] [--spp 256] [--size 480x270]

`spheres`: glossless spheres that move over a checkered floor under a small light: sharp shadows that move.
`stairs`: a camera climbs along still stairs lit by a small lamp and a window: nothing moves but the camera.

A frame is native: direct, indirect, emission, albedo, normal, depth, motion, id. Rays go through pixel centres, so the guides are
free of noise. direct = emitted light and one bounce by next event estimation and BSDF sampling, indirect = two bounces more.
"""

import argparse
import json
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from svgf_jax import exr

WAVE = 16  # samples a pixel traced at a time


def diffuse(*rgb):
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(rgb)}}


def checker(one, other, scale):
    colors = {f"color{i}": {"type": "rgb", "value": list(c)} for i, c in enumerate((one, other))}
    to_uv = mi.ScalarTransform4f().scale([scale, scale, 1])
    return {"type": "diffuse", "reflectance": {"type": "checkerboard", "to_uv": to_uv, **colors}}


def lamp(*rgb):
    return {"type": "area", "radiance": {"type": "rgb", "value": list(rgb)}}


def rectangle(centre, towards, size, up=(0, 0, 1), **content):
    frame = mi.ScalarTransform4f().look_at(origin=list(centre), target=list(towards), up=list(up))
    return {"type": "rectangle", "to_world": frame @ mi.ScalarTransform4f().scale([*size, 1]), **content}


def box(centre, size, bsdf):
    place = mi.ScalarTransform4f().translate(list(centre)) @ mi.ScalarTransform4f().scale(list(size))
    return {"type": "cube", "to_world": place, "bsdf": bsdf}


def spheres(t):
    """(shapes, moving shapes -> their place, eye, target); y is up."""
    floor = rectangle((0, 0, 0), (0, 1, 0), (8, 8), bsdf=checker((0.75, 0.7, 0.6), (0.25, 0.3, 0.35), 16))
    wall = rectangle((0, 4, -4), (0, 4, 0), (8, 4), up=(0, 1, 0), bsdf=diffuse(0.6, 0.6, 0.65))
    light = rectangle((2.5, 5.5, 2.5), (0, 0, -0.5), (0.25, 0.25), up=(0, 1, 0), emitter=lamp(120, 110, 95))
    sky = rectangle((-6, 5, 3), (0, 1, 0), (1.5, 1.5), up=(0, 1, 0), emitter=lamp(1.2, 1.6, 2.4))
    shapes, places = {"floor": floor, "wall": wall, "light": light, "sky": sky}, {}
    colors = [(0.8, 0.25, 0.2), (0.25, 0.65, 0.3), (0.2, 0.35, 0.8), (0.85, 0.75, 0.3)]
    for i, color in enumerate(colors):
        angle = 2 * np.pi * i / 4 + 0.11 * t * (1 if i % 2 else -0.7)
        place = np.array([1.7 * np.cos(angle), 0.55 + 0.35 * abs(np.sin(0.3 * t + i)), 1.7 * np.sin(angle) - 0.6])
        shapes[f"sphere{i}"] = {
            "type": "sphere",
            "to_world": mi.ScalarTransform4f().translate(place.tolist()) @ mi.ScalarTransform4f().scale(0.5),
            "bsdf": diffuse(*color),
        }
        places[f"sphere{i}"] = place
    return shapes, places, (0.04 * t, 2.6, 5.2), (0, 0.7, -0.5)


def stairs(t):
    """As `spheres`."""
    stone, plaster = checker((0.6, 0.55, 0.5), (0.42, 0.4, 0.38), 6), diffuse(0.7, 0.68, 0.62)
    shapes = {f"step{i}": box((0, 0.15 * i - 0.5, -0.45 * i), (1.6, 0.65, 0.225), stone) for i in range(10)}
    shapes |= {
        f"post{i}": box((1.35, 0.15 * i + 0.65, -0.45 * i), (0.04, 0.5, 0.04), diffuse(0.3, 0.2, 0.15))
        for i in range(10)
    }
    shapes["left"] = rectangle((-1.6, 2, -2), (0, 2, -2), (5, 4), up=(0, 1, 0), bsdf=plaster)
    shapes["right"] = rectangle((1.6, 2, -2), (0, 2, -2), (5, 4), up=(0, 1, 0), bsdf=diffuse(0.65, 0.4, 0.3))
    shapes["back"] = rectangle((0, 2, -5), (0, 2, 0), (1.7, 4), up=(0, 1, 0), bsdf=plaster)
    shapes["floor"] = rectangle((0, 0, 2), (0, 1, 2), (1.7, 3), bsdf=stone)
    shapes["roof"] = rectangle((0, 4.5, -1), (0, 0, -1), (1.7, 5), bsdf=plaster)
    shapes["lamp"] = {"type": "sphere", "center": [0.9, 3.4, -1.2], "radius": 0.12, "emitter": lamp(45, 36, 24)}
    shapes["window"] = rectangle((-1.58, 2.6, -0.5), (0, 2, -1), (0.5, 0.7), up=(0, 1, 0), emitter=lamp(4, 5, 7))
    return shapes, {}, (0.1 * np.sin(0.2 * t), 1.6 + 0.03 * t, 3.4 - 0.09 * t), (0.1, 1.5, -2.5)


SCENES = {"spheres": spheres, "stairs": stairs}
FOCAL = 1.2  # of the half width


def cameras(eye, target, width, height):
    """(world to camera, camera to screen): x right, y down, z forward; pixel = (X / W, Y / W), centres at + 0.5."""
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, [0, 1, 0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = rotation, -rotation @ eye
    f = FOCAL * width / 2
    return world_to_camera, np.array([[f, 0, width / 2, 0], [0, f, height / 2, 0], [0, 0, 1, 0], [0, 0, 1, 0]])


def primary_rays(eye, world_to_camera, width, height, spp):
    y, x = np.mgrid[:height, :width] + 0.5
    f = FOCAL * width / 2
    d = (
        np.stack([(x - width / 2) / f, (y - height / 2) / f, np.ones_like(x)], -1).reshape(-1, 3)
        @ world_to_camera[:3, :3]
    )
    d = np.repeat(d / np.linalg.norm(d, axis=1, keepdims=True), spp, axis=0).astype(np.float32)
    return mi.RayDifferential3f(mi.Point3f(*map(float, eye)), mi.Vector3f(np.ascontiguousarray(d.T)))


def radiance(scene, rays, seed, width, height, spp):
    """(direct, indirect) `[H, W, 3]`: paths of growing length that draw the same numbers, and their differences."""
    sums = []
    for depth in (1, 2, 4):
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, width * height * spp)
        path = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 100})
        color = np.array(path.sample(scene, sampler, rays)[0]).T.reshape(height, width, spp, 3)
        sums.append(np.nan_to_num(color).mean(axis=2))
    emission, direct, full = sums
    return np.maximum(direct - emission, 0), np.maximum(full - direct, 0)


def guides(scene, rays, names, places, before, now, then, width, height):
    """All but radiance, as native channels."""
    si = scene.ray_intersect(rays)
    hit = np.array(si.is_valid()).reshape(height, width)
    grid = lambda v, c: np.array(v).T.reshape(height, width, c) * hit[..., None]  # noqa: E731
    albedo, emission = si.bsdf().eval_diffuse_reflectance(si), si.emitter(scene).eval(si)
    point = np.array(si.p).T.reshape(height, width, 3).astype(np.float64)
    ids = np.full((height, width), -1.0, np.float32)
    seen = np.array(dr.reinterpret_array(mi.UInt32, si.shape)).reshape(height, width)
    for shape in scene.shapes():
        ids[seen == np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)))[0]] = names.index(shape.id())
    ids[~hit] = -1
    normal = grid(si.sh_frame.n, 3)
    normal *= np.where((normal * (eye_of(now) - point)).sum(-1, keepdims=True) < 0, -1, 1)  # towards the camera
    point_then = point.copy()
    for name in places:
        mine = ids == names.index(name)
        point_then[mine] += before[name] - places[name]
    y, x = np.mgrid[:height, :width] + 0.5
    motion = np.where(hit[..., None], screen(point_then, *then) - np.stack([x, y], -1), 0)
    depth = np.where(hit, (point @ now[0][:3, :3].T + now[0][:3, 3])[..., 2], 0)
    channels = {f"albedo.{c}": v for c, v in zip("RGB", np.moveaxis(grid(albedo, 3), -1, 0), strict=True)}
    channels |= {f"emission.{c}": v for c, v in zip("RGB", np.moveaxis(grid(emission, 3), -1, 0), strict=True)}
    channels |= {f"normal.{c}": v for c, v in zip("XYZ", np.moveaxis(normal, -1, 0), strict=True)}
    channels |= {"depth.Z": depth, "motion.X": motion[..., 0], "motion.Y": motion[..., 1], "id.I": ids}
    return channels


def screen(point, world_to_camera, camera_to_screen):
    q = (point @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]) @ camera_to_screen[:3, :3].T
    return q[..., :2] / q[..., 2:]


def eye_of(camera):
    return -camera[0][:3, :3].T @ camera[0][:3, 3]


def rgb(layer, image):
    return {f"{layer}.{c}": v for c, v in zip("RGB", np.moveaxis(image, -1, 0), strict=True)}


def write(path, channels, **attributes):
    exr.write(
        path,
        exr.new_image({k: np.ascontiguousarray(v, np.float32) for k, v in channels.items()}, attributes=attributes),
    )


def render(name, folder, frames, spp, width, height):
    folder.mkdir(parents=True, exist_ok=True)
    made = [SCENES[name](t) for t in range(frames)]
    lenses = [cameras(eye, target, width, height) for _, _, eye, target in made]
    entries = []
    for t, (shapes, places, eye, _) in enumerate(made):
        scene = mi.load_dict({"type": "scene", **shapes}, optimize=False)
        names = list(shapes)
        before, then = made[max(t - 1, 0)][1], lenses[max(t - 1, 0)]
        one = primary_rays(eye, lenses[t][0], width, height, 1)
        noisy = radiance(scene, one, 2 * t, width, height, 1)
        layers = guides(scene, one, names, places, before, lenses[t], then, width, height)
        write(folder / f"frame_{t:04d}.exr", rgb("direct", noisy[0]) | rgb("indirect", noisy[1]) | layers)
        many = primary_rays(eye, lenses[t][0], width, height, WAVE)
        parts = [radiance(scene, many, 1000 + 64 * t + k, width, height, WAVE) for k in range(spp // WAVE)]
        direct, indirect = np.mean(parts, axis=0)
        shown = {k: v for k, v in layers.items() if k.startswith("emission")}
        write(folder / f"ref_{t:04d}.exr", rgb("direct", direct) | rgb("indirect", indirect) | shown, spp=spp)
        moved = {}
        for key, place in places.items():
            matrix = np.eye(4)
            matrix[:3, 3] = before[key] - place
            moved[str(names.index(key))] = matrix.tolist()
        matrices = {"world_to_camera": lenses[t][0].tolist(), "camera_to_screen": lenses[t][1].tolist()}
        entries.append({"frame": t, **matrices, "object_motion": moved})
        print(name, t, flush=True)
    (folder / "cameras.json").write_text(json.dumps({"width": width, "height": height, "per_frame": entries}))


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--spp", type=int, default=256)
    parser.add_argument("--size", default="480x270")
    given = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    for name in given.scenes:
        render(name, given.folder / name, given.frames, given.spp, *map(int, given.size.split("x")))


if __name__ == "__main__":
    main()
