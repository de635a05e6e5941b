"""Frames to test on: awkward synthetic scenes and crops of the real sequences. NumPy only; dicts as in `oracle`.

All values are rounded to float32 and returned as float64: a float32 and a float64 filter are given the same numbers.
"""

import json
from pathlib import Path

import numpy as np

BACKGROUND = -1
# Crops (x, y) of 64x48 and the frame they start at, chosen to hold what their sequence is about.
CROPS = {
    "cornell-dolly": (304, 156, 4),
    "gallery-pan": (208, 48, 5),
    "lights-flicker": (304, 60, 10),
}
CROP_SIZE = (64, 48)


def rounded(frame):
    """`frame` with every number one that float32 holds exactly."""
    return {
        name: np.asarray(value, np.int32) if name == "object_id" else np.asarray(value, np.float32).astype(np.float64)
        for name, value in frame.items()
    }


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def flat(height, width, signals=1, radiance=1.0, albedo=1.0, depth=2.0):
    """A frame of one frontal wall that stands still, all values constant."""
    return {
        "radiance": np.full((signals, height, width, 3), float(radiance)),
        "albedo": np.full((1, height, width, 3), float(albedo)),
        "emission": np.zeros((height, width, 3)),
        "normal": np.broadcast_to([0.0, 0.0, -1.0], (height, width, 3)).copy(),
        "depth": np.full((height, width), float(depth)),
        "prev_depth": np.full((height, width), float(depth)),
        "motion": np.zeros((height, width, 2)),
        "object_id": np.zeros((height, width), np.int32),
    }


def synthetic(seed, height, width, *, signals=2, albedos=1, frames=5, moving=True, dirty=False):
    """A sequence of frames with what goes wrong in practice.

    A floor with a dyadic ridge (exact ties in the depth gradient) pans by a fraction of a pixel a frame; before it fly
    two discs and a frontal box with motions and depth changes of their own (disocclusion, prev_depth != depth); part of
    the image has no surface; some albedo is 0, in some channels only; the box's radiance has no variance at all; the
    floor's light jumps in mid-sequence; some motion points outside the image, some far outside. `dirty` adds NaN, Inf
    and negative values to every channel.
    """
    rng = np.random.default_rng(seed)
    scale = max(min(height, width), 4)
    pan = rng.uniform(-1.4, 1.4, 2) if moving else np.zeros(2)
    centres = rng.uniform(0.15, 0.85, (3, 2)) * [width, height]
    velocity = rng.uniform(-2.2, 2.2, (3, 2)) * moving
    approach = rng.uniform(-0.15, 0.3, 3) * moving
    radius = rng.uniform(0.15, 0.3, 3) * scale
    texture = rng.uniform(0.05, 1.0, (albedos, 4, 3))
    light = rng.gamma(1.0, 1.0, (signals, 4, 3)) + 0.05
    hole = rng.uniform(0.1, 0.4, 2) * [width, height]
    y, x = np.meshgrid(np.arange(height) + 0.0, np.arange(width) + 0.0, indexing="ij")

    out = []
    for t in range(frames):
        object_id = np.zeros((height, width), int)
        u, v = x + pan[0] * t, y + pan[1] * t  # position on the floor
        depth = 4 + 0.125 * np.abs(x - width // 2) + 0.0625 * y  # seen from here, not carried with the pan
        normal = unit(np.stack([0.2 * np.sin(0.3 * u), 0.9 + 0 * u, -0.4 + 0.1 * np.cos(0.5 * v)], axis=-1))
        motion = np.broadcast_to(pan, (height, width, 2)).copy()
        prev_depth = depth + 0.01
        for i in range(3):
            cx, cy = centres[i] + velocity[i] * t
            box = i == 2
            distance = np.maximum(np.abs(x - cx), np.abs(y - cy)) if box else np.hypot(x - cx, y - cy)
            covers = distance <= radius[i]
            z = 3.0 - 0.5 * i - approach[i] * t + (0 * x if box else 0.05 * (x - cx) + 0.01 * (y - cy) ** 2)
            n = np.stack([0 * x, 0 * x, 0 * x - 1], axis=-1)
            if not box:
                n = unit(n + 0.3 * np.stack([(x - cx), (y - cy), 0 * x], axis=-1) / radius[i])
            object_id[covers], depth[covers], normal[covers] = 7 * i + 1, z[covers], n[covers]
            motion[covers], prev_depth[covers] = -velocity[i], (z + approach[i])[covers]

        background = (x < hole[0]) & (y < hole[1])
        object_id[background], depth[background], normal[background] = BACKGROUND, 0.0, 0.0

        kind = np.searchsorted([0, 1, 8, 15], np.maximum(object_id, 0))
        albedo = texture[:, kind] * (0.6 + 0.4 * np.sin(0.9 * u + 0.4 * v) ** 2)[None, :, :, None]
        black = np.sin(1.7 * u) * np.sin(1.3 * v) > 0.7
        albedo[:, black] = 0.0
        albedo[:, object_id == 8, 1] = 0.0  # a saturated colour
        albedo[:, background] = 0.0
        expected = light[:, kind] * np.where(object_id == 0, 1.0 + 2.0 * (t > frames // 2), 1.0)[None, :, :, None]
        noise = rng.gamma(0.5, 2.0, (signals, height, width, 1))
        radiance = expected * np.where((object_id == 15)[..., None], 1.0, noise)
        radiance *= np.where(albedo == 0, 0.002, albedo)
        radiance[:, background] = 0.0
        emission = np.where(background[..., None], [0.3, 0.5, 0.9], 0.0)
        emission[object_id == 8] = rng.uniform(0, 2, 3)
        motion[rng.random((height, width)) < 0.02] = -1e4
        motion[rng.random((height, width)) < 0.02] = [1e30, -3.0]
        motion[rng.random((height, width)) < 0.03] = rng.uniform(-1.5, 1.5, 2) * [width, height]
        frame = {
            "radiance": radiance,
            "albedo": albedo,
            "emission": emission,
            "normal": normal,
            "depth": depth,
            "prev_depth": prev_depth,
            "motion": motion,
            "object_id": object_id,
        }
        out.append(rounded(soil(rng, frame) if dirty else frame))
    return out


def soil(rng, frame):
    """`frame` with NaN, Inf and negative numbers strewn over every channel of floating-point numbers."""
    frame = {name: np.array(value) for name, value in frame.items()}
    for name, value in frame.items():
        if name == "object_id":
            continue
        for bad in (np.nan, np.inf, -np.inf) + ((-0.5,) if name in ("radiance", "emission") else ()):
            value[rng.random(value.shape) < 0.004] = bad
    return frame


def real(data: Path, name, *, frames=3, size=CROP_SIZE, at=None):
    """A crop of `frames` frames of a real sequence (S = 2), prev_depth exact from its cameras."""
    x, y, start = at or CROPS[name]
    width, height = size
    cameras = json.loads((data / name / "cameras.json").read_text())["per_frame"]
    return [
        crop(real_frame(data / name / f"frame_{i:04d}.exr", cameras, i), x, y, width, height)
        for i in range(start, start + frames)
    ]


def crop(frame, x, y, width, height):
    """A window of every channel; motion stays what it is, so what comes from outside the window comes from outside."""
    return {
        name: value[..., y : y + height, x : x + width]
        if value.ndim == 2
        else value[..., y : y + height, x : x + width, :]
        for name, value in frame.items()
    }


def real_frame(path, cameras, number):
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {key: np.array(value.pixels, np.float64) for key, value in file.channels().items()}

    def layer(name, letters):
        return np.stack([channels[f"{name}.{letter}"] for letter in letters], axis=-1)

    normal, depth, object_id = layer("normal", "XYZ"), channels["depth.Z"], channels["id.I"].astype(np.int32)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    frame = {
        "radiance": np.stack([layer("direct", "RGB"), layer("indirect", "RGB")]),
        "albedo": layer("albedo", "RGB")[None],
        "emission": layer("emission", "RGB"),
        "normal": np.where(length > 0, normal / np.where(length > 0, length, 1), 0),
        "depth": depth,
        "prev_depth": previous_depth(depth, object_id, cameras[number], cameras[max(number - 1, 0)]),
        "motion": layer("motion", "XY"),
        "object_id": np.where((length[..., 0] > 0) & (depth > 0), object_id, BACKGROUND).astype(np.int32),
    }
    return rounded(frame)


def previous_depth(depth, object_id, camera, prev_camera):
    """Where each surface point was one frame ago, as depth in that frame's camera."""
    height, width = depth.shape
    to_screen = np.array(camera["camera_to_screen"])
    y, x = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    in_camera = np.stack(
        [
            (x - to_screen[0, 2]) / to_screen[0, 0] * depth,
            (y - to_screen[1, 2]) / to_screen[1, 1] * depth,
            depth,
            np.ones_like(depth),
        ],
        axis=-1,
    )
    world = in_camera @ np.linalg.inv(np.array(camera["world_to_camera"])).T
    for key, motion in camera["object_motion"].items():
        moved = world @ np.array(motion).T
        world = np.where((object_id == int(key))[..., None], moved, world)
    return np.where(object_id == BACKGROUND, 0.0, (world @ np.array(prev_camera["world_to_camera"]).T)[..., 2])
