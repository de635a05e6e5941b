"""What a fit says: a line or a live table while it runs, then before and after, what it knows, and the files."""

import importlib.metadata
import sys
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from svgf_jax import Config, Params, __version__, save_params
from svgf_jax.commands import terminal
from svgf_jax.metrics import Scores
from tune.evaluate import Measured, measure, worse
from tune.explore import Profile, profile, sensitivity, write_maps
from tune.fitting import Fit, Iteration
from tune.free import natural, to_free
from tune.residuals import Term
from tune.shots import Shot

WORSE = 0.05  # dB: less is measuring noise

_SHOWN = {
    "psnr": ("PSNR dB", "{:.2f}"),
    "relmse": ("relMSE", "{:.4g}"),
    "temporal": ("temporal", "{:.5f}"),
    "flip": ("FLIP", "{:.4f}"),
}


class Comparison(NamedTuple):
    """A shot before and after: `role` is "tuned" or "validation"."""

    role: str
    shot: Shot
    before: Measured
    after: Measured


@contextmanager
def live(shots: int, frames: int, labels: Sequence[str]) -> Generator[Callable[[Iteration], None]]:
    """A function to call with each trial point of `labels`: a growing table on a terminal, a line each elsewhere."""
    terminal.tell(
        f"tuning on {shots} {'sequence' if shots == 1 else 'sequences'}, {frames} frames; the first trial compiles"
    )
    began = time.monotonic()
    with _table(began, labels) if sys.stderr.isatty() else _lines(began, labels) as on_iteration:
        yield on_iteration


@contextmanager
def _lines(began: float, labels: Sequence[str]) -> Generator[Callable[[Iteration], None]]:
    def on_iteration(iteration: Iteration) -> None:
        number, loss, *rest = _cells(iteration, began)
        terminal.tell("  ".join((number, f"loss {loss}", *rest)))

    terminal.tell(f"start.trial  loss  {' '.join(labels)}  time")
    yield on_iteration


@contextmanager
def _table(began: float, labels: Sequence[str]) -> Generator[Callable[[Iteration], None]]:
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.live import Live
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE)
    wide = len(labels) > 6  # one column each would not fit
    for name in ("trial", "loss", "", *((" ".join(labels),) if wide else labels), "time"):
        table.add_column(Text(name), no_wrap=not wide or name != " ".join(labels))
    with Live(table, console=Console(stderr=True), auto_refresh=False) as view:

        def on_iteration(iteration: Iteration) -> None:
            number, loss, verdict, values, seconds = _cells(iteration, began)
            between = [values] if wide else values.split()
            table.add_row(*map(Text, (number, loss, verdict, *between, seconds)))
            view.refresh()

        yield on_iteration


def _cells(iteration: Iteration, began: float) -> tuple[str, ...]:
    verdict = "accepted" if iteration.accepted else "rejected"
    values = " ".join(f"{value:.4g}" for value in iteration.values)
    seconds = f"{time.monotonic() - began:.0f} s"
    return (f"{iteration.start}.{iteration.number}", f"{iteration.loss:.5f}", verdict, values, seconds)


def conclude(
    found: Fit,
    start: Params,
    config: Config,
    *,
    measured: Sequence[Shot],
    validated: Sequence[Shot],
    fitted: Sequence[Shot],
    terms: Sequence[Term],
    out: Path,
    record: dict[str, Any],
    report: Path | None,
    maps: Path | None,
    profiles: bool,
    flip: bool,
    json: bool,
) -> int:
    """Write the result, measure it, tell all that is known. 1 if a validation sequence got worse, else 0."""
    assert found.knowledge is not None
    record = record | {
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "result": found.result,
        "loss": float(found.loss),
        "tuned": list(found.coordinates.labels),
    }
    save_params(
        out, found.params, found.config, provenance=record
    )  # measuring may be interrupted: this may not be lost
    terminal.tell(f"parameters -> {out}")
    terminal.warn(found.coordinates.notes)
    terminal.tell(f"{found.result}; loss 1 -> {found.loss:.4f} after {len(found.iterations)} trial points")
    _tell_parameters(found)
    compared: list[Comparison] = []
    for role, shots in (("tuned", measured), ("validation", validated)):
        for shot in shots:
            before = measure(shot, start, config, with_flip=flip)
            compared.append(Comparison(role, shot, before, measure(shot, found.params, found.config, with_flip=flip)))
    _tell_scores(compared)
    failures = [w for c in compared if c.role == "validation" and (w := worse(c.before, c.after, tolerance=WORSE))]
    record["scores"] = {
        f"{c.role}: {c.before.name}": {"before": _numbers(c.before.mean), "after": _numbers(c.after.mean)}
        for c in compared
    }
    save_params(out, found.params, found.config, provenance=record)
    curves: tuple[Profile, ...] = ()
    if profiles:
        curves = profile(found, fitted, terms)
    pictures = None
    if maps is not None or report is not None:
        pictures = sensitivity(found, fitted[0], terms)
    if maps is not None and pictures is not None:
        terminal.tell(f"maps: {write_maps(maps, found, pictures)}")
    if report is not None and pictures is not None:
        from tune.report import write_report

        write_report(report, found, start, config, compared, curves, pictures, failures, shot=fitted[0])
        terminal.tell(f"report: {report}")
    if json:
        terminal.print_json(summary(found, compared, curves) | {"out": out, "worse": failures})
    for failure in failures:
        terminal.tell(
            f"VALIDATION GOT WORSE: {failure}. Tune on more sequences, fewer numbers, or with a larger --prior."
        )
    return 1 if failures else 0


def versions() -> dict[str, str]:
    """What a fit was computed by."""
    return {name: importlib.metadata.version(name) for name in ("jax", "optimistix")} | {"svgf_jax": __version__}


def summary(found: Fit, compared: Sequence[Comparison], curves: Sequence[Profile] = ()) -> dict[str, Any]:
    """All that a fit found, as plain data."""
    knowledge = found.knowledge
    assert knowledge is not None
    start = natural(to_free(found.coordinates.start, found.coordinates), found.coordinates)
    values = natural(found.y, found.coordinates)
    return {
        "result": found.result,
        "converged": found.converged,
        "loss": found.loss,
        "trials": [i._asdict() | {"values": i.values.tolist()} for i in found.iterations],
        "parameters": {
            label: {
                "start": start[i],
                "value": values[i],
                "standard_error": float(knowledge.standard_errors[i]),
                "leverage": float(knowledge.leverage[i]),
            }
            for i, label in enumerate(found.coordinates.labels)
        },
        "correlations": knowledge.correlations.tolist(),
        "undetermined": knowledge.undetermined,
        "entangled": knowledge.entangled,
        "profiles": [p._asdict() | {"values": p.values.tolist(), "losses": p.losses.tolist()} for p in curves],
        "scores": [
            {"sequence": c.before.name, "role": c.role, "before": c.before.mean, "after": c.after.mean}
            for c in compared
        ],
        "notes": found.notes,
    }


def _tell_parameters(found: Fit) -> None:
    knowledge = found.knowledge
    assert knowledge is not None
    start = natural(to_free(found.coordinates.start, found.coordinates), found.coordinates)
    values = natural(found.y, found.coordinates)
    rows = []
    for i, label in enumerate(found.coordinates.labels):
        error = knowledge.standard_errors[i]
        known = f"± {error:.2g}" if np.isfinite(error) else "undetermined"
        rows.append((label, f"{start[i]:.4g}", f"{values[i]:.4g}", known, f"{knowledge.leverage[i]:.2g}"))
    _print(("parameter", "before", "after", "", "leverage"), rows)
    if knowledge.undetermined:
        terminal.tell(
            f"near these values the error hardly depends on {', '.join(knowledge.undetermined)}: the data does not determine it"
        )
    for one, other in knowledge.entangled:
        terminal.tell(f"{one} and {other} make up for each other; only together are they determined")


def _tell_scores(compared: Sequence[Comparison]) -> None:
    if not compared:
        terminal.tell("no references, so nothing was measured")
        return
    names = [n for n in _SHOWN if not all(np.isnan(getattr(c.after.mean, n)) for c in compared)]
    rows = []
    for c in compared:
        pairs = ((getattr(c.before.mean, n), getattr(c.after.mean, n), _SHOWN[n][1]) for n in names)
        rows.append((c.before.name, c.role, *(f"{form.format(b)} -> {form.format(a)}" for b, a, form in pairs)))
    _print(("sequence", "", *(_SHOWN[n][0] for n in names)), rows)


def _print(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE)
    for i, head in enumerate(heads):
        table.add_column(head, justify="left" if i == 0 else "right", no_wrap=i > 0)
    for row in rows:
        table.add_row(*map(Text, row))
    Console(stderr=True, width=None if sys.stderr.isatty() else 140).print(table)


def _numbers(scores: Scores) -> dict[str, float]:
    """Without what was not measured: TOML has no place for it."""
    return {name: float(value) for name, value in scores._asdict().items() if np.isfinite(value)}
