"""Statistics over the square window around each pixel."""

import jax
import jax.numpy as jnp
from jax import Array

from svgf_jax.color import largest_luminance
from svgf_jax.sampling import BY_WIDTH, Planes, square_offsets, sum_over_taps


def window_range(
    image: Planes,
    counts: Array,
    *,
    radius: int,
    sigma: Array | float,
    centre: bool = True,
    strip_rows: int | None = BY_WIDTH,
) -> tuple[Planes, Planes]:
    """mean - sigma * deviation and mean + sigma * deviation of each plane over (2 radius + 1)^2 pixels.

    Args:
        image: tree of planes `[H, W]`.
        counts: `[H, W]` bool, the pixels that count. Where the pixel itself does not, the range means nothing.
        radius: of the window, in pixels.
        sigma: in standard deviations (population), >= 0; traced.
        centre: whether the pixel itself counts too. If not, and no other does, both ends are its own value.
        strip_rows: how `sampling.sum_over_taps` blocks the work; None = the plain form.

    Returns:
        The lower and the upper end, trees as `image`; finite.
    """
    one = counts.astype(jax.tree.leaves(image)[0].dtype)
    limit = largest_luminance(one.dtype)
    image = jax.tree.map(lambda a: jnp.clip(a, -limit, limit), image)

    # Of the differences to the centre, one of which is 0: their variance is at least 1/n of their mean square, nothing cancels.
    def tap(sums, q, p, _):
        weight, totals = sums
        add = lambda total, far, own: (total[0] + q[1] * (far - own), total[1] + q[1] * (far - own) ** 2)  # noqa: E731
        return weight + q[1], [add(*three) for three in zip(totals, jax.tree.leaves(q[0]), p, strict=True)]

    def finish(sums, p):
        weight, totals = sums
        divisor = jnp.maximum(weight if centre else weight - 1.0, 1.0)  # the centre's difference is 0 in every sum

        def ends(total, own):
            mean = total[0] / divisor
            square = total[1] / divisor - mean * mean
            varies = square > 0.0  # sqrt has no derivative at 0
            spread = sigma * jnp.where(varies, jnp.sqrt(jnp.where(varies, square, 1.0)), 0.0)
            return own + mean - spread, own + mean + spread

        return [ends(total, own) for total, own in zip(totals, p, strict=True)]

    leaves, tree = jax.tree.flatten(image)
    zero = jnp.zeros((), one.dtype)
    ranges = sum_over_taps(
        tap,
        finish,
        neighbours=(leaves, one),
        centre=leaves,
        offsets=square_offsets(radius),
        sums=(zero, [(zero, zero) for _ in leaves]),
        strip_rows=strip_rows,
    )
    return tuple(jax.tree.unflatten(tree, [r[end] for r in ranges]) for end in (0, 1))  # type: ignore[return-value]
