"""One self-contained HTML page about a fit: curves, numbers with their errors, scores, pictures."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from svgf_jax import Config, Params, page
from svgf_jax.commands import results
from svgf_jax.page import Line, Raw, Shown
from svgf_jax.shown import legends, shown_frame
from tune.evaluate import filtered
from tune.explore import Profile, Sensitivity
from tune.fitting import Fit
from tune.free import natural, to_free
from tune.shots import Shot, frame_numbers
from tune.telling import Comparison

FRAMES = 6  # with pictures
EFOLDS = 3.0  # error bars are never drawn longer than this, to either side


def write_report(
    path: Path,
    found: Fit,
    start: Params,
    config: Config,
    compared: Sequence[Comparison],
    curves: Sequence[Profile],
    maps: Sensitivity,
    failures: Sequence[str],
    *,
    shot: Shot | None = None,
) -> None:
    """Write the page to `path`. Pictures are of the first that was compared, else of `shot`, whose targets are noisy.

    Raises SvgfError where the file cannot be written.
    """
    sections = [
        f"<h1>svgf-tune</h1><p>{page.escape(found.result)}. Loss 1 &rarr; {found.loss:.4f}.</p>",
        page.listed((f"Validation got worse: {failure}" for failure in failures), style="bad"),
        page.listed(found.notes),
        "<h2>Loss</h2>" + _loss_curve(found),
        "<h2>Parameters</h2>" + _parameters(found),
        _scores(compared) if compared else "",
        _frames(compared) if compared else "",
        _viewer(compared, shot, start, config, found),
        _profiles(curves) if curves else "",
        _maps(found, maps),
    ]
    results.save(path, page.document("svgf-tune", sections))


def _loss_curve(found: Fit) -> str:
    lines = []
    for start in sorted({i.start for i in found.iterations}):
        taken = [i for i in found.iterations if i.start == start and i.accepted]
        lines.append(Line(f"start {start}", [i.number for i in taken], [i.loss for i in taken]))
    rejected = sum(not i.accepted for i in found.iterations)
    drawn = page.plot(lines, title="accepted trial points")
    return f'<div class="plots">{drawn}</div><p>{len(found.iterations)} trial points, {rejected} rejected.</p>'


def _parameters(found: Fit) -> str:
    knowledge = found.knowledge
    assert knowledge is not None
    start = to_free(found.coordinates.start, found.coordinates)
    before, after = (natural(y, found.coordinates) for y in (start, found.y))
    errors = knowledge.relative_errors
    reach = np.abs(found.y - start) + np.where(np.isfinite(errors), errors, 0)
    scale = float(np.clip(reach.max(initial=0.1), 0.1, EFOLDS))
    rows = []
    for i, label in enumerate(found.coordinates.labels):
        known = f"standard error {knowledge.standard_errors[i]:.2g}" if np.isfinite(errors[i]) else "undetermined"
        drawn = _bar(found.y[i] - start[i], errors[i], scale, f"{label}: {after[i]:.4g}, {known}")
        said = "" if np.isfinite(errors[i]) else ("bad", known)
        rows.append((label, f"{before[i]:.4g}", f"{after[i]:.4g}", Raw(drawn), said, f"{knowledge.leverage[i]:.2g}"))
    heads = ("parameter", "before", "after", f"moved by, e-folds: -{scale:.2g} to {scale:.2g}", "", "leverage")
    return (
        page.table(heads, rows)
        + "<p>The dot is where the fit ended, seen from where it began (0); the bar is one standard error to either side, dashed "
        "where the data does not determine the number. An e-fold is a factor of 2.7 (of a blend: of its odds).</p>"
        + page.listed(f"{a} and {b} make up for each other." for a, b in knowledge.entangled)
    )


def _bar(moved: float, error: float, scale: float, text: str) -> str:
    """A dot and its error bar on [-scale, scale], as SVG."""
    least, at, most = (100 + 95 * float(np.clip(x / scale, -1, 1)) for x in (moved - error, moved, moved + error))
    dashes = "" if np.isfinite(error) else ' stroke-dasharray="4 4"'
    return (
        f'<svg class="bar" viewBox="0 0 200 18" role="img" aria-label="{page.escape(text)}"><title>{page.escape(text)}</title>'
        f'<line class="grid" x1="100" x2="100" y1="0" y2="18"/><g class="k1"><line x1="{least:.1f}" x2="{most:.1f}" y1="9" y2="9" '
        f'stroke-width="3"{dashes}/><circle cx="{at:.1f}" cy="9" r="4"/></g></svg>'
    )


def _scores(compared: Sequence[Comparison]) -> str:
    rows = []
    for c in compared:
        mark = "good" if c.after.mean.psnr >= c.before.mean.psnr else "bad"
        row: list[object] = [f"{c.before.name} ({c.role})"]
        for name, form in (("psnr", ".2f"), ("relmse", ".4g"), ("temporal", ".5f"), ("flip", ".4f")):
            before, after = getattr(c.before.mean, name), getattr(c.after.mean, name)
            row.append((mark, "" if np.isnan(after) else f"{before:{form}} \N{RIGHTWARDS ARROW} {after:{form}}"))
            mark = ""
        rows.append(row)
    return "<h2>Before and after</h2>" + page.table(
        ("sequence", "PSNR dB", "relMSE", "temporal error", "HDR-FLIP"), rows
    )


def _frames(compared: Sequence[Comparison]) -> str:
    plots = []
    for i, c in enumerate(compared):
        for name, title in (("psnr", "PSNR dB"), ("temporal", "temporal error")):
            lines = [
                Line(text, m.numbers, [getattr(s, name) for s in m.frames])
                for text, m in (("before", c.before), ("after", c.after))
            ]
            # The viewer shows frames of the first sequence; the other plots have numbers of their own.
            shown = f"{title}, {c.role}: {Path(c.before.name).name}"
            plots.append(page.plot(lines, title=shown, frames=c.before.numbers, marked=i == 0))
    return f'<h2>Frame by frame</h2><div class="plots">{"".join(plots)}</div>'


def _viewer(compared: Sequence[Comparison], shot: Shot | None, start: Params, config: Config, found: Fit) -> str:
    """Frames before, after and the reference, evenly spread, that which gained most among them; or the second noisy render."""
    if compared:
        shot, measured = compared[0].shot, compared[0]
        gains = [a.psnr - b.psnr for a, b in zip(measured.after.frames, measured.before.frames, strict=True)]
        chosen = {measured.before.numbers[int(np.nanargmax(gains))]} if not np.isnan(gains).all() else set()
    elif shot is None:
        return ""
    else:
        chosen = set[int]()
    chosen |= set(page.evenly(frame_numbers(shot), FRAMES - 1))

    def pictures(params: Params, config: Config) -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
        for number, pair in zip(frame_numbers(shot), filtered(shot, params, config), strict=True):
            if number in chosen:
                yield pair

    shown: list[Shown] = []
    both = zip(pictures(start, config), pictures(found.params, found.config), strict=True)
    for number, ((before, target), (after, _)) in zip(sorted(chosen), both, strict=True):
        every = {"before": before, "after": after}
        if not compared and target is not None:
            every["second render"] = target
        shown.append(shown_frame(number, every, target if compared else None, {}, len(chosen)))
    other = "" if compared else "<p>No references were given, so that nothing here is measured.</p>"
    return f"<h2>Pictures of {page.escape(shot.name)}</h2>{other}" + page.viewer(
        shown, left="before", right="after", legends=legends()
    )


def _profiles(curves: Sequence[Profile]) -> str:
    plots = [
        page.plot([Line("", np.log10(c.values).tolist(), c.losses.tolist())], title=f"loss over log10 {c.label}")
        for c in curves
    ]
    return f'<h2>Profiles</h2><p>The loss along each parameter, the others held.</p><div class="plots">{"".join(plots)}</div>'


def _maps(found: Fit, maps: Sensitivity) -> str:
    figures = []
    scale = max(float(np.quantile(np.abs(maps.slopes), 0.995)), 1e-30)
    for label, plane in zip(found.coordinates.labels, maps.slopes, strict=True):
        picture, name = page.picture(page.signed(plane / scale)), page.escape(label)
        figures.append(f'<figure><img src="{picture}" alt="{name}"><figcaption>{name}</figcaption></figure>')
    return (
        "<h2>Where each parameter matters</h2><p>Blue: a larger value would make this pixel better; red: worse.</p>"
        f'<div class="maps">{"".join(figures)}</div>'
    )
