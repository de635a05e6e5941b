"""What a run will need, roughly: time, memory, disk. Linear in the number of pixels; measured as the constants say."""

from typing import Any, NamedTuple

from svgf_jax.outputs import WriteOptions
from svgf_jax.scan import Scan

# Mitsuba frames tiled to 960 x 540 and 1920 x 1080, one and two signals, preset `paper`, two cores of a server CPU with AVX-512.
SECONDS = 3.4e-7  # a pixel: reading 22 channels, writing, what is done once for all signals
SECONDS_A_LEVEL = 4.3e-8  # a pixel, signal and a-trous level; all before the first level counts for two
SECONDS_OF_LIGHT = (
    1.1e-7  # a pixel and signal, where changes of the light are followed: by tests/bench/README.md, 1920 x 1080
)
BASE_MEMORY = 3.5e8  # bytes: Python, JAX
MEMORY = 400.0  # bytes a pixel
MEMORY_A_SIGNAL = 190.0


class Estimate(NamedTuple):
    """Rough needs of a run on a CPU.

    Attributes:
        seconds: a frame, on two cores, once compiled.
        memory: bytes at the peak.
        disk: bytes of all outputs, at most about.
    """

    seconds: float
    memory: float
    disk: float


def estimate(scan: Scan, *, pixels: int, signals: int, config: Any, options: WriteOptions = WriteOptions()) -> Estimate:
    """Estimate a run over frames of so many `pixels` and `signals`; `config` is that of the filter."""
    levels = getattr(config, "levels", None) or 5  # other methods leave it open
    light = SECONDS_OF_LIGHT if getattr(config, "light_cell", 0) else 0.0
    seconds = pixels * (SECONDS + signals * (SECONDS_A_LEVEL * (levels + 2) + light))
    memory = BASE_MEMORY + pixels * (MEMORY + MEMORY_A_SIGNAL * signals)
    return Estimate(seconds, memory, _disk(scan, pixels, signals, options, layers=3 if light else 2))


def _disk(scan: Scan, pixels: int, signals: int, options: WriteOptions, *, layers: int) -> float:
    """The input's own layers as they are compressed there, and the new ones as if they did not compress at all.

    `layers` are the diagnostics of a signal.
    """
    planes = 3 + (layers * signals + 2 if options.diagnostics else 0)
    frames = len(scan.there)
    own = 0.0 if options.only_denoised else scan.stored / max(frames, 1)
    return frames * (own + pixels * planes * (4 if options.full_float else 2) + (pixels if options.png else 0))
