"""Short sequences in which anything may be wrong: hypothesis draws what, where and when; and what must hold of the result."""

import numpy as np
import scenes
from hypothesis import strategies as st

from svgf_jax.types import Frame, Output

SIZE = (12, 16)
FRAMES = 5
GROWTH = 50.0  # `adaptive` may scale a history by so much in a frame, to follow the light; the others never
F32 = np.finfo(np.float32)
BRIGHTEST = np.float32(2**40)
FARTHEST = float(F32.max) ** 0.5 / 2**6  # of usable depths

LIGHT = (np.nan, np.inf, -np.inf, -0.5, -1e30, 1e30, 3e38, 1e-42, 0.0, 1e6, 1e-6)
NUMBERS = {
    "radiance": LIGHT,
    "emission": LIGHT,
    "albedo": (np.nan, np.inf, -1.0, 0.0, 1e-42, 1e-6, 1e6, 1e30, 3e38),
    "normal": (np.nan, np.inf, 0.0, 1e-42, 1e-3, 5.0, -1.0, 1e30),
    "depth": (np.nan, np.inf, 0.0, -1.0, 1e-42, 1e-6, 1e8, 1e30, 3e38),
    "prev_depth": (np.nan, np.inf, 0.0, -1.0, 1e-42, 1e8, 3e38),
    "motion": (np.nan, np.inf, 1e6, -1e6, 1e30, 3e38, 0.5, 1e-42),
    "object_id": (-1, 0, 7, 2**31 - 1, -(2**31)),
    "variance": (np.nan, np.inf, -1.0, 0.0, 1e-42, 1e30, 3e38),
}
"""What may stand in a channel instead of what belongs there."""

WHERE = ("pixel", "few", "half", "block", "all", "channel")
KINDS = ("put", "scale", "shuffle", "constant")

faults = st.lists(
    st.tuples(
        st.sampled_from(sorted(NUMBERS)),
        st.sampled_from(KINDS + ("put",) * 5),
        st.integers(0, 10),
        st.sampled_from(WHERE),
        st.integers(0, 2**FRAMES - 1),  # the frames, as bits
    ),
    min_size=1,
    max_size=6,
)
cases = st.tuples(st.integers(0, 2**16), faults)


def build(case, *, variance: bool = False) -> Frame:
    """The sequence of a case, float32, with a leading T."""
    seed, wrong = case
    height, width = SIZE
    frames = scenes.synthetic(seed % 97, height, width, frames=FRAMES, signals=2)
    if variance:
        frames = [one | {"variance": np.square(one["radiance"].mean(-1))} for one in frames]
    rng = np.random.default_rng(seed)
    for channel, kind, which, where, bits in wrong:
        for t, frame in enumerate(frames):
            if bits >> t & 1 and channel in frame:
                _damage(frame, channel, kind, which, where, rng)
    with np.errstate(over="ignore"):
        return Frame(
            **{
                name: np.stack([one[name] for one in frames]).astype(np.int32 if name == "object_id" else np.float32)
                for name in frames[0]
            }
        )


def _damage(frame, channel, kind, which, where, rng):
    values = np.array(frame[channel])
    height, width = SIZE
    mask = np.zeros(SIZE, bool)
    if where == "pixel":
        mask[rng.integers(height), rng.integers(width)] = True
    elif where == "block":
        y, x = rng.integers(height - 4), rng.integers(width - 4)
        mask[y : y + 4, x : x + 4] = True
    else:
        mask |= rng.random(SIZE) < {"few": 0.05, "half": 0.5, "all": 1.1, "channel": 1.1}[where]
    if values.ndim > 2:
        last = values.shape[-1] if values.shape[-1] in (2, 3) else 1
        component = np.arange(last) == rng.integers(last) if where == "channel" else np.ones(last, bool)
        mask = np.broadcast_to(mask[..., None] & component if last > 1 else mask, values.shape)
    bad = NUMBERS[channel][which % len(NUMBERS[channel])]
    if kind == "put":
        values[mask] = bad
    elif kind == "scale" and channel != "object_id":
        with np.errstate(invalid="ignore", over="ignore"):
            values[mask] *= bad
    elif kind == "shuffle":
        values[mask] = rng.permutation(values[mask])
    else:
        values[mask] = values[mask][0] if mask.any() else 0
    frame[channel] = values


def sane_light(frames: Frame, albedo_floor: float) -> np.ndarray:
    """The largest sane illumination up to each frame, by signal: `[T, S]`."""
    with np.errstate(over="ignore", invalid="ignore"):
        radiance = np.where(
            np.isfinite(frames.radiance) & (frames.radiance >= 0), np.minimum(frames.radiance, BRIGHTEST), 0
        )
        albedo = np.where(np.isfinite(frames.albedo), np.minimum(frames.albedo, 2**20), 1)
        light = np.minimum(radiance / np.maximum(albedo, np.float32(albedo_floor)), F32.max / 2**12)
    return np.maximum.accumulate(light.max(axis=(2, 3, 4)), axis=0)


def check(frames: Frame, output: Output, *, albedo_floor: float = 1e-3, growth: float = 1.0) -> float:
    """What must hold; returns the largest share of the bound that was reached.

    Every number is finite. No illumination is negative, or brighter than the brightest of its signal so far (times `growth`): the
    filter only ever takes means. Bad pixels are counted, each under its name.
    """
    for name, values in output._asdict().items():
        for part in [values] if name != "rejected" else values:
            assert part is None or np.isfinite(part).all(), name
    bound = sane_light(frames, albedo_floor)[:, :, None, None, None]
    assert (output.illumination >= 0).all()
    assert (output.variance >= 0).all()
    assert (output.variance_filtered >= 0).all()
    with np.errstate(over="ignore"):
        share = output.illumination / np.maximum(np.float32(growth) * bound, F32.tiny)
    assert share.max() <= 1 + 1e-4, share.max()
    surface = frames.object_id != -1
    guided = (
        np.isfinite(frames.normal).all(-1) & (np.abs(frames.depth) < FARTHEST) & np.isfinite(frames.albedo).all((1, 4))
    )
    traced = np.isfinite(frames.motion).all(-1) & (np.abs(frames.prev_depth) < FARTHEST)
    with np.errstate(over="ignore", invalid="ignore"):
        square = np.square(frames.normal.astype(np.float64)).sum(-1)
        unusual = (np.abs(square - 1) > 0.02) & (np.abs(frames.normal).max(-1) > 1e-18)
    counted = {
        "radiance": ~np.isfinite(frames.radiance).all((1, 4)),
        "negative": (np.isfinite(frames.radiance) & (frames.radiance < 0)).any((1, 4)),
        "bright": (np.isfinite(frames.radiance) & (frames.radiance > BRIGHTEST)).any((1, 4)),
        "emission": ~np.isfinite(frames.emission).all(-1),
        "surface": surface & ~guided,
        "motion": surface & guided & ~traced,
        "normal": surface & guided & unusual,
    }
    for name, where in counted.items():
        np.testing.assert_array_equal(getattr(output.rejected, name), where.sum((1, 2)), err_msg=name)
    return float(share.max())
