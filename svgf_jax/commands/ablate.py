"""`svgf-jax ablate`."""

import csv
import io
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Group, Parameter

from svgf_jax.commands import results, settings, terminal
from svgf_jax.commands.completing import PRESET
from svgf_jax.commands.settings import INPUT, Flag, Reading, Repeated
from svgf_jax.types import SvgfError

if TYPE_CHECKING:
    from svgf_jax.ablation import Measured

BASE, OUTPUT = (Group(name, sort_key=i) for i, name in enumerate(["Base and rows", "Output"], 1))
COLUMNS = {
    "psnr": ("PSNR dB", "{:.2f}"),
    "relmse": ("relMSE", "{:.3g}"),
    "temporal": ("temporal", "{:.4f}"),
    "seconds": ("ms", "{:.0f}"),
}


def ablate(
    input_: Annotated[str, Parameter(name="INPUT", group=INPUT)],
    /,
    *,
    reference: Annotated[str, Parameter(metavar="REF", group=INPUT)],
    frames: Annotated[str | None, Parameter(metavar="RANGE", group=INPUT)] = None,
    reading: Reading = Reading(),
    preset: Annotated[str | None, PRESET, Parameter(metavar="NAME", group=BASE)] = None,
    params: Annotated[Path | None, Parameter(metavar="FILE.toml", group=BASE)] = None,
    set_: Annotated[tuple[str, ...], Repeated, Parameter(name="--set", metavar="NAME=VALUE", group=BASE)] = (),
    only: Annotated[str | None, Parameter(metavar="NAMES", group=BASE)] = None,
    device: Annotated[str | None, Parameter(metavar="DEVICE", group=BASE)] = None,
    json_file: Annotated[Path | None, Parameter(name="--json", metavar="FILE", group=OUTPUT)] = None,
    csv_file: Annotated[Path | None, Parameter(name="--csv", metavar="FILE", group=OUTPUT)] = None,
    markdown_file: Annotated[Path | None, Parameter(name="--markdown", metavar="FILE", group=OUTPUT)] = None,
    report: Annotated[Path | None, Parameter(metavar="FILE.html", group=OUTPUT)] = None,
    overwrite: Annotated[bool, Flag, Parameter(group=OUTPUT)] = False,
) -> int:
    """Measure what each part of the filter is worth: a row for each choice that differs from a base in one thing.

    PSNR (on x / (1 + x)), relMSE, temporal error and the median time of a frame, each with its change against the base:
    dB or percent. A row `no-...` leaves a part out, `with-...` adds one. After each row the files are written anew, and
    Ctrl-C shows the rows that are done.

    Args:
        input_: The noisy sequence: a folder, a pattern or a file.
        reference: Its references; frames are paired by number.
        frames: Only these: 1-100, 1-100x2 or 1,3,5-9.
        preset: The base: a preset by name; `svgf-jax params list` shows them.
        params: The base: parameters from a TOML file.
        set_: One parameter of the base, or one value per a-trous level. Repeatable.
        only: Only these rows besides the base: names or patterns such as no-history,levels-*; a wrong one lists them all.
            A row no-... leaves a part out, with-... adds one.
        device: cpu, gpu, gpu:1, ...; what JAX chooses if not given.
        json_file: Write all numbers to this file as JSON.
        csv_file: Write all numbers to this file as CSV.
        markdown_file: Write the table to this file as Markdown.
        report: Write one page to look at: the table, pictures and differences of each row, curves.
        overwrite: Replace the files of --json, --csv, --markdown and --report if they exist.
    """
    record, chosen, config = settings.choose(preset, params, set_)
    opened = reading.options()
    results.require_writable((json_file, csv_file, markdown_file, report), overwrite=overwrite)

    from svgf_jax import ablation
    from svgf_jax.frames import open_source
    from svgf_jax.outputs import numbers
    from svgf_jax.references import pair_references
    from svgf_jax.report import ablation_page, watch_rows

    source = open_source(input_, frames=frames, **opened)
    references, lacking = pair_references(source.sequence, reference)
    if themselves := {path for _, path in source.sequence.files} & set(references.values()):
        raise SvgfError(f"Got {min(map(str, themselves))} as its own reference; wanted a converged render of it.")
    there = ablation.grid(chosen, config, signals=len(source.roles.signals), albedo="albedo" not in source.roles.absent)
    rows = ablation.choose_rows([] if only is None else [name.strip() for name in only.split(",")], there)
    terminal.warn([*source.warnings, *lacking])

    there_are = [number for number, path in source.sequence.files if path is not None]
    on_image, shown = watch_rows(there_are if report is not None else [], len(rows) + 1)
    found: list[Measured] = []
    count = len(source.sequence.files)
    title = f"{source.sequence.name}, {count} frame{'s' * (count != 1)}; base: {record}"
    told = {"input": source.sequence.name, "reference": reference, "frames": count, "base": record}
    interrupted = False
    try:
        with terminal.bar(count * (len(rows) + 1)) as advance:
            measured = ablation.ablate(
                source,
                references,
                rows=rows,
                params=chosen,
                config=config,
                device=device,
                on_frame=lambda row, number: advance(f"{row.name}, frame {number}"),
                on_image=on_image,
            )
            for one in measured:
                found.append(one)
                terminal.tell(_line(one, found[0], f"{len(found)} of {len(rows) + 1}"))
                if json_file is not None:
                    table = told | numbers(chosen, config) | {"rows": _records(found)}
                    results.save(json_file, terminal.to_json(table) + "\n")
                if csv_file is not None:
                    results.save(csv_file, _to_csv(found))
                if markdown_file is not None:
                    results.save(markdown_file, _to_markdown(title, found))
    except KeyboardInterrupt:
        interrupted = True
    if found:
        _print(title, found)
        if report is not None:
            notes = [f"Interrupted: {len(found)} of {len(rows) + 1} rows are done."] if interrupted else []
            text = ablation_page(
                title,
                found,
                shown(),
                table=_to_table(found),
                roles=source.roles.describe(),
                values=numbers(chosen, config),
                notes=[*notes, *source.warnings, *lacking],
            )
            results.save(report, text)
            terminal.tell(f"report: {report}")
    if interrupted:
        terminal.tell(f"interrupted: {len(found)} of {len(rows) + 1} rows are done")
    return 130 if interrupted else 0


def _values(one: "Measured") -> dict[str, float]:
    return {name: one.seconds if name == "seconds" else getattr(one.scores, name) for name in COLUMNS}


def _changes(one: "Measured", base: "Measured") -> dict[str, float]:
    """Against the base: the PSNR in dB, the others as fractions; nan where there is none."""
    pairs = {name: (value, _values(base)[name]) for name, value in _values(one).items()}
    return {
        name: value - was if name == "psnr" else value / was - 1 if was else math.nan
        for name, (value, was) in pairs.items()
    }


def _shown(one: "Measured", base: "Measured") -> dict[str, tuple[str, str]]:
    """A row's values and their changes as text; "" for what does not exist, and for the base's changes."""

    def show(value: float, text: Callable[[float], str]) -> str:
        return "" if math.isnan(value) else text(value)

    changes = _changes(one, base)
    return {
        name: (
            show(value * (1e3 if name == "seconds" else 1), COLUMNS[name][1].format),
            ""
            if one is base
            else show(changes[name], "{:+.2f}".format if name == "psnr" else lambda c: f"{100 * c:+.0f} %"),
        )
        for name, value in _values(one).items()
    }


def _line(one: "Measured", base: "Measured", which: str) -> str:
    """A row in less than 80 columns."""
    psnr, _, temporal, _ = _joined(one, base)
    return f"{which}: {one.row.name}: PSNR {psnr}, temporal {temporal or 'none'}"


def _print(title: str, found: Sequence["Measured"]) -> None:
    """The table on the standard output, with the rows' meanings where there is room for them."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    with_meanings = console.width >= 130
    table = Table(
        box=None, padding=(0, 1, 0, 0), title=Text(terminal.visible(title)), title_justify="left", title_style=""
    )
    table.add_column("row", no_wrap=True)
    for name, _ in COLUMNS.values():
        table.add_column(name, justify="right", no_wrap=True)
        table.add_column("", justify="right", no_wrap=True)
    if with_meanings:
        table.add_column("meaning")
    for one in found:
        cells = [text for value, change in _shown(one, found[0]).values() for text in (f" {value}", change)]
        table.add_row(*map(Text, [one.row.name, *cells, *([one.row.meaning] if with_meanings else [])]))
    console.print(table)
    if not with_meanings:
        console.print("A terminal of 130 columns or more also shows what each row means.")


def _to_table(found: Sequence["Measured"]) -> tuple[tuple[str, ...], list[tuple[object, ...]]]:
    """(heads, rows) for a page: all values with their changes, and the rows' meanings."""
    heads = ("row", *(name for name, _ in COLUMNS.values()), "meaning")
    return heads, [(one.row.name, *_joined(one, found[0]), ("text", one.row.meaning)) for one in found]


def _joined(one: "Measured", base: "Measured") -> list[str]:
    return [f"{value}{change and f' ({change})'}" for value, change in _shown(one, base).values()]


def _to_markdown(title: str, found: Sequence["Measured"]) -> str:
    lines = [title, "", f"| row | {' | '.join(name for name, _ in COLUMNS.values())} | meaning |"]
    lines.append("|---|" + "---:|" * len(COLUMNS) + "---|")
    for one in found:
        lines.append(f"| {one.row.name} | {' | '.join(_joined(one, found[0]))} | {one.row.meaning} |")
    return "\n".join(lines) + "\n"


def _records(found: Sequence["Measured"]) -> list[dict[str, Any]]:
    return [
        {"name": one.row.name, "meaning": one.row.meaning, "changes": dict(one.row.changes)}
        | {"ssim": one.scores.ssim, **_values(one), "against_base": _changes(one, found[0])}
        for one in found
    ]


def _to_csv(found: Sequence["Measured"]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["row", *COLUMNS, *(f"{name}_change" for name in COLUMNS)])
    for one in found:
        numbers = (*_values(one).values(), *_changes(one, found[0]).values())
        writer.writerow([one.row.name, *("" if math.isnan(value) else repr(value) for value in numbers)])
    return text.getvalue()
