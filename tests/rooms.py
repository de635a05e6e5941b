"""A room seen by a turning camera, ray cast in a few lines: guides, cameras and motion that are exact, light that is noise."""

import json
from pathlib import Path

import numpy as np

from svgf_jax import exr

SIZE = (64, 96)
PLANES = [
    ((0, 1, 0), 1.0),
    ((0, -1, 0), 1.5),
    ((0, 0, 1), 5.0),
    ((1, 0, 0), 2.0),
    ((-1, 0, 0), 2.5),
]  # n . P = d, y down
FOCAL = 70.0


def camera(number, *, speed=1.0):
    """(world to camera, camera to screen) of a frame: x right, y down, z forward; it turns and walks."""
    turn = 0.03 * speed * number + 0.1
    cosine, sine = np.cos(turn), np.sin(turn)
    to_camera = np.eye(4)
    to_camera[:3, :3] = [[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]]
    to_camera[:3, :3] = to_camera[:3, :3] @ [[1, 0, 0], [0, 0.98, 0.199], [0, -0.199, 0.98]]
    to_camera[:3, 3] = -to_camera[:3, :3] @ [0.02 * speed * number, 0.01 * speed * number, 0.05 * speed * number]
    height, width = SIZE
    to_screen = np.array([[FOCAL, 0, width / 2, 0], [0, FOCAL, height / 2, 0], [0, 0, 0, 1], [0, 0, 1, 0]])
    return to_camera, to_screen


def room(number, *, speed=1.0, seed=None, hole=8):
    """The planes of a frame by role, `[H, W, C]` float32. In a corner of `hole` pixels there is nothing."""
    to_camera, to_screen = camera(number, speed=speed)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    ray = np.stack([(x - to_screen[0, 2]) / FOCAL, (y - to_screen[1, 2]) / FOCAL, np.ones_like(x)], -1)
    to_world = np.linalg.inv(to_camera)
    eye, ray = to_world[:3, 3], ray @ to_world[:3, :3].T  # a ray's parameter is view z
    z = np.full(SIZE, np.inf)
    normal, ids = np.zeros((*SIZE, 3)), np.zeros(SIZE)
    for which, (n, d) in enumerate(PLANES):
        with np.errstate(all="ignore"):
            hit = (d - eye @ n) / (ray @ n)
        nearer = (hit > 0) & (hit < z)
        z, ids = np.where(nearer, hit, z), np.where(nearer, which, ids)
        normal[nearer] = -np.array(n, float)
    position = eye + z[..., None] * ray
    before, _ = camera(number - 1, speed=speed)
    there = position @ before[:3, :3].T + before[:3, 3]
    motion = FOCAL * there[..., :2] / there[..., 2:] + [to_screen[0, 2], to_screen[1, 2]] - np.stack([x, y], -1)
    rng = np.random.default_rng(number if seed is None else seed)
    light = (1 + 0.3 * np.sin(position[..., :1])) * rng.gamma(1.0, 1.0, (*SIZE, 1)) * np.ones(3)
    albedo = 0.5 + 0.3 * np.sin(3 * position)
    planes = {"radiance": light * albedo, "albedo": albedo, "normal": normal, "position": position, "motion": motion}
    planes |= {"depth": z[..., None], "id": ids[..., None]}
    for plane in planes.values():
        plane[:hole, :hole] = 0
    planes["id"][:hole, :hole] = -1
    return {name: plane.astype(np.float32) for name, plane in planes.items()}


LETTERS = {
    "radiance": "RGB",
    "albedo": "RGB",
    "normal": "XYZ",
    "position": "XYZ",
    "motion": "XY",
    "depth": "Z",
    "id": "I",
}


def write_room(
    folder, numbers=range(4), *, change=None, cameras=True, drop=(), half=(), rename=None, attributes=None, **options
):
    """Write frames `room.NNNN.exr` of `room`, after `change(number, planes)`; returns the folder."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for number in numbers:
        planes = room(number, **options)
        if change is not None:
            change(number, planes)
        channels = {}
        for role, letters in LETTERS.items():
            if role not in drop:
                for at, letter in enumerate(letters):
                    name = letter if role == "radiance" else f"{role}.{letter}"
                    name = name.replace(*rename) if rename else name
                    channels[name] = planes[role][..., at].astype(np.float16 if role in half else np.float32)
        exr.write(folder / f"room.{number:04d}.exr", exr.new_image(channels, attributes=attributes))
    if cameras:
        frames = [(number, camera(number, speed=options.get("speed", 1.0))) for number in numbers]
        told = [
            {"frame": number, "world_to_camera": to_camera.tolist(), "camera_to_screen": to_screen.tolist()}
            for number, (to_camera, to_screen) in frames
        ]
        (folder / "cameras.json").write_text(json.dumps({"width": SIZE[1], "height": SIZE[0], "per_frame": told}))
    return folder
