"""Files as GAMES202 hands them out: a small scene with a camera and an object that move, every position and matrix exact."""

import numpy as np

from svgf_jax import exr

SIZE = (14, 18)
Z_UP = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [-1, 0, 0, 5], [0, 0, 0, 1]])  # the homework's camera


def turn(angle, shift=(0.0, 0.0, 0.0)):
    """A rotation about z, then a shift."""
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    matrix[:3, 3] = shift
    return matrix


def matrices(number, size=SIZE):
    """Object to world of two objects, world to camera, world to screen, as float32 holds them: camera and object 1 move."""
    height, width = size
    camera = Z_UP @ turn(0.02 * number, (0.1 * number, 0.0, 0.05 * number))
    to_screen = np.array([[20.0, 0, width / 2, 0], [0, -20.0, height / 2, 0], [0, 0, 1, -0.01], [0, 0, 1, 0]])
    return [m.astype(np.float32) for m in (np.eye(4), turn(0.3 * number, (0, 0.2, 0)), camera, to_screen @ camera)]


def pack(*four_by_four, count=None):
    """The bytes of a .mat file."""
    count = len(four_by_four) - 2 if count is None else count
    return np.int32(count).tobytes() + b"".join(np.asarray(m, np.float32).tobytes() for m in four_by_four)


def write_shot(folder, numbers=range(4), size=SIZE):
    """`folder/input/beauty_0.exr` and so on; the folder. Two walls, one of them object 1; a column of background."""
    inside = folder / "input"
    inside.mkdir(parents=True)
    height, width = size
    y, x = np.mgrid[:height, :width] + 0.5
    for number in numbers:
        rng = np.random.default_rng(number)
        *_, camera, screen = (m.astype(np.float64) for m in matrices(number, size))
        ids = np.where(x > width / 2, 1, 0)
        ids[:, :2] = -1
        depth = np.where(ids == 1, 3.0 + 0.05 * y, 4.0 + 0.02 * x)
        # What is seen through a pixel's centre at that depth: three linear equations for each pixel.
        equations = np.stack(
            [screen[0] - x[..., None] * screen[3], screen[1] - y[..., None] * screen[3], 0 * x[..., None] + camera[2]],
            -2,
        )
        right = np.stack([0 * depth, 0 * depth, depth], -1) - equations[..., 3]
        position = np.linalg.solve(equations[..., :3], right[..., None])[..., 0]
        normal = np.where((ids == 1)[..., None], [0.6, 0.0, 0.8], [1.0, 0.0, 0.0])
        radiance = rng.gamma(0.5, 0.5, (height, width, 3))
        gone = ids == -1
        layers = {"beauty": (radiance, 0), "normal": (normal, 0), "position": (position, 5.0)}
        for name, (values, background) in layers.items():
            values = np.where(gone[..., None], background, values).astype(np.float32)
            write(inside / f"{name}_{number}.exr", {c: values[..., i] for i, c in enumerate("RGB")})
        for name, values in (("depth", np.where(gone, 0, depth)), ("ID", ids)):
            write(inside / f"{name}_{number}.exr", {"Y": values.astype(np.float32)})
        (inside / f"matrix_{number}.mat").write_bytes(pack(*matrices(number, size)))
    return folder


def write(path, channels):
    exr.write(path, exr.new_image({name: np.ascontiguousarray(values) for name, values in channels.items()}))
