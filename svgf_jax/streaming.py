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

from svgf_jax import __version__, checkpoint, filing, frames, outputs, preview, tonemapping
from svgf_jax.checkpoint import Checkpoint
from svgf_jax.compiled import Filters, Pipeline, check_devices, compile_filters, to_host, wait
from svgf_jax.filing import FrameReport, Work
from svgf_jax.methods import MethodConfig
from svgf_jax.outputs import WriteOptions
from svgf_jax.plan import Files, Plan, begin, check_there, locked, make_plan, stamp
from svgf_jax.threads import Submit, read_ahead, write_behind
from svgf_jax.types import Config, History, Output, Params, SvgfError

MANY_PIXELS = 2**20
"""Frames of more are read and written one at a time, for the sake of memory."""

_NEVER_READ = ("illumination", "variance_filtered")
_DIAGNOSTICS = ("variance", "change", "valid")


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
        looked_at = options.diagnostics or on_output is not None
        made = compile_filters(
            params,
            config,
            device=device,
            devices=devices,
            pipeline=pipeline,
            leave_out=_NEVER_READ if looked_at else _NEVER_READ + _DIAGNOSTICS,
            effective_history=looked_at,
        )
        device_name.append(made.device)
        return made

    with locked(plan) as still_locked:
        work = Work(source, plan, options, provenance, on_output, still_locked)
        start = begin(plan, resume=resume, overwrite=overwrite)
        end = len(plan.files)
        if start is not None:
            read = partial(filing.read, work)
            workers = threads if threads == 1 else 2 * threads  # one writes a frame before it reads the next
            with (
                ThreadPoolExecutor(workers, thread_name_prefix="svgf-files") as pool,
                write_behind(done, threads=threads, pool=pool) as submit,
                contextlib.closing(
                    read_ahead(read, range(start.next_index, end), threads=threads, pool=pool)
                ) as loaded,
            ):
                end = _filter(work, start, loaded, filters, submit, stop, checkpoint_every=checkpoint_every)
        if start is not None and end == len(plan.files):
            still_locked()
            check_there(plan, end, ending=True)
            if plan.video is not None:
                preview.write_video(plan.video, filing.pictures(work), fps=fps)
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
    work: Work,
    start: Checkpoint,
    loaded: Iterator[frames.LoadedFrame | None],
    make_filters: Callable[[], Filters],
    submit: Submit,
    stop: Callable[[], bool],
    *,
    checkpoint_every: int,
) -> int:
    """Filter frame after frame, leaving the writing to `submit`; how many of the sequence's frames are done then."""
    plan, history, filters = work.plan, start.history, None

    def save(index: int) -> None:
        # A copy: the next step takes the history's memory.
        kept = None if history is None else to_host(history, plan.files[index - 1][1] or "")
        submit(partial(filing.save, work, Checkpoint(index, kept)), after_all=True)

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
            submit(partial(filing.fill_gap, work, index), after_all=True)
        else:
            filters = filters or make_filters()
            history, output = filters.step(filters.init(item.frame) if history is None else history, item.frame)
            if work.on_output is None:  # what is written needs only the input's other layers
                item = item._replace(frame=None)  # type: ignore[arg-type]
            wait(output, item.path)  # before the next frame is read: frames take memory
            submit(partial(filing.write, work, index, item, output))
        if stop() and index + 1 < len(plan.files):
            save(index + 1)
            return index + 1
        at_end = index + 1 == len(plan.files)
        if plan.video is not None if at_end else (index + 1) % checkpoint_every == 0:
            save(index + 1)  # at the end only for the sake of the video, which could be interrupted too
    return len(plan.files)


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
