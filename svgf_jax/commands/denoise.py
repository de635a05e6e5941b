"""`svgf-jax denoise`."""

import shlex
import signal
import sys
from collections.abc import Generator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter

from svgf_jax.commands import results, settings, several, terminal
from svgf_jax.commands.completing import PRESET
from svgf_jax.commands.rehearsal import describe_input, rehearse
from svgf_jax.commands.settings import INPUT, Flag, Reading, Repeated
from svgf_jax.processes import check_meeting, leave, meet
from svgf_jax.types import SvgfError

if TYPE_CHECKING:
    from svgf_jax.streaming import Summary

Compression = Literal["none", "rle", "zips", "zip", "piz", "pxr24", "dwaa", "dwab"]
HEADERS = 200  # of frames that are looked at before a run starts: a fifth of a second
FILTER, OUTPUT, RUN = (Group(name, sort_key=i) for i, name in enumerate(["Filter", "Output", "Run"], 1))


def denoise(
    inputs: Annotated[tuple[str, ...], Parameter(name="INPUT", group=INPUT)],
    /,
    *,
    out: Annotated[Path, Parameter(name=["--out", "-o"], metavar="FOLDER", group=OUTPUT)],
    frames: Annotated[str | None, Parameter(metavar="RANGE", group=INPUT)] = None,
    missing: Annotated[Literal["error", "hold", "reset"], Parameter(group=INPUT)] = "error",
    warmup: Annotated[int | None, Parameter(metavar="FRAMES", group=INPUT)] = None,
    reading: Reading = Reading(),
    method: Annotated[settings.Method, Parameter(group=FILTER)] = "svgf",
    preset: Annotated[str | None, PRESET, Parameter(metavar="NAME", group=FILTER)] = None,
    params: Annotated[Path | None, Parameter(metavar="FILE.toml", group=FILTER)] = None,
    set_: Annotated[tuple[str, ...], Repeated, Parameter(name="--set", metavar="NAME=VALUE", group=FILTER)] = (),
    taa: Annotated[bool, Flag, Parameter(group=FILTER)] = False,
    device: Annotated[str | None, Parameter(metavar="DEVICE", group=FILTER)] = None,
    devices: Annotated[int, Parameter(metavar="N", group=FILTER)] = 1,
    float_: Annotated[bool, Flag, Parameter(name="--float", group=OUTPUT)] = False,
    compression: Annotated[Compression, Parameter(group=OUTPUT)] = "zip",
    only_denoised: Annotated[bool, Flag, Parameter(group=OUTPUT)] = False,
    diagnostics: Annotated[bool, Flag, Parameter(group=OUTPUT)] = False,
    png: Annotated[bool, Flag, Parameter(group=OUTPUT)] = False,
    video: Annotated[bool, Flag, Parameter(group=OUTPUT)] = False,
    fps: Annotated[float, Parameter(group=OUTPUT)] = 24.0,
    exposure: Annotated[float, Parameter(group=OUTPUT)] = 1.0,
    tonemap: Annotated[settings.Tonemap, Parameter(group=OUTPUT)] = "reinhard-extended",
    report: Annotated[Path | None, Parameter(metavar="FILE.html", group=OUTPUT)] = None,
    reference: Annotated[str | None, Parameter(metavar="REF", group=OUTPUT)] = None,
    tev: Annotated[bool, Flag, Parameter(group=OUTPUT)] = False,
    tev_address: Annotated[str | None, Parameter(metavar="HOST:PORT", group=OUTPUT)] = None,
    overwrite: Annotated[bool, Flag, Parameter(group=RUN)] = False,
    resume: Annotated[bool, Flag, Parameter(group=RUN)] = False,
    checkpoint_every: Annotated[int, Parameter(metavar="FRAMES", group=RUN)] = 8,
    split: Annotated[int | None, Parameter(metavar="FRAMES", group=RUN)] = None,
    distributed: Annotated[bool, Flag, Parameter(group=RUN)] = False,
    coordinator: Annotated[str | None, Parameter(metavar="HOST:PORT", group=RUN)] = None,
    processes: Annotated[int | None, Parameter(metavar="N", group=RUN)] = None,
    process: Annotated[int | None, Parameter(metavar="I", group=RUN)] = None,
    dry_run: Annotated[bool, Flag, Parameter(group=RUN)] = False,
    json: Annotated[bool, Flag, Parameter(group=RUN)] = False,
    verbose: Annotated[bool, Flag, Parameter(name=["--verbose", "-v"], group=RUN)] = False,
) -> int:
    """Denoise a sequence of EXR files into a folder, one file a frame under the input's name.

    Args:
        inputs: Folder, pattern (frame_####.exr, frame_%04d.exr, frame_$F4.exr) or file; of several, each gets a folder in --out.
        out: The output folder; made if it is not there.
        frames: Only these: 1-100, 1-100x2 or 1,3,5-9.
        missing: A missing frame is an error, repeats the output before it (hold), or starts the history anew (reset).
        warmup: Filter so many frames before --frames too, to fill the history, and don't write them: the task of a render
            farm. Such parts of a sequence may be written into one folder at a time.
        method: games202: joint bilateral, then project and accumulate; the others are parts, -atrous in a-trous passes.
        preset: A preset of svgf by name; `svgf-jax params list` shows them.
        params: Parameters from a TOML file; `svgf-jax params show` prints one.
        set_: One parameter, or one value per a-trous level: sigma_normal=64, sigma_luminance=4,3,2,1,1. Repeatable.
        taa: Temporal anti-aliasing of the result; the same as --set taa=true. Of svgf only.
        device: cpu, gpu, gpu:1, ...; what JAX chooses if not given.
        devices: Divide the rows of each frame over so many devices of that kind.
        float_: Write 32-bit float instead of 16-bit.
        compression: EXR compression of the output.
        only_denoised: Leave out the input's other layers and header attributes.
        diagnostics: Add the layers svgf.variance.*, svgf.effective_history.*, svgf.history_length, svgf.valid, and with preset
            adaptive svgf.change.*.
        png: Also write a tone-mapped PNG of each frame.
        video: Also write an MP4 of the whole (needs the extra `video`).
        fps: Frames per second of the video.
        exposure: Brightness factor of PNG, video and report.
        tonemap: Tone curve of PNG, video and report.
        report: Also write one page to look at: pictures, maps, curves, and all that was chosen.
        reference: References for the report, paired by number: it then tells the error too.
        tev: Also send each frame to a running tev viewer (needs the extra `tev`).
        tev_address: The same, to where tev listens; localhost:14158 if not given.
        overwrite: Replace outputs that exist.
        resume: Continue an interrupted run where its last checkpoint is; the result is the same bit for bit.
        checkpoint_every: Save the history for --resume after so many frames.
        split: Cut each input into ranges of so many frames, each a run of its own that warms up (--warmup, 32 if not given).
        distributed: Share the inputs and ranges with the other processes of this job: of Slurm, Kubernetes or MPI, or by hand.
        coordinator: By hand: where process 0 is to be reached.
        processes: By hand: how many there are.
        process: By hand: which this is, from 0 on.
        dry_run: Check everything, tell what would be done and about what it would take, and write nothing.
        json: Print a summary as JSON to the standard output; all else goes to the standard error.
        verbose: Also tell what is not there, the parameters and the device.
    """
    if not inputs:
        raise SvgfError("Got no input; wanted a folder, a pattern or a file: svgf-jax denoise INPUT -o FOLDER.")
    check_meeting(distributed, coordinator, processes, process)
    if distributed or split is not None or len(inputs) > 1:
        return _several(dict(locals()))
    input_ = next(iter(inputs))
    changes = (*set_, "taa=true") if taa else set_
    chosen_preset, chosen, config = settings.choose_method(method, preset, params, changes)
    opened = reading.options()
    if reference is not None and report is None:
        raise SvgfError(f"Got --reference {reference} without --report; references are for the report.")
    results.require_writable((report,), overwrite=overwrite or resume)

    from svgf_jax import memory, streaming
    from svgf_jax import report as reports
    from svgf_jax.frames import open_source
    from svgf_jax.outputs import WriteOptions, numbers
    from svgf_jax.references import pair_references
    from svgf_jax.scan import require_sound, scan_files
    from svgf_jax.tev import ADDRESS
    from svgf_jax.tev import tev as send_to_tev

    source = open_source(
        input_,
        frames=frames,
        missing=missing,
        warmup=warmup,
        **opened,
        position=getattr(config, "filter", "") == "joint-bilateral",
    )
    scan = scan_files(source, most=None if dry_run else HEADERS)
    require_sound(scan)
    terminal.tell(describe_input(source))
    terminal.tell(source.roles.describe(absent=verbose))
    terminal.warn(source.warnings)
    if verbose:
        values = numbers(chosen, config)
        listed = ", ".join(f"{name} {value}" for name, value in (values["parameters"] | values["config"]).items())
        terminal.tell(f"{'preset' if method == 'svgf' else 'method'} {chosen_preset}: {listed}")
    options = WriteOptions(float_, compression, only_denoised, diagnostics, png, exposure, tonemap)
    shown = None
    if report is not None:
        references, lacking = ({}, ()) if reference is None else pair_references(source.sequence, reference)
        terminal.warn(lacking)
        shown = reports.Run(source, out, method, chosen_preset, chosen, config, options, references, {})
    task: dict[str, Any] = {"params": chosen, "config": config, "method": method, "preset": chosen_preset}
    task |= {"options": options, "video": video, "fps": fps}
    viewer = nullcontext()
    if tev or tev_address is not None:
        viewer = send_to_tev(tev_address or ADDRESS, tell=lambda text: terminal.warn([text]))
    if dry_run:
        with viewer as reached:
            pass
        plan, _ = streaming.prepare(source, out, **task)
        told = rehearse(source, scan, plan, config=config, options=options, resume=resume, overwrite=overwrite)
        if reached is not None:
            terminal.tell(f"tev listens at {tev_address or ADDRESS}")
        if json:
            terminal.print_json(told | {"method": method, "preset": chosen_preset} | numbers(chosen, config))
        return 0
    watch = None if shown is None else reports.watch(shown)
    memory.give_back_large()
    with (
        viewer as send,
        _until_interrupted() as interruption,
        terminal.progress(len(source.sequence.files)) as on_frame,
    ):
        looks = [look for look in (watch, send) if look is not None]
        summary = streaming.run(
            source,
            out,
            **task,
            resume=resume,
            overwrite=overwrite,
            device=device,
            devices=devices,
            checkpoint_every=checkpoint_every,
            on_frame=on_frame,
            stop=lambda: bool(interruption),
            on_output=(lambda item, output: [look(item, output) for look in looks]) if looks else None,
        )
    _conclude(summary, verbose=verbose)
    if report is not None and shown is not None:
        results.save(report, reports.run_page(shown, summary, repairs=terminal.repairs))
        terminal.tell(f"report: {report}")
    if json:
        terminal.print_json(summary._asdict() | {"method": method, "preset": chosen_preset} | numbers(chosen, config))
    if summary.interrupted:
        again = [argument for argument in sys.argv[1:] if argument != "--overwrite"]
        again = again if "--resume" in again else [*again, "--resume"]
        terminal.tell(f"interrupted; every file in {out} is complete. Continue with: svgf-jax {shlex.join(again)}")
        return 128 + interruption[0]
    return 0


def _several(given: dict[str, Any]) -> int:
    """`denoise` for each task of many; `given` are its arguments."""
    (inputs, out, frames, warmup, split) = (given.pop(name) for name in ("inputs", "out", "frames", "warmup", "split"))
    distributed, resume, overwrite = (given.pop(name) for name in ("distributed", "resume", "overwrite"))
    meeting = [given.pop(name) for name in ("coordinator", "processes", "process")]
    for name in ("report", "reference", "tev_address", "tev", "json"):
        if given[name] not in (None, False):
            raise SvgfError(
                f"Got --{name.replace('_', '-')} for several runs; wanted one input, without --split and --distributed."
            )
    if distributed and overwrite:
        raise SvgfError(
            "Got --distributed and --overwrite; wanted an empty output folder, or one to go on in: a process could not tell what "
            "another has just written from what is to be replaced."
        )
    settings.choose_method(given["method"], given["preset"], given["params"], given["set_"])
    tasks = several.plan_tasks(
        inputs, out, frames=frames, warmup=warmup, split=split, missing=given["missing"], **given["reading"].options()
    )

    def run(task: several.Task) -> int:
        again = {"resume": resume or distributed, "overwrite": overwrite}
        return denoise((task.shot,), out=task.out, frames=task.frames, warmup=task.warmup, **again, **given)

    if given["dry_run"]:
        return max([run(task) for task in tasks])
    if not distributed:
        return several.deal(tasks, run)
    me = meet(*meeting)
    try:
        locks = several.locks_reach(out, me)
    finally:
        leave(me)
    if not locks:
        terminal.warn(
            [f"{out}: locks do not reach from machine to machine there; nobody takes over what a process leaves"]
        )
    return several.deal(tasks, run, rank=me.rank, size=me.size, locks=locks)


def _conclude(summary: "Summary", *, verbose: bool) -> None:
    """Tell what was done, and every repair and oddity on the way."""
    done = sum(summary.statuses.values())
    terminal.warn(summary.notes)
    terminal.warn(terminal.repairs(summary.counts))
    if verbose and summary.device:
        terminal.tell(f"device: {summary.device}")
    if summary.resumed_at == summary.frames:
        terminal.tell(f"nothing to do: all {summary.frames} frames are in {summary.out} already")
    else:
        kinds = ", ".join(f"{count} {status}" for status, count in summary.statuses.items())
        before = f" after {summary.resumed_at} done before" if summary.resumed_at else ""
        terminal.tell(f"{done} frame{'s' * (done != 1)} ({kinds}){before} in {summary.seconds:.1f} s -> {summary.out}")
    if summary.video:
        terminal.tell(f"video: {summary.video}")


@contextmanager
def _until_interrupted() -> Generator[list[int]]:
    """A list that receives the number of a SIGINT, SIGTERM or SIGHUP; a second SIGINT interrupts at once."""
    received: list[int] = []

    def on_signal(number: int, _: object) -> None:
        received.append(number)
        if number == hangup:  # the terminal is gone
            terminal.silence(sys.stderr)
        terminal.tell("stopping after this frame" + ("; Ctrl-C again stops at once" if number == signal.SIGINT else ""))
        signal.signal(signal.SIGINT, signal.default_int_handler)

    hangup = getattr(signal, "SIGHUP", None)
    if hangup is not None and signal.getsignal(hangup) == signal.SIG_IGN:  # nohup
        hangup = None
    caught = [number for number in (signal.SIGINT, signal.SIGTERM, hangup) if number is not None]
    before = {number: signal.signal(number, on_signal) for number in caught}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
