"""Render a small moving scene with Mitsuba 3, as tests/data/mitsuba was.

    python render_mitsuba.py FOLDER [WIDTH HEIGHT FRAMES [SAMPLES]]

Wants the package `mitsuba` (3.9.1 was used) and LLVM. A floor with a pattern, a wall, a golden ball, a box that moves and turns,
a lamp and a bulb; the camera moves and turns. A cameras.json is written beside the frames.
"""

import json
import sys

import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")
T = mi.ScalarTransform4f

folder = sys.argv[1]
width, height, frames = (int(word) for word in sys.argv[2:5]) if len(sys.argv) > 4 else (48, 27, 3)
samples = int(sys.argv[5]) if len(sys.argv) > 5 else 1
step = 4 if frames <= 8 else 1


def box_pose(t):
    return T().translate([0.9 - 0.04 * t, 0.4, 0.3 + 0.02 * t]).rotate([0, 1, 0], 3 * t).scale(0.4)


def camera_pose(t):
    return T().look_at(
        origin=[0.4 + 0.03 * t, 1.6 - 0.01 * t, 4.5 - 0.02 * t],
        target=[0.1 - 0.02 * t, 0.6 + 0.005 * t, 0],
        up=[0, 1, 0],
    )


def scene(t):
    checker = {
        "type": "checkerboard",
        "color0": {"type": "rgb", "value": [0.75, 0.3, 0.2]},
        "color1": {"type": "rgb", "value": [0.8, 0.78, 0.7]},
        "to_uv": T().scale([8, 8, 1]),
    }
    return {
        "type": "scene",
        "integrator": {
            "type": "aov",
            "aovs": "albedo:albedo,nn:sh_normal,dd.y:depth,pos:position,shape:shape_index",
            "beauty": {"type": "path", "max_depth": 5},
            "emission": {"type": "path", "max_depth": 1},
        },
        "sensor": {
            "type": "perspective",
            "fov": 45,
            "to_world": camera_pose(t),
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent", "sample_count": samples},
        },
        "floor": {
            "type": "rectangle",
            "to_world": T().rotate([1, 0, 0], -90).scale(5),
            "bsdf": {"type": "diffuse", "reflectance": checker},
        },
        "wall": {
            "type": "rectangle",
            "to_world": T().translate([-1, 1, -2]).scale(2.2),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.3, 0.5, 0.75]}},
        },
        "ball": {
            "type": "sphere",
            "center": [-0.8, 0.6, 0],
            "radius": 0.6,
            "bsdf": {"type": "roughconductor", "material": "Au", "alpha": 0.3},
        },
        "box": {
            "type": "cube",
            "to_world": box_pose(t),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.6, 0.25]}},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": T().look_at(origin=[1.5, 3, 2], target=[0, 0, 0], up=[0, 0, 1]).scale(0.4),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 18}},
        },
        "bulb": {
            "type": "sphere",
            "center": [0.3, 1.7, -1],
            "radius": 0.12,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [10, 9, 6]}},
        },
    }


def matrix(transform):
    return np.array(transform.matrix, np.float64).reshape(4, 4)


def matrices(sensor):
    """world_to_camera (x right, y down, z forward) and camera_to_screen (pixels) of a perspective sensor."""
    film, params = sensor.film(), mi.traverse(sensor)
    flip = np.diag([-1.0, -1.0, 1.0, 1.0])  # Mitsuba's camera has x to the left and y up
    view = mi.perspective_projection(
        film.size(), film.crop_size(), film.crop_offset(), params["x_fov"], sensor.near_clip(), sensor.far_clip()
    )
    to_world, view = (np.array(one.matrix, np.float64).reshape(4, 4) for one in (params["to_world"], view))
    return flip @ np.linalg.inv(to_world), np.diag([*film.size(), 1.0, 1.0]) @ view @ flip


# One scene whose parameters change: loading it anew would number the shapes anew, and no object would have a history.
loaded, entries = mi.load_dict(scene(0)), []
params = mi.traverse(loaded)
box = next(shape for shape in loaded.shapes() if shape.id() == "box")
box_id = dr.reinterpret_array(mi.UInt32, mi.ShapePtr(box))[0]  # what shape_index says of it
start = {key: np.array(params[f"box.vertex_{key}"]).reshape(-1, 3) for key in ("positions", "normals")}
first = matrix(box_pose(0))
for number in range(frames):
    now, before = (matrix(box_pose(max(0, number - back) * step)) for back in (0, 1))
    moved = now @ np.linalg.inv(first)
    params["box.vertex_positions"] = (start["positions"] @ moved[:3, :3].T + moved[:3, 3]).astype(np.float32).ravel()
    params["box.vertex_normals"] = (start["normals"] @ moved[:3, :3].T).astype(np.float32).ravel()
    params["sensor.to_world"] = mi.Transform4f(camera_pose(number * step).matrix)
    params.update()
    mi.render(loaded, spp=samples, seed=number)
    sensor = loaded.sensors()[0]
    sensor.film().bitmap(raw=False).write(f"{folder}/frame_{number:04d}.exr")
    to_camera, to_screen = matrices(sensor)
    motion = {str(box_id): (before @ np.linalg.inv(now)).tolist()}
    entries.append(
        {
            "frame": number,
            "world_to_camera": to_camera.tolist(),
            "camera_to_screen": to_screen.tolist(),
            "object_motion": motion,
        }
    )
with open(f"{folder}/cameras.json", "w") as file:
    json.dump({"width": width, "height": height, "per_frame": entries}, file)
