"""`svgf-jax inspect`."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter

from svgf_jax.commands import settings, terminal
from svgf_jax.commands.completing import PRESET
from svgf_jax.commands.settings import INPUT, Flag, Reading, Repeated

if TYPE_CHECKING:
    from rich.console import Console

    from svgf_jax.findings import Finding
    from svgf_jax.geometry import Fit
    from svgf_jax.inspection import Facts
    from svgf_jax.warping import Residual

FILTER, OUTPUT = (Group(name, sort_key=i) for i, name in enumerate(["Filter", "Output"], 1))
CONVENTIONS = 8  # lines of motion conventions
Rows = list[tuple[str, str]]


def inspect(
    input_: Annotated[str, Parameter(name="INPUT", group=INPUT)],
    /,
    *,
    frames: Annotated[str | None, Parameter(metavar="RANGE", group=INPUT)] = None,
    missing: Annotated[Literal["error", "hold", "reset"], Parameter(group=INPUT)] = "error",
    reading: Reading = Reading(),
    method: Annotated[settings.Method, Parameter(group=FILTER)] = "svgf",
    preset: Annotated[str | None, PRESET, Parameter(metavar="NAME", group=FILTER)] = None,
    params: Annotated[Path | None, Parameter(metavar="FILE.toml", group=FILTER)] = None,
    set_: Annotated[tuple[str, ...], Repeated, Parameter(name="--set", metavar="NAME=VALUE", group=FILTER)] = (),
    json: Annotated[bool, Flag, Parameter(group=OUTPUT)] = False,
    strict: Annotated[bool, Flag, Parameter(group=OUTPUT)] = False,
) -> int:
    """Say what a sequence is and what is wrong with it, before a long run: all headers, the pixels of three or four frames.

    Exits with 0 if `svgf-jax denoise` would run, 2 if not.

    Args:
        input_: A folder, a pattern (frame_####.exr, frame_%04d.exr, frame_$F4.exr) or one file.
        frames: Only these: 1-100, 1-100x2 or 1,3,5-9.
        missing: As for denoise: hold and reset allow missing frames.
        method: What would filter, for the history and needs of a run; as for denoise.
        preset: The same: a preset of svgf; `svgf-jax params list` shows them.
        params: The same: parameters from a TOML file.
        set_: The same: one parameter, or one value per a-trous level. Repeatable.
        json: Print everything as JSON to the standard output instead.
        strict: Exit with 2 if there is anything to mend, too.
    """
    record, chosen, config = settings.choose_method(method, preset, params, set_)
    opened = reading.options()

    from svgf_jax.findings import judge, verdict
    from svgf_jax.frames import open_source
    from svgf_jax.inspection import inspect_source

    source = open_source(input_, frames=frames, missing="reset" if missing == "error" else missing, **opened)
    facts = inspect_source(source, params=chosen, config=config)
    findings = judge(facts, gaps_allowed=missing != "error")
    if json:
        told = {"method": method, "preset": record} | _record(facts)
        terminal.print_json(told | {"findings": findings, "verdict": verdict(findings)})
    else:
        kind = "method " if method != "svgf" else "preset " if params is None else ""
        _print(facts, findings, verdict(findings), kind + record)
    bad = ("error", "warning") if strict else ("error",)
    return 2 if any(one.level in bad for one in findings) else 0


def _print(facts: "Facts", findings: "tuple[Finding, ...]", conclusion: str, run: str) -> None:
    """Sections of labels and texts, then what to mend, then the verdict. Nothing is taken for markup. `run`: what would filter."""
    from rich.console import Console

    console = Console(highlight=False)
    if not console.is_terminal:  # piped: no blanks at the ends of lines
        with console.capture() as captured:
            _draw(console, facts, findings, conclusion, run)
        sys.stdout.write("".join(f"{line.rstrip()}\n" for line in captured.get().splitlines()))
    else:
        _draw(console, facts, findings, conclusion, run)


def _draw(console: "Console", facts: "Facts", findings: "tuple[Finding, ...]", conclusion: str, run: str) -> None:
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    def shown(text: str, style: str = "") -> Text:
        return Text(terminal.visible(text), style=style)

    console.print(shown(facts.name, style="bold"))
    sections = [(title, rows) for title, rows in _sections(facts, run) if rows]
    width = max(len(label) for _, rows in sections for label, _ in rows)
    for title, rows in sections:
        grid = Table.grid(padding=(0, 2, 0, 0))
        grid.add_column(width=width, no_wrap=True)
        grid.add_column(overflow="fold")
        for label, text in rows:
            grid.add_row(shown(label, style="cyan"), shown(text))
        console.print()
        console.print(shown(title, style="bold"))
        console.print(Padding(grid, (0, 0, 0, 2)))
    for title, level, style in (
        ("Errors", "error", "bold red"),
        ("To mend", "warning", "bold yellow"),
        ("Notes", "note", "bold"),
    ):
        chosen = [one for one in findings if one.level == level]
        if not chosen:
            continue
        console.print()
        console.print(shown(title, style=style))
        for number, one in enumerate(chosen, 1):
            grid = Table.grid(padding=(0, 1, 0, 0))
            grid.add_column(width=3, no_wrap=True, justify="right")
            grid.add_column(overflow="fold")
            grid.add_row(shown(f"{number}."), shown(_sentence(one.text)))
            if one.remedy:
                grid.add_row(shown("->", style="green"), shown(one.remedy))
            console.print(Padding(grid, (0, 0, 0, 1)))
    console.print()
    style = {"r": "bold green", "c": "bold yellow"}[conclusion[0]] if "cannot" not in conclusion else "bold red"
    console.print(shown(conclusion, style=style))


def _sections(facts: "Facts", run: str) -> Iterator[tuple[str, Rows]]:
    yield "Files", list(_files(facts))
    yield "Channels", list(_channels(facts))
    yield f"Light (frame{'s' * (len(facts.read) > 1)} {', '.join(map(str, facts.read))})", list(_light(facts))
    yield "Guides", list(_guides(facts))
    yield "Motion", list(_motion(facts))
    seconds = facts.needs.seconds
    whole = terminal.duration(seconds * len(facts.scan.there))
    time = f"about {whole}, {seconds:.2g} s a frame, on two cores, after compiling"
    needs = [(name, f"at most about {terminal.size(getattr(facts.needs, name))}") for name in ("memory", "disk")]
    yield "A run", [("filter", run), ("time", time), *needs]


def _files(facts: "Facts") -> Iterator[tuple[str, str]]:
    from svgf_jax.sequences import format_range

    scan = facts.scan
    gaps = f"{format_range(scan.missing)} missing" if scan.missing else "none missing"
    yield "frames", f"{len(scan.there)} ({format_range(scan.there)}), {gaps}"
    crop = "a crop of a larger picture" if facts.crop else "data window = display window"
    yield "size", f"{facts.size[0]} x {facts.size[1]}, {crop}"
    saved = f", {scan.pixels / scan.stored:.1f} : 1" if scan.stored else ""
    yield "stored", f"{terminal.size(scan.stored)}, {scan.compression or 'unknown compression'}{saved}"
    spp = "the header does not say" if facts.samples is None else f"{facts.samples[1]:g} (attribute {facts.samples[0]})"
    yield "samples", spp


def _channels(facts: "Facts") -> Iterator[tuple[str, str]]:
    from svgf_jax.roles import short_names

    yield "names", facts.table.title
    yield from facts.roles.told(types=facts.scan.types).items()
    stems: dict[str, list[str]] = {}
    for name in facts.scan.unused:
        stems.setdefault(name.rpartition(".")[0], []).append(name)
    unused = [short_names(tuple(sorted(names, key=lambda name: "RGBAXYZ".find(name[-1])))) for names in stems.values()]
    if unused:
        yield "not used", ", ".join(unused[:10]) + (f" and {len(unused) - 10} more" if len(unused) > 10 else "")


def _light(facts: "Facts") -> Iterator[tuple[str, str]]:
    from svgf_jax.findings import CORRELATED, REPEATED, doubtful

    for name, light in facts.light.items():
        level = "hardly any light" if light.noise is None else f"noise {100 * light.noise:.3g} % of the light"
        pixels, share = light.fireflies
        flies = (
            f"fireflies {100 * pixels:.2g} % of the pixels, {100 * share:.2g} % of the light"
            if pixels
            else "no fireflies"
        )
        yield name, f"{level}; {flies}"
    if facts.psnr == float("inf"):
        yield "picture", "no noise at all"
    elif facts.psnr is not None:
        yield "picture", f"about {facts.psnr:.1f} dB (PSNR that svgf-jax compare would show, by the noise alone)"
    high = "correlated noise, or texture" if doubtful(facts) else "correlated noise"
    yield "neighbours", _correlation(facts.correlation, CORRELATED, "independent noise", high)
    yield "frames", _correlation(facts.repeated, REPEATED, "independent noise", "the same noise again")
    broken = [
        f"{role} {', '.join(f'{count} {kind}' for kind, count in one._asdict().items() if count)}"
        for role, one in facts.broken.items()
    ]
    yield "broken", "; ".join(broken) or "no NaN, no infinity, nothing negative"


def _correlation(value: float | None, limit: float, low: str, high: str) -> str:
    if value is None:
        return "cannot tell: too few pixels with noise"
    return f"{high if value > limit else low} (correlation {value + 0.0:.2f})"


def _guides(facts: "Facts") -> Iterator[tuple[str, str]]:
    yield "background", f"{100 * facts.background:.3g} % of the pixels"
    if "normal" in facts.roles.layers:
        why = "no positions, and no depth with cameras, to compare with"
        yield "normals", "packed to 0 ... 1" if facts.packed else _fit(facts.normals, why, "{:.2g} degrees")
    if "depth" in facts.roles.layers:
        yield "depth", _fit(facts.depth, "no flat surfaces, no positions with cameras", "{:.1g}")
    rounding = [
        f"{role}: steps of {value:.2g} {unit}"
        for role, value, unit in (
            ("position", facts.halves.position, "of a pixel's distance"),
            ("motion", facts.halves.motion, "pixels"),
        )
        if value is not None
    ]
    if rounding:
        yield "half float", "; ".join(rounding)


def _fit(fit: "Fit | None", why: str, form: str) -> str:
    """`view z (off by 2e-06; ray distance 0.003)`."""
    if fit is None:
        return f"cannot tell: {why}"
    name = " or ".join(fit.best) if fit.best else "none of what is known"
    if len(fit.best) > 1 and "world space" in fit.best:
        name = "world space (the camera's axes are the same here)"
    nearest = sorted(fit.misfit.items(), key=lambda item: item[1])[:2]
    return f"{name}; off by: {', '.join(f'{other} {form.format(value)}' for other, value in nearest)}"


def _motion(facts: "Facts") -> Iterator[tuple[str, str]]:
    from svgf_jax.warping import shown

    def told(residual: "Residual") -> str:
        pixels = shown(residual.pixels, ".3g")
        return f"{pixels} pixels off" + (f" (by {', '.join(residual.guides)})" if "more" not in pixels else "")

    if facts.motion is not None:
        groups: dict[str, list[str]] = {}
        for one, residual in facts.motion.residuals.items():
            if residual.judged:
                groups.setdefault(told(residual), []).append(
                    f"{one or 'no motion at all'}{' (fits)' * (one in facts.motion.fits)}"
                )
        for row, (text, names) in enumerate(groups.items()):
            label = "" if row else "tried"
            if row >= CONVENTIONS:
                others = sum(map(len, list(groups.values())[row:]))
                yield label, f"{others} others: {text.partition(' (')[0]}{' or more' * (' or more' not in text)}"
                break
            if len(names) > 4 and row:
                kept = [name for name in names if name == "no motion at all"]
                names = [*kept, f"{len(names) - len(kept)} others"]
            yield label, f"{', '.join(names)}: {text}"
        if not groups:
            yield "tried", f"cannot tell: {'no surfaces' if facts.background == 1 else 'nothing moves'}"
    if facts.warped is not None and facts.warped.judged:
        yield "as read" if "motion" in facts.roles.layers else "by cameras", told(facts.warped)
    if facts.continuity is not None:
        found = f"{100 * facts.continuity.share:.3g} % of the surfaces are found in the frame before"
        long = "" if facts.history is None else f": {facts.history:.1f} frames long on average over the sequence"
        yield "history", found + long


def _sentence(text: str) -> str:
    """With a capital letter, unless it begins with a path."""
    path = "/" in text.partition(":")[0] or not text.partition(" ")[0].rstrip(",:;").isalpha()
    return text if path else text[:1].upper() + text[1:]


def _record(facts: "Facts") -> dict[str, Any]:
    """The facts as plain JSON: the convention of motion as words, attributes of the header as text."""
    record = facts._asdict()
    record["scan"] = facts.scan._asdict() | {
        "attributes": {name: str(value) for name, value in facts.scan.attributes.items()}
    }
    record["roles"] = {
        "layers": {role: layer._asdict() for role, layer in facts.roles.layers.items()},
        "absent": facts.roles.absent,
        "derived": dict(facts.roles.derived),
        "signals": facts.roles.signals,
        "bare": dict(facts.roles.bare),
        "rest": facts.roles.rest,
        "renderer": facts.table.name,
    }
    del record["table"]
    if facts.motion is not None:
        residuals = {str(one or "no motion at all"): residual for one, residual in facts.motion.residuals.items()}
        record["motion"] = {"fits": [str(one) for one in facts.motion.fits], "residuals": residuals}
    return record
