"""Small synthetic sequences on disk, and a filter simple enough to predict, for the tests of streaming and commands."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from svgf_jax import exr
from svgf_jax.types import History, Output, Rejected

SIZE = (14, 19)


def write_frame(path, number, *, size=SIZE, layers=True):
    """A frame in the native schema with a moving blob, a layer `crypto.R` of another type, and header attributes."""
    rng = np.random.default_rng(number)
    y, x = np.mgrid[: size[0], : size[1]]
    surface = x > 2
    channels = {}
    for layer, strength in (("direct", 2.0), ("indirect", 0.5)):
        for c in "RGB":
            channels[f"{layer}.{c}"] = rng.gamma(0.5, strength, size).astype(np.float16)
    for i, c in enumerate("RGB"):
        channels[f"albedo.{c}"] = np.full(size, 0.3 + 0.2 * i, np.float16)
        channels[f"emission.{c}"] = np.where(surface, 0, 0.7).astype(np.float16)
    for c, value in zip("XYZ", (0, 0, 1), strict=True):
        channels[f"normal.{c}"] = np.where(surface, value, 0).astype(np.float16)
    channels["depth.Z"] = np.where(surface, 3.0 + 0.01 * y, 0).astype(np.float32)
    channels["motion.X"] = np.full(size, -0.25, np.float32)
    channels["motion.Y"] = np.zeros(size, np.float32)
    channels["id.I"] = np.where(surface, 1 + (x > size[1] // 2), -1).astype(np.float32)
    if layers:
        channels["crypto.R"] = rng.integers(0, 2**32, size, np.uint32)
    attributes = {"comments": f"take [bold]{number}[/bold]", "iso": 100.0, "shot": 7}
    exr.write(path, exr.new_image(channels, attributes=attributes if layers else None))


def write_shot(folder, numbers=range(1, 8), **options):
    """Frames `shot.NNNN.exr`; the pattern that names them."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    for number in numbers:
        write_frame(Path(folder) / f"shot.{number:04d}.exr", number, **options)
    return str(Path(folder) / "shot.####.exr")


def init(frame):
    """No history."""
    signals, height, width, _ = frame.radiance.shape
    zeros = jnp.zeros((signals, height, width, 3), jnp.float32)
    return History(zeros, zeros[..., :2], zeros[0, ..., 0], frame.depth, frame.normal, frame.object_id)


def step(history, frame, *, params, config):
    """A running mean; it takes the wanted outputs' shapes seriously and nothing else."""
    weight = jnp.asarray(params.alpha, jnp.float32)
    length = history.history_length + 1
    light = jnp.where(length[None, ..., None] == 1, frame.radiance, 0) + jnp.where(
        length[None, ..., None] == 1, 0, (1 - weight) * history.illumination + weight * frame.radiance
    )
    bad = (frame.radiance < 0).any((0, -1)).sum().astype(jnp.int32)
    zero = jnp.zeros((), jnp.int32)
    output = Output(
        image=light.sum(0) + frame.emission,
        illumination=light,
        variance=light[..., 0] * config.levels,
        variance_filtered=light[..., 0],
        history_length=length,
        valid=length > 1,
        rejected=Rejected(zero, bad, zero, zero, zero, zero, zero),
    )
    return History(light, history.moments, length, frame.depth, frame.normal, frame.object_id), output
