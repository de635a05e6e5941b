"""What background threads do while a sequence is filtered: read a frame, write an output, stand in for a missing one."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from svgf_jax import checkpoint, exr, frames, memory, outputs, preview
from svgf_jax.checkpoint import Checkpoint
from svgf_jax.compiled import to_host
from svgf_jax.outputs import WriteOptions
from svgf_jax.plan import Plan, stamp_frame
from svgf_jax.types import Frame, Output, SvgfError


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


class Work(NamedTuple):
    """What all of these jobs are about.

    Attributes:
        source: what is read.
        plan: what is written.
        options: how.
        provenance: attributes of the outputs.
        on_output: called with each filtered frame and its output, NumPy arrays, before that is written.
        still_locked: raises SvgfError once the output folder was removed; asked before anything is written into it.
    """

    source: frames.Source
    plan: Plan
    options: WriteOptions
    provenance: Mapping[str, str]
    on_output: Callable[[frames.LoadedFrame, Output], object] | None
    still_locked: Callable[[], None]


def read(work: Work, index: int) -> frames.LoadedFrame | None:
    """One frame. Of a file that was replaced since the run began, the new content counts, and the run's record says so."""
    plan = work.plan
    if plan.files[index][1] is None:
        return None
    before = stamp_frame(plan, index)
    item = frames.read_frame(work.source, index)
    if stamp_frame(plan, index) != before:
        raise SvgfError(f"{item.path}: changed while it was read. Go on with --resume once it is complete.")
    if before != plan.identity["frames"][index]:
        plan.identity["frames"][index] = before
        item = item._replace(
            notes=(*item.notes, f"{item.path} changed while the run went on; taken as it was when read")
        )
    if (np.asarray(item.frame.object_id) == -1).all():
        item = item._replace(notes=(*item.notes, "a frame without any surface: it passed through unfiltered"))
    # The item lets go of its frame, so that `aligned` frees each array as it moves it.
    frame, item = list(item.frame), item._replace(frame=None)  # type: ignore[arg-type]
    return item._replace(frame=Frame(*memory.aligned(frame)))


def write(work: Work, index: int, item: frames.LoadedFrame, output: Output) -> FrameReport:
    """Bring one frame's output to the host and onto the disk. Runs in a background thread."""
    number, path = work.plan.files[index][0], work.plan.outputs[index]
    if path is None:
        return FrameReport(number, "warm-up", None, {}, ())
    output = to_host(output, item.path)
    if work.on_output is not None:
        work.on_output(item, output)
    image, clipped = outputs.compose(
        output, item.image, options=work.options, signals=work.source.roles.signals, attributes=work.provenance
    )
    notes = list(item.notes)
    work.still_locked()
    if dropped := outputs.write_frame(path, image, options=work.options):
        notes.append(f"header attributes that could not be passed through: {', '.join(dropped)}")
    broken = int(np.count_nonzero(~np.isfinite(output.image).all(axis=-1)))
    rejected = {name: int(count) for name, count in output.rejected._asdict().items()}
    counts = Counter(item.counts) + Counter(rejected) + Counter(clipped=clipped, not_finite=broken)
    lengths = output.history_length[output.history_length > 0]
    history = float(np.mean(lengths)) if lengths.size else None
    return FrameReport(number, "filtered", path, dict(counts), tuple(notes), history)


def fill_gap(work: Work, index: int) -> FrameReport:
    """Stand in for a missing frame: the output before it again, or nothing. Runs once that output is complete."""
    plan = work.plan
    number, path = plan.files[index][0], plan.outputs[index]
    if index < plan.warmup:
        return FrameReport(number, "warm-up", None, {}, ())
    if path is None:
        return FrameReport(number, "skipped", None, {}, ())
    before = plan.outputs[index - 1]
    assert before is not None  # the first frame of a plan that holds is there
    work.still_locked()
    for suffix in (".exr", ".png") if plan.png else (".exr",):
        preview.copy_file(before.with_suffix(suffix), path.with_suffix(suffix))
    return FrameReport(number, "held", path, {}, ())


def save(work: Work, state: Checkpoint) -> None:
    """Keep the history. Runs in a background thread, once every output before is complete."""
    work.still_locked()
    checkpoint.save_checkpoint(work.plan.state, work.plan.identity, state)


def pictures(work: Work) -> Iterator[np.ndarray]:
    """The outputs as 8-bit pictures, read back one at a time."""
    exposure, curve = work.options.exposure, work.options.tonemap
    for path in work.plan.outputs:
        if path is not None:
            yield preview.to_8bit(outputs.beauty(exr.read(path)), exposure=exposure, curve=curve)
