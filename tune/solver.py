"""optimistix's least-squares solvers, stepped by hand.

Each step is handed the triangle of [J r] at the point it asks about, as a residual of n + 1 numbers with its Jacobian: its norm,
J'J and J'r are those of all the pixels', and nothing else enters a step. So frames can stream from the disk, iterates be shown,
and a run be resumed. Everything here is float64, whatever the frames are.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jax import lax

from svgf_jax import SvgfError

SOLVERS = ("lm", "dogleg", "gauss-newton")
SCALE = 1e3
"""The loss that the solver is given when ours is 1: its first damping of 1 then is a mild one."""


class Point(NamedTuple):
    """The folded residual `[n + 1]` at a point and its Jacobian `[n + 1, n]`."""

    residual: Any
    jacobian: Any


class Descent(NamedTuple):
    """A solver between two steps.

    Attributes:
        solver: optimistix's.
        y: `[n]`, the point accepted last.
        state: optimistix's.
    """

    solver: Any
    y: np.ndarray
    state: Any

    @property
    def trial(self) -> np.ndarray:
        """`[n]`, the point that the next step wants to know about."""
        return np.asarray(self.state.y_eval, np.float64)

    @property
    def converged(self) -> bool:
        """Whether the last step changed neither the point nor the residual by more than the tolerances."""
        return bool(self.state.terminate)

    @property
    def damping(self) -> float:
        """1 / the trust region's step size: Levenberg and Marquardt's lambda."""
        size = float(getattr(self.state.search_state, "step_size", 1.0))
        return 1 / size if size > 0 else float("inf")


def make_solver(name: str, *, rtol: float = 1e-2, atol: float = 1e-2) -> Any:
    """The solver called `lm` (Levenberg-Marquardt), `dogleg` or `gauss-newton`.

    The latter two solve with an SVD: a parameter that the data does not determine then stays where it is.
    """
    if name not in SOLVERS:
        raise SvgfError(f"no solver {name!r}; there are {', '.join(SOLVERS)}")
    if name == "lm":
        return optx.LevenbergMarquardt(rtol=rtol, atol=atol)
    kind = optx.Dogleg if name == "dogleg" else optx.GaussNewton
    return kind(rtol=rtol, atol=atol, linear_solver=lx.SVD())


def begin(solver: Any, y: np.ndarray) -> Descent:
    """A descent from `y`."""
    with jax.enable_x64(True):
        point = Point(np.zeros(y.size + 1), np.zeros((y.size + 1, y.size)))
        start, argument = jnp.asarray(y, jnp.float64), jax.tree.map(jnp.asarray, point)
        structure = jax.ShapeDtypeStruct((y.size + 1,), jnp.float64)
        state = solver.init(_folded, start, argument, {}, structure, None, frozenset())
    return Descent(solver, np.array(y, np.float64), state)


def advance(descent: Descent, triangle: np.ndarray) -> tuple[Descent, bool]:
    """Tell the solver of its trial point the triangle `[n + 1, n + 1]` of [J r]: (descent, whether it took the point)."""
    n = descent.y.size
    factor = np.sqrt(SCALE) * np.asarray(triangle)
    with jax.enable_x64(True):
        point = Point(jnp.asarray(factor[:, n]), jnp.asarray(factor[:, :n]))
        y, state, _ = _step(descent.solver, jnp.asarray(descent.y), point, descent.state)
        accepted = int(state.num_steps_since_acceptance) == 0
    return Descent(descent.solver, np.asarray(y), state), accepted


def rejected(loss: float, n: int) -> np.ndarray:
    """A triangle for a trial point of which only the loss is known, for it will be rejected."""
    triangle = np.zeros((n + 1, n + 1))
    triangle[n, n] = np.sqrt(loss)
    return triangle


def arrays(descent: Descent) -> list[np.ndarray]:
    """All numbers of a descent, in a fixed order, to be stored."""
    return [descent.y, *(np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(descent.state, eqx.is_array)))]


def restored(descent: Descent, stored: list[np.ndarray]) -> Descent:
    """`descent`, freshly begun, with the numbers that `arrays` gave of another of the same solver and size."""
    dynamic, static = eqx.partition(descent.state, eqx.is_array)
    leaves, structure = jax.tree.flatten(dynamic)
    with jax.enable_x64(True):
        fresh = [jnp.asarray(new, old.dtype).reshape(old.shape) for new, old in zip(stored[1:], leaves, strict=True)]
    return Descent(descent.solver, stored[0], eqx.combine(jax.tree.unflatten(structure, fresh), static))


def _folded(y: Any, point: Point) -> tuple[Any, None]:
    """The folded residual with its derivative; `y` is the point it belongs to, so nothing is added."""
    return point.residual + point.jacobian @ (y - lax.stop_gradient(y)), None


@eqx.filter_jit
def _step(solver: Any, y: Any, point: Point, state: Any) -> tuple[Any, Any, Any]:
    return solver.step(_folded, y, point, {}, state, frozenset())
