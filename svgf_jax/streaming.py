"""A whole sequence from disk to disk: read ahead, filter, write behind, resume. Memory does not grow with its length.

JAX is imported once the first frame has been read, so that every error before that is answered at once.
"""

import contextlib
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from svgf_jax import __version__, checkpoint, exr, frames, memory, outputs, preview, tonemapping
from svgf_jax.checkpoint import Checkpoint
from svgf_jax.compiled import Filters, Pipeline, check_devices, compile_filters, to_host, wait
from svgf_jax.methods import MethodConfig
from svgf_jax.outputs import WriteOptions
from svgf_jax.plan import Files, Plan, begin, check_there, locked, make_plan, stamp, stamp_frame
from svgf_jax.threads import Submit, read_ahead, write_behind
from svgf_jax.types import Config, Frame, History, Output, Params, SvgfError

MANY_PIXELS = 2**20
"""Frames of more are read and written one at a time, for the sake of memory."""

_NEVER_READ = ("illumination", "variance_filtered")
_DIAGNOSTICS = ("variance", "change", "valid")


class FrameReport(NamedTuple):
    """What became of one frame.

    Attributes:
        number: the frame number.
        status: "filtered", "held" (missing: the frame before it written again), "skipped" (missing: nothing written) or
            "warm-up" (before the range that is written).
        path: the output, None if skipped or before the range.
        counts: pixels repaired on loading, before filtering and on writing, by reason, and those of the output that are
            `not_finite`, which should never happen; only those above 0.
        notes: anything else worth telling, as sentences.
        history: mean history length of its surfaces in frames; None if there are none, or nothing was filtered.
        seconds: since the frame before was complete, or since the run began: reading, filtering and writing, which
            overlap, and for the first the compilation too.
    """

    number: int
    status: str
    path: Path | None
    counts: dict[str, int]
    notes: tuple[str, ...]
    history: float | None = None
    seconds: float = 0.0


class Summary(NamedTuple):
    """What a run did.

    Attributes:
        out: the output folder.
        frames: frames in the sequence, those that only warm up included.
        resumed_at: how many of them an earlier run had done; 0 unless resumed.
        statuses: frames of this run by status (see `FrameReport`).
        counts: repaired and not finite pixels by reason, summed over this run's frames.
        notes: each distinct note of this run's frames.
        interrupted: stopped before the end; `run(..., resume=True)` continues.
        device: what computed, for example "cpu"; "" if there was nothing left to do.
        video: the video, if one was written.
        seconds: wall-clock time of this run, compilation included.
    """

    out: Path
    frames: int
    resumed_at: int
    statuses: dict[str, int]
    counts: dict[str, int]
    notes: tuple[str, ...]
    interrupted: bool
    device: str
    video: Path | None
    seconds: float


def run(
    source: frames.Source,
    out: str | Path,
    *,
    params: Any = Params(),
    config: Config | MethodConfig = Config(),
    method: str = "svgf",
    preset: str = "",
    options: WriteOptions = WriteOptions(),
    video: bool = False,
    fps: float = 24.0,
    resume: bool = False,
    overwrite: bool = False,
    device: str | None = None,
    devices: int = 1,
    checkpoint_every: int = 8,
    threads: int | None = None,
    on_frame: Callable[[FrameReport], None] = lambda report: None,
    on_output: Callable[[frames.LoadedFrame, Output], object] | None = None,
    stop: Callable[[], bool] = lambda: False,
    pipeline: Pipeline | None = None,
) -> Summary:
    """Denoise `source` into the folder `out`, one EXR a frame under the input's name.

    Every file appears complete or not at all. Every `checkpoint_every` frames, once their outputs are on disk, the
    history is saved; `resume` continues after that, rewriting what came later, and the result is the same bit for bit.
    A missing frame is held (the output before it is written again, the history kept) or resets the history, as
    `source.sequence.missing` says. The first `source.sequence.warmup` frames are filtered and not written; runs of several
    such parts of a sequence may write into one folder at a time.

    Args:
        params, config: of `svgf_jax.step`, or of a method of `svgf_jax.methods`: which it is, is told by `config`.
        method, preset: the names written into the outputs' attributes.
        video: also encode `OUT/NAME.mp4` at `fps` once all frames are there.
        resume: continue an interrupted run; begin one where there is none. Excludes `overwrite`.
        overwrite: replace outputs that exist; without it they are an error.
        device: "cpu", "gpu", "gpu:1", ...; None takes JAX's default.
        devices: divide the rows of each frame over so many devices of that kind.
        threads: frames read ahead, and outputs written behind; 1 = by one thread, in turn. None = 2, or 1 where frames are so
            large that memory counts.
        on_frame: called in this thread for each frame once its output is complete, in order.
        on_output: called in a background thread with each filtered frame and its output, NumPy arrays, before that is written;
            frames may come in another order. Its `illumination` and `variance_filtered` are None.
        stop: asked after each frame; True ends the run with a checkpoint.
        pipeline: `(init, step)` in place of the library's.

    Raises:
        SvgfError: an option out of range (before any work), unreadable or mismatching input, an unusable output folder,
            existing outputs, a checkpoint of another computation, a full disk. What is complete stays, and `resume`
            continues from there.
    """
    began = time.monotonic()
    threads = (1 if _pixels(source) > MANY_PIXELS else 2) if threads is None else threads
    if checkpoint_every < 1 or threads < 1:
        raise SvgfError(f"Got checkpoint_every {checkpoint_every} and threads {threads}; wanted at least 1 of each.")
    check_devices(config, device, devices)
    plan, provenance = prepare(
        source, out, params=params, config=config, method=method, preset=preset, options=options, video=video, fps=fps
    )
    statuses: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    notes: list[str] = []
    device_name: list[str] = []

    complete_at = began

    def done(report: FrameReport | None) -> None:
        nonlocal complete_at
        if report is not None:
            now = time.monotonic()
            report, complete_at = report._replace(seconds=now - complete_at), now
            still_locked()
            checkpoint.append_figures(plan.state, report._asdict())
            statuses[report.status] += 1
            counts.update(report.counts)
            notes[:] = frames.told_once([*notes, *report.notes])
            on_frame(report)

    def filters() -> Filters:
        leave_out = _NEVER_READ if options.diagnostics or on_output else _NEVER_READ + _DIAGNOSTICS
        made = compile_filters(params, config, device=device, devices=devices, pipeline=pipeline, leave_out=leave_out)
        device_name.append(made.device)
        return made

    with locked(plan) as still_locked:
        start = begin(plan, resume=resume, overwrite=overwrite)
        end = len(plan.files)
        if start is not None:
            read = partial(_read, source, plan)
            write = partial(_write, source, plan, options, provenance, on_output, still_locked)
            fill_gap = partial(_fill_gap, plan, still_locked)
            save = partial(_save, plan, still_locked)
            workers = threads if threads == 1 else 2 * threads  # one writes a frame before it reads the next
            with (
                ThreadPoolExecutor(workers, thread_name_prefix="svgf-files") as pool,
                write_behind(done, threads=threads, pool=pool) as submit,
                contextlib.closing(
                    read_ahead(read, range(start.next_index, end), threads=threads, pool=pool)
                ) as loaded,
            ):
                keep = on_output is not None
                end = _filter(
                    plan,
                    start,
                    loaded,
                    filters,
                    write,
                    fill_gap,
                    save,
                    submit,
                    stop,
                    checkpoint_every,
                    keep_frames=keep,
                )
        if start is not None and end == len(plan.files):
            still_locked()
            check_there(plan, end, ending=True)
            if plan.video is not None:
                preview.write_video(plan.video, _pictures(plan, options), fps=fps)
            checkpoint.save_run(plan.state, plan.identity, complete=True)
            checkpoint.remove_checkpoint(plan.state)
    return Summary(
        out=plan.out,
        frames=len(plan.files),
        resumed_at=len(plan.files) if start is None else start.next_index,
        statuses=dict(statuses),
        counts=dict(counts),
        notes=tuple(notes),
        interrupted=end < len(plan.files),
        device="".join(device_name),
        video=plan.video if end == len(plan.files) else None,
        seconds=time.monotonic() - began,
    )


def prepare(
    source: frames.Source,
    out: str | Path,
    *,
    params: Any,
    config: Config | MethodConfig,
    method: str,
    preset: str,
    options: WriteOptions,
    video: bool,
    fps: float,
) -> tuple[Plan, dict[str, str]]:
    """What `run` will write, and the attributes that its outputs get. Options, and what is raised, are those of `run`."""
    tonemapping.check_exposure(options.exposure)
    preview.frame_rate(fps)
    if video:
        preview.require_video()
    provenance = outputs.attributes(
        os.path.abspath(source.sequence.name), method=method, preset=preset, params=params, config=config
    )
    plan = make_plan(
        source.sequence.files,
        Path(out),
        hold=source.sequence.missing == "hold",
        png=options.png,
        video=video,
        warmup=source.sequence.warmup,
        identity=_identity(source, options, provenance) | outputs.numbers(params, config),
        others=[other.files for other in source.files.values()] + _camera_files(source),
    )
    return plan, provenance


def _filter(
    plan: Plan,
    start: Checkpoint,
    loaded: Iterator[frames.LoadedFrame | None],
    make_filters: Callable[[], Filters],
    write: Callable[[int, frames.LoadedFrame, Output], FrameReport],
    fill_gap: Callable[[int], FrameReport],
    save_state: Callable[[Checkpoint], None],
    submit: Submit,
    stop: Callable[[], bool],
    checkpoint_every: int,
    *,
    keep_frames: bool,
) -> int:
    """Filter frame after frame, leaving the writing to `submit`; how many of the sequence's frames are done then."""
    history, filters = start.history, None

    def save(index: int) -> None:
        # A copy: the next step takes the history's memory.
        kept = None if history is None else to_host(history, plan.files[index - 1][1] or "")
        submit(partial(save_state, Checkpoint(index, kept)), after_all=True)

    for index in range(start.next_index, len(plan.files)):
        try:
            item = next(loaded)
            if item is not None:
                _check_size(item, history)
        except SvgfError:
            if index > start.next_index:
                save(index)
            raise
        if item is None:
            if not plan.hold:
                history = None
            submit(partial(fill_gap, index), after_all=True)
        else:
            filters = filters or make_filters()
            history, output = filters.step(filters.init(item.frame) if history is None else history, item.frame)
            if not keep_frames:  # what is written needs only the input's other layers
                item = item._replace(frame=None)  # type: ignore[arg-type]
            wait(output, item.path)  # before the next frame is read: frames take memory
            submit(partial(write, index, item, output))
        if stop() and index + 1 < len(plan.files):
            save(index + 1)
            return index + 1
        at_end = index + 1 == len(plan.files)
        if plan.video is not None if at_end else (index + 1) % checkpoint_every == 0:
            save(index + 1)  # at the end only for the sake of the video, which could be interrupted too
    return len(plan.files)


def _save(plan: Plan, still_locked: Callable[[], None], state: Checkpoint) -> None:
    """Keep the history. Runs in a background thread, once every output before is complete."""
    still_locked()
    checkpoint.save_checkpoint(plan.state, plan.identity, state)


def _identity(source: frames.Source, options: WriteOptions, provenance: Mapping[str, str]) -> checkpoint.Identity:
    """Whatever the outputs depend on, but for the parameters and the input frames."""
    return {
        "version": __version__,
        "attributes": {name: provenance[name] for name in ("svgf_jax:preset", "svgf_jax:source")},
        "options": options._asdict(),
        "roles": {role: [*layer.channels, layer.meaning] for role, layer in source.roles.layers.items()},
        "signals": list(source.roles.signals),
        "cameras": None if source.cameras is None or source.cameras.files else stamp(source.cameras.path),
        "missing": source.sequence.missing,
    }


def _camera_files(source: frames.Source) -> list[Files]:
    """The camera file of each frame, where each has its own."""
    return [source.cameras.files] if source.cameras and source.cameras.files else []


def _read(source: frames.Source, plan: Plan, index: int) -> frames.LoadedFrame | None:
    """One frame. Of a file that was replaced since the run began, the new content counts, and the run's record says so."""
    if source.sequence.files[index][1] is None:
        return None
    before = stamp_frame(plan, index)
    item = frames.read_frame(source, index)
    if stamp_frame(plan, index) != before:
        raise SvgfError(f"{item.path}: changed while it was read. Go on with --resume once it is complete.")
    if before != plan.identity["frames"][index]:
        plan.identity["frames"][index] = before
        item = item._replace(
            notes=(*item.notes, f"{item.path} changed while the run went on; taken as it was when read")
        )
    if (np.asarray(item.frame.object_id) == -1).all():
        item = item._replace(notes=(*item.notes, "a frame without any surface: it passed through unfiltered"))
    frame, item = list(item.frame), item._replace(frame=None)  # type: ignore[arg-type]
    return item._replace(frame=Frame(*memory.aligned(frame)))


def _pixels(source: frames.Source) -> int:
    left, top, right, bottom = source.data_window
    return (right - left + 1) * (bottom - top + 1)


def _check_size(item: frames.LoadedFrame, history: History | None) -> None:
    """A history holds only for frames of its own size."""
    if history is None:
        return
    then, now = history.illumination.shape[1:3], item.frame.depth.shape
    if then != now:
        raise SvgfError(
            f"{item.path}: this frame is {now[1]} x {now[0]} pixels, the one before it {then[1]} x {then[0]}; wanted one "
            "size throughout. Denoise each part as a sequence (--frames)."
        )


def _write(
    source: frames.Source,
    plan: Plan,
    options: WriteOptions,
    provenance: Mapping[str, str],
    on_output: Callable[[frames.LoadedFrame, Output], object] | None,
    still_locked: Callable[[], None],
    index: int,
    item: frames.LoadedFrame,
    output: Output,
) -> FrameReport:
    """Bring one frame's output to the host and onto the disk. Runs in a background thread."""
    path = plan.outputs[index]
    if path is None:
        return FrameReport(plan.files[index][0], "warm-up", None, {}, ())
    output = to_host(output, item.path)
    if on_output is not None:
        on_output(item, output)
    image, clipped = outputs.compose(
        output, item.image, options=options, signals=source.roles.signals, attributes=provenance
    )
    notes = list(item.notes)
    still_locked()
    if dropped := outputs.write_frame(path, image, options=options):
        notes.append(f"header attributes that could not be passed through: {', '.join(dropped)}")
    broken = int(np.count_nonzero(~np.isfinite(output.image).all(axis=-1)))
    rejected = {name: int(count) for name, count in output.rejected._asdict().items()}
    counts = Counter(item.counts) + Counter(rejected) + Counter(clipped=clipped, not_finite=broken)
    lengths = output.history_length[output.history_length > 0]
    history = float(np.mean(lengths)) if lengths.size else None
    return FrameReport(plan.files[index][0], "filtered", path, dict(counts), tuple(notes), history)


def _fill_gap(plan: Plan, still_locked: Callable[[], None], index: int) -> FrameReport:
    """Stand in for a missing frame: the output before it again, or nothing. Runs once that output is complete."""
    number, path = plan.files[index][0], plan.outputs[index]
    if index < plan.warmup:
        return FrameReport(number, "warm-up", None, {}, ())
    if path is None:
        return FrameReport(number, "skipped", None, {}, ())
    before = plan.outputs[index - 1]
    assert before is not None  # the first frame of a plan that holds is there
    still_locked()
    for suffix in (".exr", ".png") if plan.png else (".exr",):
        preview.copy_file(before.with_suffix(suffix), path.with_suffix(suffix))
    return FrameReport(number, "held", path, {}, ())


def _pictures(plan: Plan, options: WriteOptions) -> Iterator[np.ndarray]:
    """The outputs as 8-bit pictures, read back one at a time."""
    for path in plan.outputs:
        if path is not None:
            yield preview.to_8bit(outputs.beauty(exr.read(path)), exposure=options.exposure, curve=options.tonemap)
