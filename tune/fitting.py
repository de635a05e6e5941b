"""Fit the filter's numbers to shots: least squares over all their pixels, in the memory of one frame."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from svgf_jax import Config, Params, SvgfError
from tune import solver as solvers
from tune.free import TUNED_BY_DEFAULT, Coordinates, choose, natural, params_at, to_free
from tune.knowledge import Knowledge, learn
from tune.residuals import REFERENCE, Term
from tune.share import Share
from tune.shots import Shot
from tune.sweep import Problem, Sweep, pose, pull, sweep

_INTERRUPTED = "interrupted; this is the best so far"
_DIVERGED = "the solver has lost its way; this is the best so far"
PATIENCE = 6  # trial points rejected in a row: the loss has nothing left that its derivatives know of


class Iteration(NamedTuple):
    """One trial point.

    Attributes:
        start: which of the starts it belongs to.
        number: counted from 0, the starting point.
        loss: the error there, 1 at the given start; a lower bound where the trial was given up.
        accepted: whether the solver went there.
        values: `[n]`, the free numbers in their own units.
        damping: the solver's, after this trial.
    """

    start: int
    number: int
    loss: float
    accepted: bool
    values: np.ndarray
    damping: float


class Progress(NamedTuple):
    """A fit between two iterations: all that is needed to go on, bit for bit.

    Attributes:
        start: which of the starts is under way.
        descent: of that start.
        iterations: of all starts so far.
        loss: at `descent.y`.
        best_y, best_loss: of all starts so far.
        found: triangle, scatter and number of residuals at `best_y`.
        ended: how this start ended, None while it goes on.
        endings: how those before it ended.
        pixel_weights: of `Problem`.
    """

    start: int
    descent: solvers.Descent
    iterations: tuple[Iteration, ...]
    loss: float
    best_y: np.ndarray
    best_loss: float
    found: tuple[np.ndarray, np.ndarray, int] | None
    ended: str | None
    pixel_weights: np.ndarray
    endings: tuple[str, ...] = ()


class Fit(NamedTuple):
    """What a fit found.

    Attributes:
        params, config: the best point, ready for `svgf_jax`.
        coordinates: which numbers were free, and where they started.
        y: `[n]`, the best point in free coordinates.
        loss: there; 1 at the start.
        iterations: every trial point.
        converged: whether the best start's solver came to rest by itself.
        result: how it ended, and what to try next, as a sentence.
        knowledge: standard errors, correlations and what is undetermined; None if interrupted before anything was known.
        notes: what the user should know.
    """

    params: Params
    config: Config
    coordinates: Coordinates
    y: np.ndarray
    loss: float
    iterations: tuple[Iteration, ...]
    converged: bool
    result: str
    knowledge: Knowledge | None
    notes: tuple[str, ...]

    @property
    def diverged(self) -> bool:
        """Whether the best start's solver came to ask about a point that is no number."""
        return self.result.startswith(_DIVERGED)


def fit(
    params: Params,
    config: Config,
    shots: Sequence[Shot],
    residuals: Sequence[Term] = REFERENCE,
    *,
    names: Iterable[str] = TUNED_BY_DEFAULT,
    per_level: bool | Iterable[str] = False,
    freeze: Iterable[str] = (),
    solver: str | Any = "lm",
    max_steps: int = 30,
    least_gain: float | None = None,
    starts: int = 1,
    seed: int = 0,
    tangent_batch: int = 8,
    balance: bool = True,
    share: Share | None = None,
    on_iteration: Callable[[Iteration], None] = lambda iteration: None,
    save: Callable[[Progress], None] = lambda progress: None,
    resume: Callable[[solvers.Descent], Progress] | None = None,
) -> Fit:
    """Find the numbers of the filter that make its images most like the shots' targets.

    Args:
        params, config: where to start.
        shots: sequences with targets; see `tune.shots`.
        residuals: what is minimised; see `tune.residuals`.
        names, per_level, freeze: which numbers are free; see `tune.free.choose`.
        solver: `lm`, `dogleg`, `gauss-newton`, or an optimistix least-squares solver of one's own.
        max_steps: trial points a start, at most.
        least_gain: an accepted step that lowers the loss by less than this part of it is the last; None = 1e-3, and 1e-5 for noisy
            targets, whose noise is most of the loss and stays.
        starts: the first is `params`; each other is some way off, in all free coordinates, drawn from `seed`.
        tangent_batch: derivatives taken at a time: fewer need less memory and more time, for the same result.
        balance: each shot counts alike, whatever its error at the start.
        share: this process's part, where several fit together; see `tune.share`.
        on_iteration: hears of each trial point.
        save: hears of each state in which the fit could go on later; `resume`: given a fresh descent, such a state.

    A KeyboardInterrupt ends the fit with the best so far, once there is one.

    Raises:
        SvgfError: nothing to tune, frames that cannot be read, an error at the start that is not a number. A solver that
            diverges later is no exception: `Fit.diverged` says so, and the best point is kept.
    """
    coordinates = choose(params, config, names=names, per_level=per_level, freeze=freeze)
    if least_gain is None:
        least_gain = 1e-5 if any(term.pilot for term in residuals) else 1e-3
    y_start = to_free(coordinates.start, coordinates)
    chosen = solvers.make_solver(solver) if isinstance(solver, str) else solver
    fresh = solvers.begin(chosen, y_start)
    progress = None if resume is None else resume(fresh)  # refused before work begins
    problem = pose(coordinates, y_start, residuals, shots, tangent_batch=tangent_batch, balance=balance, share=share)
    if progress is None:
        progress = Progress(0, fresh, (), np.inf, y_start, np.inf, None, None, problem.pixel_weights)
    problem = problem._replace(pixel_weights=progress.pixel_weights)
    try:
        while progress.start < max(starts, 1):
            if progress.ended is None:
                progress = _iterate(problem, progress, max_steps=max_steps, least_gain=least_gain)
                on_iteration(progress.iterations[-1])
            if progress.ended is not None:
                y_next = _scattered(y_start, seed, progress.start + 1)
                progress = progress._replace(
                    start=progress.start + 1,
                    descent=solvers.begin(chosen, y_next),
                    loss=np.inf,
                    ended=None,
                    endings=(*progress.endings, progress.ended),
                )
            save(progress)
    except KeyboardInterrupt:
        progress = progress._replace(endings=(_INTERRUPTED,) * (progress.start + 1))
    return _conclude(problem, progress, shots)


def _iterate(problem: Problem, progress: Progress, *, max_steps: int, least_gain: float) -> Progress:
    """Ask about one trial point."""
    descent, n = progress.descent, len(problem.coordinates.free)
    mine = [iteration for iteration in progress.iterations if iteration.start == progress.start]
    y = descent.trial
    found, doubtful = None, bool(mine) and not mine[-1].accepted
    # Of a point that will be rejected only that is asked, so it may be given up on the way; and after one rejection, the
    # next point is first asked for its loss alone, which costs less than its derivatives.
    bound = progress.loss if mine and hasattr(descent.state.search_state, "step_size") else np.inf
    finite = bool(np.isfinite(y).all())
    result = _failed(n) if not finite else sweep(problem, y, linear=not doubtful, bound=bound)
    if doubtful and result.complete and np.isfinite(result.loss) and finite:
        result = sweep(problem, y, linear=True, bound=bound)
    if not np.isfinite(result.loss):
        result = _failed(n)
    triangle = result.triangle if result.complete else None
    descent, accepted = solvers.advance(descent, solvers.rejected(result.loss, n) if triangle is None else triangle)
    loss = result.loss if accepted else progress.loss
    iteration = Iteration(
        progress.start, len(mine), result.loss, accepted, natural(y, problem.coordinates), descent.damping
    )
    ended = _ending(iteration, descent, progress.loss, mine, max_steps=max_steps, least_gain=least_gain)
    best_y, best_loss, found = progress.best_y, progress.best_loss, progress.found
    if triangle is not None and result.scatter is not None and result.loss < best_loss:
        best_y, best_loss, found = y, result.loss, (triangle, result.scatter, result.rows)
    iterations = (*progress.iterations, iteration)
    return progress._replace(
        descent=descent, iterations=iterations, loss=loss, best_y=best_y, best_loss=best_loss, found=found, ended=ended
    )


def _ending(
    iteration: Iteration,
    descent: solvers.Descent,
    loss_before: float,
    mine: list[Iteration],
    *,
    max_steps: int,
    least_gain: float,
) -> str | None:
    """Why the descent is over, or None. What begins with "converged" is a success."""
    gain = loss_before - iteration.loss
    if not mine and not iteration.accepted:
        return "the loss at the start is not a number; check the frames and the start"
    if descent.converged:
        return "converged: the last step changed nothing that counts"
    if iteration.accepted and mine and 0 <= gain < least_gain * loss_before:
        return f"converged: the last step lowered the loss by less than {least_gain:g} of it"
    rejected = [*mine, iteration][-PATIENCE:]
    if len(rejected) == PATIENCE and not any(i.accepted for i in rejected):
        return f"converged: no step lowers the loss any more ({PATIENCE} tried, ever shorter)"
    if not np.isfinite(descent.trial).all():
        return f"{_DIVERGED}. Try --solver lm, another start, or fewer parameters (--freeze)"
    if len(mine) + 1 >= max_steps:
        return f"not converged in {max_steps} trial points; raise --max-steps, or go on from this result (--params)"
    return None


def _failed(n: int) -> Sweep:
    """What is told of a point at which nothing can be computed: the solver then comes nearer."""
    return Sweep(1e12, np.zeros(0), None, None, 0, False)


def _scattered(y_start: np.ndarray, seed: int, start: int) -> np.ndarray:
    return y_start + np.random.default_rng([seed, start]).normal(0, 0.7, y_start.size)


def _conclude(problem: Problem, progress: Progress, shots: Sequence[Shot]) -> Fit:
    coordinates, endings = problem.coordinates, progress.endings
    if progress.found is None:
        if _INTERRUPTED in endings:
            raise KeyboardInterrupt
        raise SvgfError(f"the fit came to nothing: {endings[0]}")
    accepted = [i for i in progress.iterations if i.accepted and i.loss == progress.best_loss]
    best_start = accepted[0].start if accepted else 0
    result = endings[best_start]
    triangle, scatter, rows = progress.found
    knowledge = learn(triangle, scatter, rows, progress.best_y, coordinates, pull=pull(problem, progress.best_y))
    notes = [*coordinates.notes, *(note for shot in shots for note in shot.notes)]
    return Fit(
        params=params_at(progress.best_y, coordinates),
        config=coordinates.config,
        coordinates=coordinates,
        y=progress.best_y,
        loss=progress.best_loss,
        iterations=progress.iterations,
        converged=result.startswith("converged"),
        result=result,
        knowledge=knowledge,
        notes=tuple(notes),
    )
