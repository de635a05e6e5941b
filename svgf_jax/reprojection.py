"""Temporal reprojection: fetch each pixel's history from where its surface point was (Schied et al. 2017, section 4.1)."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from svgf_jax.sampling import BY_WIDTH, place, planes, read_at, split_rows, square_offsets, stack_planes, whole
from svgf_jax.types import Config, Frame, History, Params, Reprojected, at_level

_LEAST_WEIGHT = 0.01  # of the consistent ones of the 2 x 2 taps, to be trusted
_BILINEAR = np.array([[0, 0], [0, 1], [1, 0], [1, 1]], dtype=np.int32)
_NEAREST = np.array([[0, 0]], dtype=np.int32)


def reproject(
    history: History,
    frame: Frame,
    *,
    params: Params,
    config: Config = Config(),
    strip_rows: int | None = BY_WIDTH,
) -> Reprojected:
    """Bring the history to this frame's pixels.

    A previous pixel q is consistent with p if it is inside the image, has the same object id, a depth within reproject_depth of
    prev_depth(p), and a normal within reproject_normal. P = p + motion(p); the history is the bilinear mean of the consistent ones
    of the 2 x 2 taps around P, if their weights sum to 0.01 or more; else the plain mean of the consistent ones of the 3 x 3 around
    the pixel nearest to P; else there is none. Every tap is judged by itself, so P may lie outside the image.

    Args:
        history: of the previous frame.
        frame: sanitised.
        params: per-level leaves are read at entry 0.
        config: `reprojection` "nearest" takes the pixel nearest to P in place of the 2 x 2; without `fallback` the 3 x 3 are
            not asked; without `id_test` any surface may continue any other.
        strip_rows: rows handled at a time (the fallback runs only in strips that need it); None = all at once.
    """
    scalars = at_level(params, 0)
    height, width = frame.depth.shape
    count, rows = (1, height) if strip_rows is None else split_rows(height, width, strip_rows)
    above, image_height = place(frame.depth)
    guides = whole({"id": history.object_id, "depth": history.depth, "normal": planes(history.normal)})
    worth = None if history.effective_history is None else tuple(history.effective_history)
    values = (tuple(map(planes, history.illumination)), tuple(map(planes, history.moments)), history.history_length)
    values = whole((*values, worth))
    current = {
        "id": frame.object_id,
        "depth": frame.prev_depth,
        "normal": planes(frame.normal),
        "motion": planes(frame.motion),
    }
    # Rows below the image read object id 0, whose history is thrown away again.
    padded = jax.tree.map(lambda a: jnp.pad(a, ((0, count * rows - height), (0, 0))), current)

    def consistent(p, row: Array, column: Array) -> Array:
        read = lambda plane: read_at(plane, row, column)[0]  # noqa: E731
        q_id, inside = read_at(guides["id"], row, column)
        near = jnp.abs(read(guides["depth"]) - p["depth"]) <= scalars.reproject_depth * jnp.maximum(p["depth"], 1e-6)
        n = [a * read(b) for a, b in zip(p["normal"], guides["normal"], strict=True)]
        same = q_id == p["id"] if config.id_test else q_id != -1
        return inside & (p["id"] != -1) & same & near & (n[0] + n[1] + n[2] >= scalars.reproject_normal)

    def mean_over(base_row: Array, base_column: Array, offsets: np.ndarray, weigh) -> tuple[Array, Any]:
        """Weights and weighted sums of the history's values over the taps base + offsets."""
        taps = jnp.asarray(offsets)
        weights = lax.map(lambda o: weigh(base_row + o[0], base_column + o[1], o), taps)

        def add(sums, tap):
            offset, weight = tap
            return jax.tree.map(
                lambda s, v: s + weight * read_at(v, base_row + offset[0], base_column + offset[1])[0], sums, values
            ), None

        zeros = jax.tree.map(lambda _: jnp.zeros((rows, width), frame.depth.dtype), values)
        sums, _ = lax.scan(add, zeros, (taps, weights))
        return weights.sum(axis=0), sums

    def strip(first_row: Array):
        p = jax.tree.map(lambda a: lax.dynamic_slice(a, (first_row, jnp.zeros_like(first_row)), (rows, width)), padded)
        x, y = (_position(p["motion"][axis], above + first_row, axis, (width, image_height)[axis]) for axis in (0, 1))

        def nearest():
            return jnp.floor(y + 0.5).astype(jnp.int32), jnp.floor(x + 0.5).astype(jnp.int32)

        def plain(row: Array, column: Array, offset: Array) -> Array:
            return consistent(p, row, column).astype(x.dtype)

        floor_x, floor_y = jnp.floor(x), jnp.floor(y)
        fraction_x, fraction_y = x - floor_x, y - floor_y

        def bilinear(row: Array, column: Array, offset: Array) -> Array:
            weight_y = jnp.where(offset[0] == 1, fraction_y, 1.0 - fraction_y)
            weight_x = jnp.where(offset[1] == 1, fraction_x, 1.0 - fraction_x)
            return jnp.where(consistent(p, row, column), weight_y * weight_x, 0.0)

        if config.reprojection == "nearest":
            weight, sums = mean_over(*nearest(), _NEAREST, plain)
        else:
            weight, sums = mean_over(floor_y.astype(jnp.int32), floor_x.astype(jnp.int32), _BILINEAR, bilinear)
        found = weight >= _LEAST_WEIGHT
        missing = ~found & (p["id"] != -1)

        def fall_back():
            return mean_over(*nearest(), square_offsets(1), plain)

        def nothing():
            return jax.tree.map(jnp.zeros_like, (weight, sums))

        around, around_sums = lax.cond(jnp.any(missing), fall_back, nothing) if config.fallback else nothing()
        found_around = missing & (around > 0.0)
        divisor = jnp.where(found, weight, jnp.where(found_around, around, 1.0))
        means = jax.tree.map(
            lambda near, far: jnp.where(found, near, jnp.where(found_around, far, 0.0)) / divisor, sums, around_sums
        )
        return means, found | found_around

    strip = jax.checkpoint(strip, prevent_cse=False)  # type: ignore[assignment]
    result = lax.map(strip, jnp.arange(count, dtype=jnp.int32) * rows)
    (illumination, moments, length, worth), valid = jax.tree.map(
        lambda a: a.reshape(count * rows, width)[:height], result
    )
    return Reprojected(
        illumination=stack_planes(illumination),
        moments=stack_planes(moments),
        history_length=length,
        valid=valid,
        effective_history=None if worth is None else jnp.stack(worth),
    )


def reproject_reflections(
    previous: Reprojected, history: History, frame: Frame, *, params: Params, config: Config = Config()
) -> Reprojected:
    """Take from where their reflections were the illumination and moments of the signals that have any, and their worth.

    A signal's previous pixels are judged as in `reproject`, at the reflected motion. Where none is consistent, and in signals
    without reflections, the history stays that of the surface.
    """
    if frame.reflected_motion is None:
        return previous
    assert frame.reflected_prev_depth is not None  # `check_frame` saw to it: all three or none
    of_signals = ("illumination", "moments", *(() if history.effective_history is None else ("effective_history",)))
    signals = []
    for s in range(frame.radiance.shape[0]):
        past = history._replace(**{name: getattr(history, name)[s : s + 1] for name in of_signals})
        seen = frame._replace(motion=frame.reflected_motion[s], prev_depth=frame.reflected_prev_depth[s])
        signals.append(reproject(past, seen, params=params, config=config))

    def choose(name: str) -> Array:
        reflected = jnp.concatenate([getattr(signal, name) for signal in signals])
        known = jnp.stack([signal.valid for signal in signals]) & previous.valid[None]
        known = known.reshape(*known.shape, *[1] * (reflected.ndim - known.ndim))
        return jnp.where(known, reflected, getattr(previous, name))

    return previous._replace(**{name: choose(name) for name in of_signals})


def _position(motion: Array, first_row: Array, axis: int, extent: int) -> Array:
    """P along one axis, in pixels; far outside the image it is as good as just outside."""
    index = lax.broadcasted_iota(jnp.int32, motion.shape, 1 - axis)
    start = first_row if axis == 1 else jnp.zeros_like(first_row)
    return jnp.clip((start + index).astype(motion.dtype) + motion, -4.0, extent + 4.0)
