"""`svgf-jax compare`."""

import csv
import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from svgf_jax.commands import results, terminal
from svgf_jax.types import SvgfError

if TYPE_CHECKING:
    from svgf_jax.metrics import Scores

COLUMNS = {
    "psnr": ("PSNR dB", "{:.2f}"),
    "relmse": ("relMSE", "{:.4g}"),
    "ssim": ("SSIM", "{:.4f}"),
    "temporal": ("temporal error", "{:.4f}"),
    "flip": ("HDR-FLIP", "{:.4f}"),
}
Flag: Parameter = Parameter(negative=(), show_default=False)


def compare(
    out: Annotated[str, Parameter(name="OUT")],
    reference: Annotated[str, Parameter(name="REF")],
    /,
    *,
    frames: Annotated[str | None, Parameter(metavar="RANGE")] = None,
    flip: Annotated[bool, Flag] = False,
    json_file: Annotated[Path | None, Parameter(name="--json", metavar="FILE")] = None,
    csv_file: Annotated[Path | None, Parameter(name="--csv", metavar="FILE")] = None,
    report: Annotated[Path | None, Parameter(metavar="FILE.html")] = None,
    before: Annotated[str | None, Parameter(metavar="SEQUENCE")] = None,
    overwrite: Annotated[bool, Flag] = False,
) -> None:
    """Measure a sequence against its reference, frame by frame and as a whole.

    PSNR and SSIM are on x / (1 + x); relMSE is (x - r)^2 / (r^2 + 0.01); the temporal error is the RMSE of what changes
    from frame to frame other than in the reference, on x / (1 + x). The colour is R, G, B where a file has them, else
    the sum of direct, indirect and emission.

    Args:
        out: The sequence to measure: a folder, a pattern or a file.
        reference: Its reference; frames are paired by number.
        frames: Only these: 1-100, 1-100x2 or 1,3,5-9.
        flip: HDR-FLIP too (slow; needs the extra `flip`).
        json_file: Write the scores to this file as JSON.
        csv_file: Write the scores to this file as CSV.
        report: Write one page to look at: pictures, maps of the error, curves.
        before: What OUT was made from, also shown in the report.
        overwrite: Replace the files of --json, --csv and --report if they exist.
    """
    from svgf_jax import metrics
    from svgf_jax.comparison import compare_pairs, pair_sequences

    if before is not None and report is None:
        raise SvgfError(f"Got --before {before} without --report; it is shown in the report.")
    results.require_writable((json_file, csv_file, report), overwrite=overwrite)
    if flip:
        metrics.require_flip()
    told: list[str] = []

    def warn(text: str) -> None:
        terminal.warn([text])
        told.append(text)

    pairs = pair_sequences(out, reference, frames=frames, warn=warn)
    earlier = {} if before is None else {pair.number: pair.path for pair in pair_sequences(before, reference)}
    scores = {str(number): score for number, score in compare_pairs(pairs, with_flip=flip, warn=warn)}
    mean = metrics.mean_scores(scores.values())
    print_scores("frame", scores | {"mean": mean})
    if json_file is not None:
        rows = [{"frame": int(number), **score._asdict()} for number, score in scores.items()]
        results.save(
            json_file, terminal.to_json({"out": out, "reference": reference, "frames": rows, "mean": mean}) + "\n"
        )
    if csv_file is not None:
        results.save(csv_file, _to_csv(scores | {"mean": mean}))
    if report is not None:
        from svgf_jax.report import compare_page

        cells = _cells(scores | {"mean": mean}, lambda name, value: COLUMNS[name][1].format(value))
        heads = ("frame", *(title for title, _ in COLUMNS.values()))
        table = (heads, [(label, *row.values()) for label, row in cells.items()])
        page = compare_page(out, pairs, list(scores.values()), before=earlier, table=table, notes=told)
        results.save(report, page)
        terminal.tell(f"report: {report}")


def print_scores(title: str, rows: Mapping[str, "Scores"]) -> None:
    """A table on the standard output, the row `mean` set apart; columns that no row has are left out."""
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    cells = _cells(rows, lambda name, value: COLUMNS[name][1].format(value))
    names = [name for name in COLUMNS if any(row[name] for row in cells.values())]
    table = Table(box=SIMPLE)
    table.add_column(Text(terminal.visible(title)))
    for name in names:
        table.add_column(COLUMNS[name][0], justify="right")
    for label, row in cells.items():
        if label == "mean":
            table.add_section()
        table.add_row(Text(terminal.visible(label)), *(row[name] for name in names))
    Console().print(table)


def _to_csv(rows: Mapping[str, "Scores"]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["frame", *COLUMNS])
    for label, row in _cells(rows, lambda _, value: repr(value)).items():
        writer.writerow([label, *row.values()])
    return text.getvalue()


def _cells(rows: Mapping[str, "Scores"], show: Callable[[str, float], str]) -> dict[str, dict[str, str]]:
    """By row and column: the score as text, "nan" for one that broken pixels spoil, "" for one that does not exist."""
    from svgf_jax.metrics import absent

    none = absent(list(rows.values()))
    return {
        label: {name: "" if none[i, k] else show(name, float(score[k])) for k, name in enumerate(score._fields)}
        for i, (label, score) in enumerate(rows.items())
    }
