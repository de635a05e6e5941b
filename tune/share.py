"""A fit by several processes: each runs its own sequences, and the small triangles of all are folded once more by each of them.

Nothing else is exchanged, so every process takes the same step. Sums and triangles are float64: the fit is that of one process to
rounding.
"""

import io
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from svgf_jax.processes import Process, gather
from tune.fold import combine


class Share(NamedTuple):
    """The sequences of one of several processes: those at `rank`, `rank + size`, ...

    Attributes:
        rank, size: which process, of how many.
        merge: (what this process found as a `Sweep`, the bound) -> what all found.
    """

    rank: int
    size: int
    merge: Callable[[Any, float], Any]


def share_with(me: Process) -> Share:
    """This process's share of a fit in which all take part."""
    passes = itertools.count()
    return Share(
        me.rank,
        me.size,
        lambda found, bound: _merged(found, gather(me, f"pass {next(passes)}", _packed(found)), bound),
    )


def _packed(found: Any) -> bytes:
    arrays: Any = {name: np.asarray(value) for name, value in found._asdict().items() if value is not None}
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def _merged(found: Any, packed: list[bytes], bound: float) -> Any:
    """All parts as one `Sweep`; one that passes the bound together counts as given up."""
    parts = [np.load(io.BytesIO(one), allow_pickle=False) for one in packed]
    losses = np.sum([part["shot_losses"] for part in parts], axis=0)
    loss = float(losses.sum())
    return found._replace(
        loss=loss,
        shot_losses=losses,
        triangle=None if found.triangle is None else combine(np.stack([part["triangle"] for part in parts])),
        scatter=None if found.scatter is None else np.sum([part["scatter"] for part in parts], axis=0),
        rows=sum(int(part["rows"]) for part in parts),
        complete=all(bool(part["complete"]) for part in parts) and not loss > bound,
    )
