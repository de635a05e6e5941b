"""What `svgf-jax denoise` tells of its input before it starts, and all that `--dry-run` does."""

import os
import shutil
from typing import TYPE_CHECKING, Any

from svgf_jax.commands import terminal
from svgf_jax.types import SvgfError

if TYPE_CHECKING:
    from svgf_jax.frames import Source
    from svgf_jax.outputs import WriteOptions
    from svgf_jax.plan import Plan
    from svgf_jax.scan import Scan


def describe_input(source: "Source") -> str:
    """One line: name, frames, size."""
    from svgf_jax.sequences import format_range

    numbers = [number for number, path in source.sequence.files if path is not None]
    left, top, right, bottom = source.data_window
    gaps = len(source.sequence.files) - len(numbers)
    earlier = [number for number, _ in source.sequence.files[: source.sequence.warmup or 0]]
    warming = f", of which {format_range(earlier)} only to warm up" if earlier else ""
    return (
        f"input: {source.sequence.name}, {terminal.count(len(numbers), 'frame')} ({format_range(numbers)}{warming})"
        f"{f', {gaps} missing' if gaps else ''}, {right - left + 1} x {bottom - top + 1}"
    )


def rehearse(
    source: "Source",
    scan: "Scan",
    plan: "Plan",
    *,
    config: Any,
    options: "WriteOptions",
    resume: bool,
    overwrite: bool,
) -> dict[str, Any]:
    """Check and tell what a run would do; the same as a dictionary. Writes nothing.

    Raises SvgfError where the run would not start, or its outputs would hardly fit onto the disk.
    """
    from svgf_jax.estimates import estimate
    from svgf_jax.plan import check_writable, find_start, written

    check_writable(plan.out)
    start = find_start(plan, resume=resume, overwrite=overwrite)
    left, top, right, bottom = source.data_window
    pixels = (right - left + 1) * (bottom - top + 1)
    needs = estimate(scan, pixels=pixels, signals=len(source.roles.signals), config=config, options=options)
    done = len(plan.files) if start is None else start.next_index
    todo = sum(path is not None for _, path in plan.files[done:])
    files = [path for path in written(plan) if path not in set(written(plan, done))] if done else list(written(plan))
    disk = needs.disk * sum(path is not None for path in plan.outputs[done:]) / max(len(scan.there), 1)
    folder = next(path for path in (plan.out, *plan.out.absolute().parents) if path.exists())
    free = shutil.disk_usage(folder).free
    memory, available = needs.memory, _memory()
    if disk > free:
        raise SvgfError(
            f"{plan.out}: the outputs may take {terminal.size(disk)}, but only {terminal.size(free)} are free there. "
            "Choose another output folder, or leave layers out (--only-denoised)."
        )
    terminal.tell(f"would filter {terminal.count(todo, 'frame')} and write {terminal.count(len(files), 'file')}")
    if files:
        terminal.tell(f"first: {files[0]}")
        terminal.tell(f"last:  {files[-1]}")
    terminal.tell(
        f"about {terminal.duration(needs.seconds * todo)} on two cores after compiling ({needs.seconds:.2g} s a frame), "
        f"{terminal.size(memory)} of memory, at most {terminal.size(disk)} of disk"
    )
    if available and memory > available:
        terminal.warn(
            [f"only {terminal.size(available)} of memory are available here; crop the frames, or close other programs."]
        )
    terminal.tell("dry run: nothing was written")
    return {
        "out": plan.out,
        "frames": todo,
        "done_before": done,
        "files": files,
        "seconds": needs.seconds * todo,
        "memory": memory,
        "disk": disk,
    }


def _memory() -> int:
    """Bytes of memory that are available; 0 where the system does not say."""
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return 0
