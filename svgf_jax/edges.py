"""Edge-stopping weights of Schied et al. 2017, section 4.4: depth (eq. 3), normal (eq. 4), luminance (eq. 5).

Letters: p the centre pixel, q a tap. Weights are handled as exponents: w_z w_n w_l is one exp of a sum.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from svgf_jax.sampling import inside_image, planes, shift
from svgf_jax.types import Frame

NEVER = -1e4  # exp of this is 0 in every float type


class Guides(NamedTuple):
    """What the geometry weights read at a pixel, as planes `[H, W]`.

    Attributes:
        depth: view-space z.
        normal: three planes.
        surface: 1 where there is a surface, else 0; 0 outside the image.
    """

    depth: Array
    normal: tuple[Array, ...]
    surface: Array


def guides_of(frame: Frame) -> Guides:
    """The guides of a sanitised frame."""
    surface = (frame.object_id != -1).astype(frame.depth.dtype)
    return Guides(depth=frame.depth, normal=planes(frame.normal), surface=surface)


def depth_gradient(depth: Array, object_id: Array) -> tuple[Array, Array]:
    """grad z per axis, (d/dx, d/dy), each `[H, W]` in depth per pixel.

    Of the two one-sided differences to neighbours with the same object id, the one of smaller magnitude; on equal magnitude and
    opposite sign their mean, so that flips commute; 0 where there is no such neighbour.
    """
    inside = inside_image(object_id)

    def along(dy: int, dx: int) -> Array:
        def side(sign: int) -> tuple[Array, Array]:
            same = (shift(object_id, sign * dy, sign * dx) == object_id) & (shift(inside, sign * dy, sign * dx) == 1)
            return sign * (shift(depth, sign * dy, sign * dx) - depth), same

        (ahead, has_ahead), (behind, has_behind) = side(1), side(-1)
        smaller = jnp.where(jnp.abs(ahead) < jnp.abs(behind), ahead, behind)
        both = jnp.where(jnp.abs(ahead) == jnp.abs(behind), 0.5 * (ahead + behind), smaller)
        one = jnp.where(has_ahead, ahead, jnp.where(has_behind, behind, jnp.zeros_like(depth)))
        return jnp.where(has_ahead & has_behind, both, one)

    return along(0, 1), along(1, 0)


def geometry_exponent(
    p: Guides,
    q: Guides,
    depth_change: Array,
    *,
    sigma_depth: Array | float,
    sigma_normal: Array | float,
    depth_epsilon: Array | float,
) -> Array:
    """log(w_z w_n) between two pixels with a surface.

    w_z = exp(-|z(p) - z(q)| / (sigma_depth |grad z . (p - q)| + depth_epsilon z(p))), equation 3; where the denominator vanishes, 1
    for equal depths, else 0. w_n = max(0, n(p) . n(q))**sigma_normal, equation 4.

    Args:
        p, q: guides of the centre and of the tap, planes of one shape.
        depth_change: grad z . (p - q), the depth change that the local slope predicts.
        sigma_depth, sigma_normal, depth_epsilon: scalars.

    Returns:
        The exponent, <= 0 up to rounding, of the planes' shape.
    """
    difference = jnp.abs(p.depth - q.depth)
    tolerance = sigma_depth * jnp.abs(depth_change) + depth_epsilon * p.depth
    tolerates = tolerance > 1e-12  # below, a quotient's derivative would overflow float32
    divisor = jnp.where(tolerates, tolerance, 1.0)
    z = jnp.where(tolerates, -difference, jnp.where(difference == 0.0, 0.0, NEVER))
    cosine = p.normal[0] * q.normal[0] + p.normal[1] * q.normal[1] + p.normal[2] * q.normal[2]
    faces = cosine > 1e-30  # log and its derivative stay finite
    n = jnp.where(
        faces,
        sigma_normal * jnp.log(jnp.where(faces, cosine, 1.0)),
        jnp.where(jnp.asarray(sigma_normal) > 0.0, NEVER, 0.0),
    )
    return (z + n * divisor) / divisor  # the quotient last: XLA:CPU computes what leads to it once for all signals


def luminance_scale(
    deviation_squared: Array, *, sigma_luminance: Array | float, luminance_epsilon: Array | float
) -> Array:
    """1 / (sigma_luminance sqrt(g(V)(p)) + luminance_epsilon): w_l = exp(-|l(p) - l(q)| * this), equation 5."""
    varies = deviation_squared > 0.0  # sqrt has no derivative at 0
    deviation = jnp.where(varies, jnp.sqrt(jnp.where(varies, deviation_squared, 1.0)), 0.0)
    return 1.0 / jnp.maximum(sigma_luminance * deviation + luminance_epsilon, 1e-15)


def edge_weight(
    p: Guides,
    q: Guides,
    depth_change: Array,
    luminance_p: Array,
    luminance_q: Array,
    variance_p: Array,
    *,
    sigma_depth: Array | float,
    sigma_normal: Array | float,
    sigma_luminance: Array | float,
    depth_epsilon: Array | float,
    luminance_epsilon: Array | float,
) -> Array:
    """w_z w_n w_l between pixels p and q; 0 where q has no surface. Planes of one shape; parameters as in `Params`.

    `depth_change` is grad z . (p - q); `variance_p` is g(V)(p), the prefiltered luminance variance at p.
    """
    geometry = geometry_exponent(
        p, q, depth_change, sigma_depth=sigma_depth, sigma_normal=sigma_normal, depth_epsilon=depth_epsilon
    )
    scale = luminance_scale(variance_p, sigma_luminance=sigma_luminance, luminance_epsilon=luminance_epsilon)
    return q.surface * jnp.exp(geometry - jnp.abs(luminance_p - luminance_q) * scale)
