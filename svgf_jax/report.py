"""One self-contained page about a run, a comparison or an ablation: pictures, maps, curves, and all that was chosen. No JAX.

Pictures are shown of at most `MOST` frames, evenly spread, and share a budget of bytes, so that a page stays below 15 MB
however long the sequence is. What is not known of a frame is left out or said to be unknown.
"""

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from svgf_jax import checkpoint, exr, frames, metrics, page, pieces
from svgf_jax.ablation import Measured
from svgf_jax.comparison import Pair
from svgf_jax.outputs import WriteOptions, beauty, numbers
from svgf_jax.page import Line, Shown
from svgf_jax.plan import output_paths, part_name
from svgf_jax.references import read_radiance, read_reference
from svgf_jax.sequences import format_range
from svgf_jax.shown import MOST, diagnostic_layers, diagnostics, encoded, legends, share, shown_frame
from svgf_jax.streaming import Summary
from svgf_jax.types import Output

ROW_FRAMES = 4  # frames with pictures of each row of an ablation
UNKNOWN = "?"


class Run(NamedTuple):
    """What a report of a run is about.

    Attributes:
        source, out: the sequence and the output folder.
        method, preset: by name.
        params, config: what runs.
        options: how previews look.
        references: files by frame number.
        maps: data URLs of maps by frame number, which `watch` fills.
    """

    source: frames.Source
    out: Path
    method: str
    preset: str
    params: Any
    config: Any
    options: WriteOptions
    references: Mapping[int, str]
    maps: dict[int, Mapping[str, str]]


def watch(run: Run) -> Callable[[frames.LoadedFrame, Output], None]:
    """What `streaming.run(on_output=...)` takes: it keeps the maps of the frames that may be shown."""
    before = run.source.sequence.warmup or 0
    chosen = page.evenly([number for number, path in run.source.sequence.files[before:] if path is not None], MOST)

    def on_output(item: frames.LoadedFrame, output: Output) -> None:
        if item.number in chosen:
            layers = (output.variance, output.history_length, output.valid, output.change, output.effective_history)
            maps = diagnostics(*layers, params=run.params._asdict())
            run.maps[item.number] = encoded(maps, share(len(chosen)))

    return on_output


def run_page(run: Run, summary: Summary, *, repairs: Callable[[Mapping[str, int]], Iterable[str]]) -> str:
    """The page about a run, of the frames that are done: reads them back, the references, and the inputs that are shown.

    `repairs` tells in words what the counts of repaired pixels mean.
    """
    sequence = run.source.sequence
    warmup = sequence.warmup or 0
    paths = output_paths(sequence.files, run.out, hold=sequence.missing == "hold", warmup=warmup)
    figures = checkpoint.load_figures(checkpoint.state_folder(run.out, part_name(sequence.files, sequence.warmup)))
    done = [
        (index, number, path)
        for index, ((number, _), path) in enumerate(zip(sequence.files, paths, strict=True))
        if path is not None and path.exists() and (number in figures or not summary.interrupted)
    ]
    shown, scores = _run_frames(run, done)
    known = [figures.get(number, {}) for _, number, _ in done]
    x = [number for _, number, _ in done]
    each = [_number(one.get("seconds")) for one in known]
    seconds = _from_start(each)
    counts = [one.get("counts") for one in known]
    repaired = [math.nan if one is None else float(sum(one.values())) for one in counts]
    length = [_number(one.get("history")) for one in known]
    curves = [
        *pieces.curves(x, scores, "denoised", _noisy_line(shown)),
        page.plot([Line("seconds", x, seconds)], title="done after, seconds (the first compiles)", frames=x),
        page.plot([Line("pixels", x, repaired)], title="pixels repaired", frames=x),
        page.plot([Line("frames", x, length)], title="mean history length, frames", frames=x),
    ]
    wanted = len(sequence.files) - warmup
    notes = [f"Interrupted: {len(done)} of {wanted} frames are done."] if summary.interrupted else []
    notes += [*run.source.warnings, *summary.notes, *repairs(sum((Counter(one) for one in counts if one), Counter()))]
    if unknown := [number for number, one in zip(x, known, strict=True) if not one]:
        notes.append(
            f"There is no record of frames {format_range(unknown)}: their time, repairs and history are unknown."
        )
    maps_of = {frame.number: frame.maps.get("denoised", {}) for frame in shown}
    if bare := [number for number, maps in maps_of.items() if "history length" not in maps]:
        notes.append(
            f"The filter's maps of frames {format_range(bare)} are unknown: an earlier run denoised them, and only --diagnostics "
            "keeps them in the files."
        )
    lost = [n for n, maps in maps_of.items() if "history length" in maps and "effective history" not in maps]
    if lost and summary.resumed_at and run.method == "svgf":
        notes.append(
            f"The effective history of frames {format_range(lost)} is unknown: a run keeps it only if it begins with --report or "
            "--diagnostics."
        )
    rows = [
        (number, one.get("status", UNKNOWN), *_score_cells(score), *_cells(times, count, mean))
        for number, one, score, times, count, mean in zip(x, known, scores, seconds, repaired, length, strict=True)
    ]
    heads = ("frame", "status", "PSNR dB", "temporal error", "done after, s", "repaired", "mean history")
    after = f", after {warmup} to warm up" if warmup else ""
    before = f", {summary.resumed_at} of them by an earlier run" if summary.resumed_at else ""
    told = [
        ("frames", f"{len(done)} of {wanted}{before}{after}"),
        ("device", summary.device or "nothing was left to compute"),
        ("seconds, this run", f"{summary.seconds:.1f}"),
        *_speed(each),
        ("pictures", pieces.pictures_of(shown, len(done))),
    ]
    return page.document(
        f"{Path(sequence.name).name}: {run.method}, {run.preset}",
        [
            pieces.title(sequence.name, f"denoised by {run.method}, {run.preset}"),
            page.listed(notes),
            page.viewer(shown, left="noisy", right="denoised", legends=legends(run.params._asdict())),
            pieces.plots(curves),
            pieces.folded("Every frame", page.table(heads, rows)),
            f"<h2>Which channel plays which role</h2><pre>{page.escape(run.source.roles.describe())}</pre>",
            pieces.parameters(numbers(run.params, run.config)),
            pieces.versions(told),
        ],
    )


def compare_page(
    title: str,
    pairs: Sequence[Pair],
    scores: Sequence[metrics.Scores],
    *,
    before: Mapping[int, str],
    table: tuple[Sequence[str], Iterable[Sequence[object]]],
    notes: Sequence[str] = (),
) -> str:
    """The page about a comparison: the scores of all pairs, pictures of some.

    `before`: what they were made from, by frame number, as far as that is known. `table` holds the scores as text.
    """
    chosen = page.evenly([pair.number for pair in pairs], MOST)
    shown, attributes, found = [], {}, {}
    for pair in pairs:
        if pair.number in chosen:
            image = exr.read(pair.path)
            attributes = {name: value for name, value in image.attributes.items() if name.startswith("svgf_jax:")}
            found = _recorded(attributes)
            target = read_radiance(pair.reference)
            maps = diagnostic_layers(image, params=found.get("parameters", {}))
            pictures = {"result": read_radiance(pair.path)}
            if pair.number in before:
                pictures = {"before": read_radiance(before[pair.number])} | pictures
            shown.append(shown_frame(pair.number, pictures, target, {"result": maps}, len(chosen)))
    x = [pair.number for pair in pairs]
    old = [pair for pair in pairs if pair.number in chosen and pair.number in before]
    read = ((read_radiance(before[pair.number]), read_radiance(pair.reference)) for pair in old)
    earlier = {pair.number: score for pair, score in zip(old, metrics.score_frames(read), strict=True) if score}
    if len(old) < len(pairs):  # not consecutive
        earlier = {number: score._replace(temporal=math.nan) for number, score in earlier.items()}
    curves = pieces.curves(x, scores, "result", {"before": earlier} if earlier else {})
    curves += [
        page.plot(pieces.lines(x, scores, "result", field, {"before": earlier}), title=name, frames=x, named=True)
        for field, name in (("relmse", "relMSE"), ("ssim", "SSIM"), ("flip", "HDR-FLIP"))
    ]
    told = [
        (name.removeprefix("svgf_jax:"), text) for name, text in attributes.items() if name != "svgf_jax:parameters"
    ]
    return page.document(
        title,
        [
            pieces.title(title, f"{len(pairs)} frames against their reference"),
            page.listed(notes),
            page.viewer(shown, left="result", right="reference", legends=legends(found.get("parameters"))),
            pieces.plots(curves),
            pieces.folded("Every frame", page.table(*table)),
            pieces.parameters(_recorded(attributes)) if attributes else "",
            pieces.versions([*told, ("pictures", pieces.pictures_of(shown, len(pairs)))]),
        ],
    )


def watch_rows(
    numbers: Sequence[int], rows: int
) -> tuple[Callable[[str, int, np.ndarray, np.ndarray | None], None], Callable[[], list[Shown]]]:
    """What takes each row's images of a sequence's frames, and what tells the viewer's frames of those seen so far."""
    chosen = page.evenly(numbers, ROW_FRAMES)
    frames_of: dict[int, Shown] = {number: Shown(number, {}) for number in chosen}

    def on_image(row: str, number: int, image: np.ndarray, target: np.ndarray | None) -> None:
        if number in chosen:
            one = shown_frame(number, {row: image}, target, {}, len(chosen), pictures_a_frame=2 * rows + 2)
            before = frames_of[number]
            frames_of[number] = Shown(
                number,
                {**one.pictures, **before.pictures},
                {**one.maps, **before.maps},
                {**one.psnr, **before.psnr},
            )

    return on_image, lambda: [one for one in frames_of.values() if one.pictures]


def ablation_page(
    title: str,
    found: Sequence[Measured],
    shown: Sequence[Shown],
    *,
    table: tuple[Sequence[str], Iterable[Sequence[object]]],
    roles: str,
    values: Mapping[str, Any],
    notes: Sequence[str] = (),
) -> str:
    """The page about an ablation: its `table`, curves of the two rows that are compared, pictures of each row."""
    names = {one.row.name for one in found} | {"reference"}
    shown = [
        frame._replace(
            pictures={name: url for name, url in frame.pictures.items() if name in names},
            maps={name: maps for name, maps in frame.maps.items() if name in names},
        )
        for frame in shown  # a row that was broken off is not among them
    ]
    frames_of = sorted({number for one in found for number in one.frames})

    def lines(value: Callable[[metrics.Scores], float]) -> list[Line]:
        return [Line(one.row.name, list(one.frames), [value(score) for score in one.frames.values()]) for one in found]

    curves = [
        page.plot(
            lines(lambda score: score.psnr), title="PSNR, dB: orange left, blue right", frames=frames_of, follow=True
        ),
        page.plot(
            lines(lambda score: score.temporal),
            title="temporal error: orange left, blue right",
            frames=frames_of,
            follow=True,
        ),
    ]
    told = [("pictures", pieces.pictures_of(shown, len(frames_of))), ("rows", str(len(found)))]
    return page.document(
        title,
        [
            pieces.title(title, "What each part of the filter is worth: each row differs from the base in one thing."),
            page.listed(notes),
            page.table(*table),
            page.viewer(shown, left=found[0].row.name, right=found[-1].row.name, legends=legends()),
            pieces.plots(curves),
            f"<h2>Which channel plays which role</h2><pre>{page.escape(roles)}</pre>",
            pieces.parameters(values),
            pieces.versions(told),
        ],
    )


def _run_frames(run: Run, done: Sequence[tuple[int, int, Path]]) -> tuple[list[Shown], list[metrics.Scores | None]]:
    """What is shown of a run, and the scores of all frames that have a reference; each output is read once."""
    chosen = page.evenly([number for _, number, _ in done], MOST)
    shown: list[Shown] = []

    def pairs() -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
        for index, number, path in done:
            if number not in chosen and number not in run.references:
                yield np.zeros(0), None
                continue
            image = exr.read(path)
            result = beauty(image)
            reference = run.references.get(number)
            target = None if reference is None else read_reference(reference, size=result.shape[:2], number=number)
            if number in chosen:
                pictures = {"denoised": result}
                if run.source.sequence.files[index][1] is not None:
                    pictures = {"noisy": _noisy(frames.read_frame(run.source, index))} | pictures
                maps = run.maps.get(number) or diagnostic_layers(image, params=run.params._asdict())
                look = partial(shown_frame, exposure=run.options.exposure, curve=run.options.tonemap)
                shown.append(look(number, pictures, target, {"denoised": maps}, len(chosen)))
            yield result, target

    return shown, list(metrics.score_frames(pairs(), with_ssim=False))


def _noisy(item: frames.LoadedFrame) -> np.ndarray:
    """The beauty before the filter, what is not finite in it as 0."""
    frame = item.frame
    return np.nan_to_num(frame.radiance.sum(0) + frame.emission, nan=0.0, posinf=0.0, neginf=0.0)


def _recorded(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters and choices that an output's header says, as `outputs.numbers` writes them; {} where it says none such."""
    try:
        found = json.loads(str(attributes.get("svgf_jax:parameters", "{}")))
    except (ValueError, RecursionError):
        return {}

    def sound(name: str, table: object) -> bool:
        kinds = int | float if name == "parameters" else int | float | str
        values = list(table.values()) if isinstance(table, dict) else [None]
        each = [one for value in values for one in (value if isinstance(value, list) else [value])]
        return all(isinstance(one, kinds) and len(str(one)) < 100 for one in each)

    return found if isinstance(found, dict) and all(sound(*entry) for entry in found.items()) else {}


def _noisy_line(shown: Sequence[Shown]) -> dict[str, dict[int, metrics.Scores]]:
    """The PSNR before the filter, of the frames that are shown."""
    nothing = [math.nan] * (len(metrics.Scores._fields) - 1)
    known = {frame.number: metrics.Scores(frame.psnr["noisy"], *nothing) for frame in shown if "noisy" in frame.psnr}
    return {"noisy": known} if known else {}


def _from_start(seconds: Sequence[float]) -> list[float]:
    """When each frame was done, by how long after the one before: reading, filtering and writing overlap, so that says little."""
    total = np.nancumsum(seconds)
    return [math.nan if math.isnan(one) else float(at) for one, at in zip(seconds, total, strict=True)]


def _speed(seconds: Sequence[float]) -> list[tuple[str, str]]:
    """The first frame, which compiles, and the mean of the others."""
    known = [one for one in seconds if math.isfinite(one)]
    if len(known) < 2:
        return []
    rest = sum(known[1:]) / (len(known) - 1)
    return [
        ("seconds, first frame", f"{known[0]:.2f}, compilation included"),
        ("seconds a frame, the others", f"{rest:.3g}"),
    ]


def _score_cells(score: metrics.Scores | None) -> tuple[str, str]:
    if score is None:
        return "", ""
    return f"{score.psnr:.2f}", "" if math.isnan(score.temporal) else f"{score.temporal:.5f}"


def _cells(seconds: float, repaired: float, history: float) -> tuple[str, ...]:
    forms = ((seconds, "{:.2f}"), (repaired, "{:.0f}"), (history, "{:.2f}"))
    return tuple(UNKNOWN if math.isnan(value) else form.format(value) for value, form in forms)


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else math.nan
