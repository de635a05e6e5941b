"""One frame of a pass: the filter's step with the derivatives of all it hands on, in forward mode.

The state between frames is the history and the last image, and for each direction in parameter space their derivatives. So a
pass over a sequence of any length holds one frame's state, and no frame is ever differentiated twice. Masks, reprojected
positions and other integers are constants of differentiation.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from svgf_jax import Config, Frame, History, Params, init, step
from tune.free import Free, from_free
from tune.residuals import Seen, Term


class Carry(NamedTuple):
    """Between two frames: the history, and the frame before as the residuals see it."""

    history: History
    before: Seen


class Smooth(NamedTuple):
    """What of a `Carry` has derivatives; with a leading k: the derivatives in k directions."""

    illumination: Array
    moments: Array
    history_length: Array
    image: Array


class Given(NamedTuple):
    """What a frame brings along.

    Attributes:
        frame: NumPy or JAX arrays.
        target, known: as in `Seen`.
        pilot: as in `Seen`.
        pixel_scale: factor on the squares of the terms that look at pixels.
        scale: on those of the others.
        start: what is not free keeps these values.
        y_start: `[n]`, where the free coordinates started.
    """

    frame: Frame
    target: Any
    known: Any
    pilot: Any
    pixel_scale: Any
    scale: Any
    start: Params
    y_start: Any


class FramePass(NamedTuple):
    """The compiled functions of a fit, for any number of frames of one size.

    Attributes:
        start: `(frame) -> Carry` before the first frame.
        plain: `(y, carry, given) -> (carry, residual)`: no derivatives.
        linear: `(y, directions [k, n], carry, smooth, given) -> (carry, smooth, residual, derivatives)`, the residual `[m]` and its
            derivatives `[k, m]` in the directions; k of `smooth` and of `directions` agree.
    """

    start: Callable[[Frame], Carry]
    plain: Callable[[Array, Carry, Given], tuple[Carry, Array]]
    linear: Callable[[Array, Array, Carry, Smooth, Given], tuple[Carry, Smooth, Array, Array]]


@cache
def compile_pass(free: tuple[Free, ...], config: Config, terms: tuple[Term, ...]) -> FramePass:
    """The functions that run one frame at free coordinates `y` `[n]`, residuals in the order of `terms`; compiled once."""
    one = partial(_one_frame, free=free, config=config, terms=terms)
    return FramePass(
        start=jax.jit(partial(_start, config)),
        plain=jax.jit(partial(_plain, one)),
        linear=jax.jit(partial(_linear, one)),
    )


def no_tangents(carry: Carry, directions: int) -> Smooth:
    """Derivatives of the state before the first frame: none."""
    return jax.tree.map(lambda a: jnp.zeros((directions, *a.shape), a.dtype), _smooth(carry))


def _start(config: Config, frame: Frame) -> Carry:
    nothing = jnp.zeros_like(frame.emission)
    return Carry(init(frame, config=config), Seen(nothing, nothing, jnp.zeros_like(frame.depth), nothing))


def _smooth(carry: Carry) -> Smooth:
    history = carry.history
    return Smooth(history.illumination, history.moments, history.history_length, carry.before.image)


def _one_frame(
    y: Array,
    smooth: Smooth,
    carry: Carry,
    given: Given,
    *,
    free: tuple[Free, ...],
    config: Config,
    terms: tuple[Term, ...],
) -> tuple[tuple[Smooth, Array], Carry]:
    """((what has derivatives, the residual), everything handed on)."""
    history = carry.history._replace(
        illumination=smooth.illumination, moments=smooth.moments, history_length=smooth.history_length
    )
    before = carry.before._replace(image=smooth.image)
    history, output = step(history, given.frame, params=from_free(y, given.start, free), config=config)
    now = Seen(output.image, given.target, given.known, given.pilot)
    away = y - given.y_start
    pixels, others = [], []
    for term in terms:
        residual = term.residual(now, before, away)
        scale = given.pixel_scale if term.pixels else given.scale
        residual = residual * jnp.sqrt(scale * jnp.asarray(term.weight / residual.size, y.dtype))
        (pixels if residual.ndim == 3 else others).append(residual)
    # Side by side, so that neighbouring rows of [J r] belong to neighbouring pixels.
    parts = [jnp.concatenate(pixels, axis=-1).reshape(-1)] if pixels else []
    flat = jnp.concatenate([*parts, *(other.reshape(-1) for other in others)])
    carry = Carry(history, now)
    return (_smooth(carry), flat), carry


def _plain(one, y: Array, carry: Carry, given: Given) -> tuple[Carry, Array]:
    (_, residual), carry = one(y, _smooth(carry), carry, given)
    return carry, residual


def _linear(
    one, y: Array, directions: Array, carry: Carry, smooth: Smooth, given: Given
) -> tuple[Carry, Smooth, Array, Array]:
    def along(direction: Array, tangent: Smooth):
        run = lambda y, smooth: one(y, smooth, carry, given)  # noqa: E731
        (_, residual), (handed_on, change), after = jax.jvp(
            run, (y, _smooth(carry)), (direction, tangent), has_aux=True
        )
        return after, handed_on, residual, change

    # None: what does not depend on the direction is computed once, not once a direction.
    return jax.vmap(along, out_axes=(None, 0, None, 0))(directions, smooth)
