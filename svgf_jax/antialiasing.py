"""Temporal anti-aliasing: the image blended with its own past, which is clipped to what the pixel's neighbourhood shows.

After Karis, *High-Quality Temporal Supersampling* (SIGGRAPH 2014 course). Everything happens on the reversible tone curve
c / (1 + luma), so that one bright sample does not decide a pixel; the way back gives a linear image.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from svgf_jax.check import check_image, check_taa
from svgf_jax.sampling import (
    BY_WIDTH,
    in_strips,
    inside_image,
    place,
    planes,
    read_at,
    square_offsets,
    sum_over_taps,
    whole,
)
from svgf_jax.tonemapping import compress_luma, expand_luma
from svgf_jax.types import Params, TaaHistory, at_level

_LEAST_EXTENT = 1e-6  # of the neighbourhood's box, so that being outside it stays a quotient
_AROUND = np.array(
    sorted(square_offsets(1).tolist(), key=lambda offset: np.abs(offset).sum()), np.int32
)  # centre first
_CUBIC = square_offsets(2)[(square_offsets(2) > -2).all(axis=1)]  # -1 .. 2 each way
_LARGEST = 1e18
_FAR = 4.0  # pixels outside the image from where on it makes no difference how many


def taa_init(image: Array) -> TaaHistory:
    """The empty past that a sequence starts with. Only the shape `[H, W, 3]` and the dtype of `image` matter."""
    check_image(image)
    return TaaHistory(color=jnp.zeros(image.shape, image.dtype), frames=jnp.zeros((), image.dtype))


def taa(
    history: TaaHistory,
    image: Array,
    motion: Array,
    depth: Array,
    *,
    params: Params = Params(),
    strip_rows: int = BY_WIDTH,
) -> tuple[TaaHistory, Array]:
    """Anti-alias one frame: (history, frame) -> (history, image).

    P = p + motion(q), with q the pixel of the 3 x 3 around p that lies nearest to the camera, so that an edge moves with what is in
    front. The past at P (Catmull-Rom) is moved towards the centre of the box of the 3 x 3 around p in YCoCg until it lies inside,
    and blended: (1 - a) past + a image, a = max(taa_alpha, 1 / frames); a = 1 where P lies outside the image.

    Args:
        history: of the frame before; `taa_init(image)` at the start or after a cut.
        image: `[H, W, 3]`, scene-linear; what is not finite counts as 0.
        motion: `[H, W, 2]`, pixels, as in `Frame`, without the camera's jitter; of the background too. Not finite: no past.
        depth: `[H, W]`, linear, > 0; 0 or not finite where there is no surface, which is behind everything.
        params: `taa_alpha` is read, of per-level leaves entry 0.
        strip_rows: rows handled at a time.

    Returns:
        The history, whose color is the display image (on the tone curve), and the linear image `[H, W, 3]`. In float32 the way to
        the curve and back keeps a radiance of 1 to 1e-7 of itself, one of 1000 to 1e-4; the largest is 1e7.

    Raises:
        SvgfError: shapes or dtypes that do not fit together.
    """
    history, image, motion, depth = jax.tree.map(jnp.asarray, (history, image, motion, depth))
    check_taa(history, image, motion, depth)
    height, width, _ = image.shape
    dtype = image.dtype
    alpha = jnp.asarray(at_level(params, 0).taa_alpha, dtype)
    linear = planes(jnp.clip(jnp.where(jnp.isfinite(image), image, 0.0), -_LARGEST, _LARGEST))
    behind = ~(jnp.isfinite(depth) & (depth > 0.0))
    nearness = jnp.where(behind, 0.0, 1.0 / jnp.where(behind, 1.0, jnp.maximum(depth, 1e-12)))
    usable = jnp.isfinite(motion).all(axis=-1)
    moved = planes(jnp.where(usable[..., None], motion, 0.0))
    (display,) = in_strips(lambda color: (compress_luma(color),), linear, strip_rows=strip_rows)
    nearest, box = _neighbourhood(nearness, (*moved, usable.astype(dtype)), display, strip_rows)

    above, image_height = place(depth)
    row, column = (lax.broadcasted_iota(jnp.int32, (height, width), axis) for axis in (0, 1))
    y, x = (above + row).astype(dtype), column.astype(dtype)
    past = whole(planes(history.color))
    a = jnp.maximum(alpha, 1.0 / (history.frames + 1.0))
    started = history.frames > 0.0

    def resolve(linear, display, nearest, box, y, x):
        motion_x, motion_y, usable = nearest
        at_x = jnp.clip(x + motion_x, -_FAR, width + _FAR)
        at_y = jnp.clip(y + motion_y, -_FAR, image_height + _FAR)
        inside = (at_x >= -0.5) & (at_x <= width - 0.5) & (at_y >= -0.5) & (at_y <= image_height - 0.5)
        valid = inside & (usable > 0.5) & started
        clipped = _to_rgb(_clip_to_box(_to_ycocg(_read_cubic(past, at_y, at_x)), *box))
        blended = tuple((1.0 - a) * old + a * new for old, new in zip(clipped, display, strict=True))
        return (
            tuple(jnp.where(valid, b, d) for b, d in zip(blended, display, strict=True)),
            tuple(jnp.where(valid, e, c) for e, c in zip(expand_luma(blended), linear, strict=True)),
        )

    color, result = in_strips(resolve, linear, display, nearest, box, y, x, strip_rows=strip_rows)
    frames = jnp.minimum(history.frames + 1.0, 2.0**20)
    return TaaHistory(color=jnp.stack(color, axis=-1), frames=frames), jnp.stack(result, axis=-1)


def _neighbourhood(nearness: Array, motion: tuple[Array, ...], display: tuple[Array, ...], strip_rows: int):
    """Over the 3 x 3: the motion of the nearest pixel (of equals the first, the centre before all), and the YCoCg box."""
    inside = inside_image(nearness)
    neighbours = {"near": nearness, "motion": motion, "color": _to_ycocg(display), "inside": inside}

    def tap(sums, q, p, t):
        nearest, carried, low, high = sums
        closer, there = q["near"] > nearest, q["inside"] > 0.5
        carried = tuple(jnp.where(closer & there, new, old) for new, old in zip(q["motion"], carried, strict=True))
        low = tuple(jnp.where(there, jnp.minimum(a, b), a) for a, b in zip(low, q["color"], strict=True))
        high = tuple(jnp.where(there, jnp.maximum(a, b), a) for a, b in zip(high, q["color"], strict=True))
        return jnp.where(closer & there, q["near"], nearest), carried, low, high

    zero = jnp.zeros((), nearness.dtype)
    return sum_over_taps(
        tap,
        lambda sums, p: (sums[1], (sums[2], sums[3])),
        neighbours=neighbours,
        centre=inside,
        offsets=_AROUND,
        sums=(zero - 1.0, (zero,) * 3, (zero + 1e30,) * 3, (zero - 1e30,) * 3),
        strip_rows=strip_rows,
    )


def _read_cubic(image: tuple[Array, ...], y: Array, x: Array) -> tuple[Array, ...]:
    """Catmull-Rom interpolation of planes at (x, y), in pixel indices; beyond the border the border's pixels count."""
    floor_y, floor_x = jnp.floor(y), jnp.floor(x)
    weights_y, weights_x = _catmull_rom(y - floor_y), _catmull_rom(x - floor_x)
    row, column = floor_y.astype(jnp.int32), floor_x.astype(jnp.int32)

    def add(total, offset):
        weight = weights_y[offset[0] + 1] * weights_x[offset[1] + 1]
        read = (read_at(plane, row + offset[0], column + offset[1])[0] for plane in image)
        return tuple(t + weight * v for t, v in zip(total, read, strict=True)), None

    return lax.scan(add, tuple(jnp.zeros_like(y) for _ in image), jnp.asarray(_CUBIC))[0]


def _catmull_rom(t: Array) -> Array:
    """Weights of the samples at -1, 0, 1, 2 for a position t in [0, 1): `[4, ...]`."""
    return jnp.stack(
        [
            t * (-0.5 + t * (1.0 - 0.5 * t)),
            1.0 + t * t * (-2.5 + 1.5 * t),
            t * (0.5 + t * (2.0 - 1.5 * t)),
            t * t * (-0.5 + 0.5 * t),
        ]
    )


def _clip_to_box(color, low, high):
    """Towards the box's centre until inside, all channels alike: no hue appears that is neither the past's nor the present's."""
    centre = tuple(0.5 * (a + b) for a, b in zip(low, high, strict=True))
    away = tuple(c - m for c, m in zip(color, centre, strict=True))
    reach = tuple(jnp.maximum(0.5 * (b - a), _LEAST_EXTENT) for a, b in zip(low, high, strict=True))
    ratios = [jnp.abs(d) / r for d, r in zip(away, reach, strict=True)]
    outside = jnp.maximum(jnp.maximum(jnp.maximum(ratios[0], ratios[1]), ratios[2]), 1.0)
    return tuple(m + d / outside for m, d in zip(centre, away, strict=True))


def _to_ycocg(color: tuple[Array, ...]) -> tuple[Array, Array, Array]:
    red, green, blue = color
    return 0.25 * red + 0.5 * green + 0.25 * blue, 0.5 * (red - blue), 0.5 * green - 0.25 * (red + blue)


def _to_rgb(color: tuple[Array, ...]) -> tuple[Array, Array, Array]:
    luma, orange, green = color
    return luma - green + orange, luma + green, luma - green - orange
