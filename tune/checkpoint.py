"""A fit on the disk between two iterations, so that it can be resumed bit for bit: numbers only, nothing that is executed."""

import json
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from svgf_jax import SvgfError
from svgf_jax.atomic import replacing
from svgf_jax.npz import read_arrays
from tune.fitting import Iteration, Progress
from tune.solver import Descent, arrays, restored

FORMAT = 2


def save(path: Path, progress: Progress, identity: dict[str, Any]) -> None:
    """Write `progress` of the fit that `identity` (JSON) describes; under a temporary name, then renamed."""
    state = arrays(progress.descent)
    rows = progress.iterations
    header = {
        "format": FORMAT,
        "identity": identity,
        "start": progress.start,
        "ended": progress.ended,
        "endings": progress.endings,
        "states": len(state),
        "found": progress.found is not None,
    }
    content: dict[str, Any] = {
        "header": np.array(json.dumps(header)),
        "trials": np.array([[i.start, i.number, i.loss, i.accepted, i.damping] for i in rows]).reshape(len(rows), 5),
        "values": np.array([i.values for i in rows]),
        "losses": np.array([progress.loss, progress.best_loss]),
        "best_y": progress.best_y,
        "pixel_weights": progress.pixel_weights,
        **{f"state{i}": value for i, value in enumerate(state)},
    }
    if progress.found is not None:
        content |= {"triangle": progress.found[0], "scatter": progress.found[1], "rows": np.array(progress.found[2])}
    try:
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, **content)
    except OSError as error:
        raise SvgfError(f"{path}: can't write the checkpoint: {error}") from None


def load(path: Path, fresh: Descent, identity: dict[str, Any]) -> Progress:
    """The progress that `path` holds; `fresh` is a descent of the same solver and size, just begun.

    Raises SvgfError: not there, damaged, of another version, or of another fit than `identity`.
    """
    try:
        content = read_arrays(path)
        header = json.loads(str(content["header"]))
        if header["format"] != FORMAT:
            raise SvgfError(f"{path}: written by another version of svgf-tune; start anew without --resume")
        _compare(path, header["identity"], json.loads(json.dumps(identity)))
        _check(content, header, fresh)
        trials = zip(content["trials"], content["values"], strict=True)
        return Progress(
            start=header["start"],
            descent=restored(fresh, [content[f"state{i}"] for i in range(header["states"])]),
            iterations=tuple(
                Iteration(int(t[0]), int(t[1]), float(t[2]), bool(t[3]), values, float(t[4])) for t, values in trials
            ),
            loss=float(content["losses"][0]),
            best_y=content["best_y"],
            best_loss=float(content["losses"][1]),
            found=(content["triangle"], content["scatter"], int(content["rows"])) if header["found"] else None,
            ended=header["ended"],
            pixel_weights=content["pixel_weights"],
            endings=tuple(header["endings"]),
        )
    except FileNotFoundError:
        raise SvgfError(f"{path}: no checkpoint to resume from; start without --resume") from None
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError, MemoryError) as error:
        raise SvgfError(f"{path}: damaged ({error}); delete it and start without --resume") from None


def _check(content: dict[str, np.ndarray], header: dict[str, Any], fresh: Descent) -> None:
    """ValueError where the arrays are not what `save` writes of a fit of this size."""
    n, rows, state = fresh.y.size, len(content["trials"]), arrays(fresh)
    wanted: dict[str, tuple[str, tuple[int, ...]]] = {
        "trials": ("float64", (rows, 5)),
        "values": ("float64", (rows, n)),
        "losses": ("float64", (2,)),
        "best_y": ("float64", (n,)),
        "pixel_weights": ("float64", (content["pixel_weights"].size,)),
        **{f"state{i}": (str(value.dtype), value.shape) for i, value in enumerate(state)},
    }
    if header["found"]:
        wanted |= {"triangle": ("float64", (n + 1, n + 1)), "scatter": ("float64", (n, n)), "rows": ("int64", ())}
    if content.keys() != {"header", *wanted} or header["states"] != len(state):
        raise ValueError(f"it holds {', '.join(sorted(content))}")
    for name, (dtype, shape) in wanted.items():
        array = content[name]
        if array.dtype != dtype or array.shape != shape:
            raise ValueError(f"{name} is {array.dtype} {array.shape}; wanted {dtype} {shape}")
        known = array[:, :4] if name == "trials" else array[:0] if name == "losses" else array
        if not np.isfinite(known).all():  # a loss that is not known yet may be infinite, and the damping
            raise ValueError(f"{name} is not finite")
    for name, least in (("losses", 0), ("trials", 0), ("pixel_weights", 0), ("rows", 1)):
        if name in wanted and not (content[name] >= least).all():  # nan is not
            raise ValueError(f"{name} has numbers below {least}, or that are none")
    if bool(header["found"]) != np.isfinite(content["losses"][1]):
        raise ValueError(f"a best loss of {content['losses'][1]}")
    start, ended, endings = header["start"], header["ended"], header["endings"]
    if type(start) is not int or start != len(endings) or not all(isinstance(e, str) for e in [ended or "", *endings]):
        raise ValueError(f"start {start!r} with the endings {endings!r}")


def _compare(path: Path, stored: dict[str, Any], wanted: dict[str, Any]) -> None:
    """SvgfError naming the first difference."""
    for key in sorted(stored.keys() | wanted.keys()):
        then, now = stored.get(key), wanted.get(key)
        if isinstance(then, list) and isinstance(now, list):
            then, now = next(((a, b) for a, b in zip_longest(then, now) if a != b), (None, None))
        if then != now:
            raise SvgfError(
                f"{path}: belongs to another fit: its {key} was {then!r}, now it is {now!r}. "
                "Give the same options and files, or start anew without --resume."
            )
