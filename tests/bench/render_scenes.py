"""Render moving scenes at one sample a pixel, with references: sequences that no preset of this library was chosen on.

    pip install mitsuba            (3.9 was used; the variant llvm_ad_rgb needs an LLVM shared library)
    python tests/bench/render_scenes.py FOLDER [spheres] [stairs] [mirror] [--frames 12] [--spp 256] [--size 480x270]

`spheres`: glossless spheres that move over a checkered floor under a small light: sharp shadows that move.
`stairs`: a camera climbs along still stairs lit by a small lamp and a window: nothing moves but the camera.
`mirror`: a camera moves through a room whose floor is a mirror, a lacquered pattern and a rough metal; a golden ball and a glazed
one stand still, a matt ball and a box move.

A frame is native: direct, indirect, emission, albedo, normal, depth, motion, id. Rays go through pixel centres, so the guides are
free of noise. direct = emitted light and one bounce by next event estimation and BSDF sampling, indirect = two bounces more.

`mirror` has instead diffuse_direct, diffuse_indirect and specular (what glossy lobes show, up to four bounces), with `albedo`,
`specular_albedo`, `roughness` and `hit_distance`, as long as this sample's ray is; `table.toml` names them. `mirrored.toml` has as
albedo of specular light `mirrored_albedo`, which is times the albedo of what smooth surfaces mirror. The references of
`mirror` hold besides: `id`, and `reflected.id`, of what a perfect mirror would show there (-1 on matt surfaces); their attribute
`shapes` names the ids from 0 on.
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


def metal(*rgb, roughness=0.0):
    kind = {"type": "roughconductor", "alpha": roughness**2} if roughness else {"type": "conductor"}
    return {**kind, "material": "none", "specular_reflectance": {"type": "rgb", "value": list(rgb)}}


def coated(below, roughness=0.0):
    kind = {"type": "roughplastic", "alpha": roughness**2} if roughness else {"type": "plastic"}
    return {**kind, "int_ior": COAT, "diffuse_reflectance": below}


def mirror(t):
    """As `spheres`; what reflects is listed in `GLOSS`."""
    tiles = checker((0.5, 0.25, 0.18), (0.12, 0.1, 0.1), 8)["reflectance"]
    shapes = {
        "mirror": rectangle((-1.7, 0, -1), (-1.7, 1, -1), (1.3, 3.5), bsdf=metal(*GLOSS["mirror"][1])),
        "lacquer": rectangle((0.1, 0, -1), (0.1, 1, -1), (0.5, 3.5), bsdf=coated(tiles)),
        "rough": rectangle((1.8, 0, -1), (1.8, 1, -1), (1.2, 3.5), bsdf=metal(*GLOSS["rough"][1], roughness=0.3)),
        "back": rectangle(
            (0, 2, -4.5), (0, 2, 0), (3, 2), up=(0, 1, 0), bsdf=checker((0.7, 0.66, 0.55), (0.2, 0.3, 0.45), 8)
        ),
        "left": rectangle(
            (-3, 2, -1), (0, 2, -1), (3.5, 2), up=(0, 1, 0), bsdf=checker((0.7, 0.3, 0.2), (0.6, 0.55, 0.5), 6)
        ),
        "right": rectangle((3, 2, -1), (0, 2, -1), (3.5, 2), up=(0, 1, 0), bsdf=diffuse(0.35, 0.6, 0.35)),
        "front": rectangle(
            (0, 2, 2.5), (0, 2, 0), (3, 2), up=(0, 1, 0), bsdf=checker((0.7, 0.7, 0.7), (0.3, 0.3, 0.3), 6)
        ),
        "roof": rectangle((0, 4, -1), (0, 0, -1), (3, 3.5), bsdf=diffuse(0.75, 0.73, 0.7)),
        "panel": rectangle((0.3, 3.98, -1.5), (0.3, 0, -1.5), (0.8, 0.8), emitter=lamp(13, 12.5, 11)),
        "lamp": rectangle((-2.98, 2.2, -2.5), (0, 2.2, -2.5), (0.25, 0.25), up=(0, 1, 0), emitter=lamp(14, 9, 5)),
    }
    for name, (x, z), radius, bsdf in (
        ("gold", (-0.8, -2.5), 0.6, metal(*GLOSS["gold"][1])),
        ("glazed", (1.1, -2.5), 0.5, coated({"type": "rgb", "value": [0.15, 0.25, 0.6]}, roughness=0.2)),
    ):
        place = mi.ScalarTransform4f().translate([x, radius, z]) @ mi.ScalarTransform4f().scale(radius)
        shapes[name] = {"type": "sphere", "to_world": place, "bsdf": bsdf}
    places = {
        "ball": np.array([-2.3 + 0.11 * t, 0.6 + 0.2 * np.cos(0.5 * t), -1.5]),
        "box": np.array([2.1 - 0.09 * t, 0.5, -1.4 + 0.03 * t]),
    }
    put = mi.ScalarTransform4f().translate
    shapes["ball"] = {
        "type": "sphere",
        "to_world": put(places["ball"].tolist()) @ mi.ScalarTransform4f().scale(0.35),
        "bsdf": checker((0.85, 0.75, 0.2), (0.3, 0.15, 0.5), 5),
    }
    shapes["box"] = box(places["box"], (0.3, 0.3, 0.3), diffuse(0.75, 0.2, 0.25))
    return shapes, places, (-0.5 + 0.06 * t, 1.5, 2.2 - 0.02 * t), (-0.2 + 0.02 * t, 0.6, -1.6)


SCENES = {"spheres": spheres, "stairs": stairs, "mirror": mirror}
COAT = 1.5  # index of refraction
GLOSS = {  # what reflects: roughness, and the color of metal (None: a coat)
    "mirror": (0.0, (0.85, 0.87, 0.9)),
    "lacquer": (0.0, None),
    "rough": (0.3, (0.75, 0.7, 0.65)),
    "gold": (0.0, (0.95, 0.72, 0.35)),
    "glazed": (0.2, None),
}
TABLE = """title = "render_scenes.py: mirror"
[[light]]
name = "diffuse_direct"
channels = ["diffuse_direct.RGB"]
albedo = ["albedo.RGB"]
[[light]]
name = "diffuse_indirect"
channels = ["diffuse_indirect.RGB"]
albedo = ["albedo.RGB"]
[[light]]
name = "specular"
channels = ["specular.RGB"]
albedo = ["specular_albedo.RGB"]
"""
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


def glossy_radiance(scene, rays, seed, width, height, spp):
    """(diffuse direct, diffuse indirect, specular) `[H, W, 3]`, and how long the specular ray is `[H, W]`."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, width * height * spp)
    si = scene.ray_intersect(rays)
    bsdf = si.bsdf()
    matt, shiny = mi.BSDFContext(), mi.BSDFContext()
    matt.type_mask = int(mi.BSDFFlags.DiffuseReflection)
    shiny.type_mask = int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.GlossyReflection)
    path = mi.load_dict({"type": "path", "max_depth": 4, "rr_depth": 100})
    mean = lambda v, c: np.nan_to_num(np.array(v).T.reshape(height, width, spp, c)).mean(axis=2)  # noqa: E731

    towards, light = scene.sample_emitter_direction(si, sampler.next_2d(), True)
    direct = bsdf.eval(matt, si, si.to_local(towards.d)) * light

    def bounce(context):
        sample, weight = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d())
        ray = mi.RayDifferential3f(si.spawn_ray(si.to_world(sample.wo)))
        seen = scene.ray_intersect(ray)
        active = dr.any(weight > 0)
        found = path.sample(scene, sampler, ray, active=active)[0]
        return dr.select(active, weight, 0), found, seen, active

    weight, found, seen, _ = bounce(matt)
    indirect = weight * (found - seen.emitter(scene).eval(seen))  # that was direct
    weight, found, seen, active = bounce(shiny)
    reach = dr.select(active, dr.select(seen.is_valid(), seen.t, dr.inf), 0)
    return (
        np.maximum(mean(direct, 3), 0),
        np.maximum(mean(indirect, 3), 0),
        mean(weight * found, 3),
        mean(reach, 1)[..., 0],
    )


def gloss(scene, rays, names, ids, width, height):
    """Albedo and roughness of what reflects, by id, and what a perfect mirror shows there."""
    si = scene.ray_intersect(rays)
    cosine = np.array(mi.Frame3f.cos_theta(si.wi)).reshape(height, width)
    coat = np.array(mi.fresnel(mi.Float(np.abs(cosine).ravel()), COAT)[0]).reshape(height, width, 1)
    seen = scene.ray_intersect(si.spawn_ray(si.to_world(mi.reflect(si.wi))))
    reflected = shape_ids(scene, seen, names, width, height)
    albedo, roughness, metals = np.zeros((height, width, 3)), np.zeros((height, width)), np.zeros((height, width), bool)
    for name, (rough, color) in GLOSS.items():
        mine = ids == names.index(name)
        albedo[mine] = np.broadcast_to(coat, albedo.shape)[mine] if color is None else color
        roughness[mine] = rough
        metals |= mine & (color is not None)
    matt = ~np.isin(ids, [names.index(name) for name in GLOSS])
    return albedo, np.where(matt, 1.0, roughness), metals, np.where(matt, -1.0, reflected)


def mirrored(scene, rays, names, ids, albedo, width, height):
    """The albedo of what reflects times that of what is seen in it, where it is smooth; 1 for what emits."""
    smooth = [name for name, (rough, _) in GLOSS.items() if not rough]
    alive = np.isin(ids, [names.index(name) for name in smooth])
    si, found, weight = scene.ray_intersect(rays), albedo.copy(), albedo.copy()
    for _ in range(3):
        si = scene.ray_intersect(si.spawn_ray(si.to_world(mi.reflect(si.wi))))
        seen = shape_ids(scene, si, names, width, height)
        shown = np.array(si.bsdf().eval_diffuse_reflectance(si)).T.reshape(height, width, 3)
        shown[np.isin(seen, [names.index("panel"), names.index("lamp")])] = 1
        again = np.zeros(ids.shape, bool)
        for name, (rough, color) in GLOSS.items():
            mine = seen == names.index(name)
            if color is not None:
                shown[mine] = color
                again |= mine & (not rough)
        found[alive] = (weight * shown)[alive]
        weight = np.where(again[..., None], weight * shown, weight)
        alive &= again
    return found


def shape_ids(scene, si, names, width, height):
    ids = np.full((height, width), -1.0, np.float32)
    seen = np.array(dr.reinterpret_array(mi.UInt32, si.shape)).reshape(height, width)
    for shape in scene.shapes():
        ids[seen == np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)))[0]] = names.index(shape.id())
    return ids


def guides(scene, rays, names, places, before, now, then, width, height):
    """All but radiance, as native channels."""
    si = scene.ray_intersect(rays)
    hit = np.array(si.is_valid()).reshape(height, width)
    grid = lambda v, c: np.array(v).T.reshape(height, width, c) * hit[..., None]  # noqa: E731
    albedo, emission = si.bsdf().eval_diffuse_reflectance(si), si.emitter(scene).eval(si)
    point = np.array(si.p).T.reshape(height, width, 3).astype(np.float64)
    ids = np.where(hit, shape_ids(scene, si, names, width, height), -1)
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


def draw_matt(folder, t, scene, names, one, many, layers, seeds, width, height):
    noisy = radiance(scene, one, 2 * t, width, height, 1)
    write(folder / f"frame_{t:04d}.exr", rgb("direct", noisy[0]) | rgb("indirect", noisy[1]) | layers)
    direct, indirect = np.mean([radiance(scene, many, seed, width, height, WAVE) for seed in seeds], axis=0)
    shown = {k: v for k, v in layers.items() if k.startswith("emission")}
    write(folder / f"ref_{t:04d}.exr", rgb("direct", direct) | rgb("indirect", indirect) | shown, spp=len(seeds) * WAVE)


def draw_glossy(folder, t, scene, names, one, many, layers, seeds, width, height):
    ids = layers["id.I"]
    albedo, roughness, metals, reflected = gloss(scene, one, names, ids, width, height)
    layers |= {k: np.where(metals, 0, v) for k, v in layers.items() if k.startswith("albedo")}
    *noisy, reach = glossy_radiance(scene, one, 2 * t, width, height, 1)
    kinds = ("diffuse_direct", "diffuse_indirect", "specular")
    light = {k: v for kind, image in zip(kinds, noisy, strict=True) for k, v in rgb(kind, image).items()}
    behind = mirrored(scene, one, names, ids, albedo, width, height)
    layers |= rgb("specular_albedo", albedo) | rgb("mirrored_albedo", behind)
    layers |= {"roughness.Y": roughness, "hit_distance.Z": reach}
    write(folder / f"frame_{t:04d}.exr", light | layers)
    clean = np.mean([np.sum(glossy_radiance(scene, many, s, width, height, WAVE)[:3], axis=0) for s in seeds], axis=0)
    clean += np.stack([layers[f"emission.{c}"] for c in "RGB"], -1)
    beauty = {c: clean[..., i] for i, c in enumerate("RGB")}
    told = {"spp": len(seeds) * WAVE, "shapes": " ".join(names)}
    write(folder / f"ref_{t:04d}.exr", beauty | {"id.I": ids, "reflected.id": reflected}, **told)
    (folder / "table.toml").write_text(TABLE)
    (folder / "mirrored.toml").write_text(TABLE.replace("specular_albedo", "mirrored_albedo"))


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
        layers = guides(scene, one, names, places, before, lenses[t], then, width, height)
        many = primary_rays(eye, lenses[t][0], width, height, WAVE)
        seeds = [1000 + 64 * t + k for k in range(spp // WAVE)]
        draw = draw_glossy if name == "mirror" else draw_matt
        draw(folder, t, scene, names, one, many, layers, seeds, width, height)
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
