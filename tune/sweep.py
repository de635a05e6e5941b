"""One pass over all shots at one point: the error there, and if wanted the triangle of [J r].

Memory is that of a frame: frames are read ahead, differentiated and folded away one after the other.
"""

from collections.abc import Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from svgf_jax import Params, SvgfError
from svgf_jax.threads import read_ahead
from tune.fold import combine, factor_blocks
from tune.free import GATES, Coordinates
from tune.residuals import Term
from tune.share import Share
from tune.shots import Example, Shot
from tune.tangents import Carry, FramePass, Given, Smooth, compile_pass, no_tangents

GATE_STEP = 0.25
"""Half the step, in free coordinates, across which the derivative in a threshold is taken."""


_NOTHING = 1e-14  # a mean squared error that is only rounding


class Problem(NamedTuple):
    """What is fitted to what.

    Attributes:
        coordinates: which numbers are free.
        y_start: `[n]`, where they start; the prior and the pilot image belong to it.
        terms: the residuals.
        shots: the sequences.
        pixel_weights: factor on each shot's error in the terms that look at pixels.
        tangent_batch: directions differentiated at a time.
        frame_pass: the compiled functions.
        share: which of the shots this process runs, and what tells it of the others; None = all.
    """

    coordinates: Coordinates
    y_start: np.ndarray
    terms: tuple[Term, ...]
    shots: tuple[Shot, ...]
    pixel_weights: np.ndarray
    tangent_batch: int
    frame_pass: FramePass
    share: Share | None = None


class Sweep(NamedTuple):
    """What a pass found.

    Attributes:
        loss: the sum of the squared residuals.
        shot_losses: `[shots]`, its parts.
        triangle: `[n + 1, n + 1]`, the factor of [J r]; None where no derivatives were wanted.
        scatter: `[n, n]`, the sum of g g' over blocks of pixels, g = J'r of the block; None likewise.
        rows: number of residuals.
        complete: False if the pass was given up because the loss had passed the bound.
    """

    loss: float
    shot_losses: np.ndarray
    triangle: np.ndarray | None
    scatter: np.ndarray | None
    rows: int
    complete: bool


def pose(
    coordinates: Coordinates,
    y_start: np.ndarray,
    terms: Sequence[Term],
    shots: Sequence[Shot],
    *,
    tangent_batch: int = 8,
    balance: bool = True,
    share: Share | None = None,
) -> Problem:
    """The problem, its terms scaled so that those that look at pixels are 1 together at the start.

    `balance`: each shot has the same part in that 1, so that a per cent gained is worth the same in all; otherwise each has what
    it brings.
    """
    if not shots or any(shot.length < 1 for shot in shots):
        raise SvgfError("got no frames to tune on; wanted at least one sequence of at least one frame")
    terms = tuple(term for term in terms if term.weight > 0)
    if not any(term.pixels for term in terms):
        raise SvgfError("got no residual that looks at pixels; wanted at least one with a weight above 0")
    frame_pass = compile_pass(coordinates.free, coordinates.config, terms)
    problem = Problem(
        coordinates, y_start, terms, tuple(shots), np.ones(len(shots)), max(1, tangent_batch), frame_pass, share
    )
    # The others are 0 at the start: the prior by definition.
    losses = sweep(problem, y_start, linear=False).shot_losses * len(shots)
    if not np.isfinite(losses).all() or (losses <= _NOTHING).any():
        bad = ", ".join(
            f"{s.name}: {v:g}" for s, v in zip(shots, losses, strict=True) if not (np.isfinite(v) and v > _NOTHING)
        )
        raise SvgfError(
            f"the error at the start is nothing to go by ({bad}); wanted references that differ from the filtered images"
        )
    return problem._replace(pixel_weights=1 / losses if balance else np.full(len(shots), 1 / losses.mean()))


def sweep(problem: Problem, y: np.ndarray, *, linear: bool, bound: float = np.inf) -> Sweep:
    """Run all frames at free coordinates `y`; `linear`: with derivatives. Given up where the loss passes `bound`."""
    n = len(problem.coordinates.free)
    losses = np.zeros(len(problem.shots))
    triangle, scatter, rows = np.zeros((n + 1, n + 1)), np.zeros((n, n)), 0
    complete = True
    with ThreadPoolExecutor(1, thread_name_prefix="svgf-fold") as folding:
        for i, shot in enumerate(problem.shots):
            if problem.share is not None and i % problem.share.size != problem.share.rank:
                continue
            before: Future[Any] | None = None
            with closing(frame_blocks(problem, i, shot, y, linear)) as blocks:
                for block in blocks:
                    if before is not None:
                        losses[i] += _take(before, triangle, scatter)
                        if losses.sum() > bound:
                            complete = False
                            break
                    before = folding.submit(_reduce, block)  # while the device runs the next frame
                    rows += block[0].size
            if before is not None and complete:
                losses[i] += _take(before, triangle, scatter)
            if not complete or losses.sum() > bound:
                complete = False
                break
    found = Sweep(
        float(losses.sum()), losses, triangle if linear else None, scatter if linear else None, rows, complete
    )
    return found if problem.share is None else problem.share.merge(found, bound)


def pull(problem: Problem, y: np.ndarray) -> np.ndarray:
    """The squares of the columns of J, `[n]`, that are from terms which look at coordinates alone."""
    squares = np.zeros(y.size)
    away = jnp.asarray(y - problem.y_start)
    nothing: Any = None
    for term in problem.terms:
        if not term.pixels:
            change = np.asarray(jax.jacfwd(partial(term.residual, nothing, nothing))(away)).reshape(-1, y.size)
            squares += term.weight * np.square(change).mean(axis=0)
    return squares


def _reduce(block: tuple[jax.Array, list[jax.Array]]) -> tuple[float, np.ndarray | None, np.ndarray | None]:
    """(loss, triangle of [J r], sum of g g' over blocks) of one frame, float64."""
    residual = np.asarray(block[0], np.float64)
    loss = float(residual @ residual)
    if not block[1]:
        return loss, None, None
    rows = np.concatenate([*map(np.asarray, block[1]), np.asarray(block[0])[None]]).T
    factors = factor_blocks(rows)
    gradients = np.einsum("bki,bk->bi", factors[:, :, :-1], factors[:, :, -1])
    return loss, combine(factors), gradients.T @ gradients


def _take(future: Future[Any], triangle: np.ndarray, scatter: np.ndarray) -> float:
    """Add a reduced frame to the running sums, in order, so that a repeated run gives the same bits."""
    loss, factor, outer = future.result()
    if factor is not None:
        triangle[:] = combine(np.stack([triangle, factor]))
        scatter += outer
    return loss


def frame_blocks(
    problem: Problem, index: int, shot: Shot, y: np.ndarray, linear: bool
) -> Generator[tuple[Any, list[Any]], None, None]:
    """(residual, columns) of each frame of a shot: `[m]`, and a list of `[k, m]` that together are `[n, m]`."""
    run, coordinates = problem.frame_pass, problem.coordinates
    n = len(coordinates.free)
    piloted = any(term.pilot for term in problem.terms)
    gates = [i for i, free in enumerate(coordinates.free) if free.name in GATES] if linear else []
    smooth_ones = [i for i in range(n) if i not in gates] if linear else []
    with closing(read_ahead(shot.read, range(shot.length), threads=1)) as examples:
        carry: Carry | None = None
        pilot: Any = None
        batches: list[tuple[Any, Smooth, list[int]]] = []
        sides: dict[int, tuple[Carry, Carry]] = {}
        for example in examples:
            given = _given(example, shot, problem, index)
            dtype = given.frame.radiance.dtype
            at = jnp.asarray(y, dtype)
            if carry is None:
                carry = run.start(given.frame)
                pilot = carry
                groups = _groups(smooth_ones, n, problem.tangent_batch)
                batches = [(jnp.asarray(d, dtype), no_tangents(carry, len(d)), used) for d, used in groups]
                sides = dict.fromkeys(gates, (carry, carry))
            if piloted:
                pilot, _ = run.plain(jnp.asarray(problem.y_start, dtype), pilot, given)
                given = given._replace(pilot=pilot.before.image)
            last = carry
            residual: Any = None
            columns: list[Any] = [None] * n
            for b, (directions, tangents, used) in enumerate(batches):
                carry, tangents, residual, change = run.linear(at, directions, last, tangents, given)
                batches[b] = (directions, tangents, used)
                for row, i in enumerate(used):
                    columns[i] = change[row : row + 1]
                if len(used) == n:  # all in one: spare the copies
                    columns = [change]
            if residual is None:
                carry, residual = run.plain(at, last, given)
            for i in gates:
                shift = jnp.asarray(GATE_STEP * np.eye(n)[i], dtype)
                up, above = run.plain(at + shift, sides[i][0], given)
                down, below = run.plain(at - shift, sides[i][1], given)
                sides[i] = (up, down)
                columns[i] = ((above - below) / jnp.asarray(2 * GATE_STEP, dtype))[None]
            yield residual, columns if linear else []


def _groups(smooth_ones: list[int], n: int, batch: int) -> list[tuple[np.ndarray, list[int]]]:
    """Unit directions `[k, n]`, all groups of one size (zeros in the last), so that one compiled function serves all."""
    if not smooth_ones:
        return []
    count = -(-len(smooth_ones) // batch)
    size = -(-len(smooth_ones) // count)
    groups = []
    for start in range(0, len(smooth_ones), size):
        used = smooth_ones[start : start + size]
        directions = np.zeros((size, n))
        directions[np.arange(len(used)), used] = 1
        groups.append((directions, used))
    return groups


def _given(example: Example, shot: Shot, problem: Problem, index: int) -> Given:
    """The frame with its target; pixels of the target that are not finite are not known."""
    frame = example.frame
    dtype = np.dtype(frame.radiance.dtype)
    share = 1 / (len(problem.shots) * shot.length)
    if example.target is None:
        target, known = np.zeros(frame.emission.shape, dtype), np.zeros(frame.depth.shape, dtype)
    else:
        finite = np.all(np.isfinite(example.target), axis=-1)
        target = np.where(np.isfinite(example.target), example.target, 0).astype(dtype)
        known = np.asarray(finite, dtype)
    return Given(
        frame=frame,
        target=target,
        known=known,
        pilot=target,
        pixel_scale=np.asarray(share * problem.pixel_weights[index], dtype),
        scale=np.asarray(share, dtype),
        start=Params(*(np.asarray(leaf, dtype) for leaf in problem.coordinates.start)),
        y_start=np.asarray(problem.y_start, dtype),
    )
