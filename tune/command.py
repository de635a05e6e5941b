"""`svgf-tune`: options in, a parameter file out. Nothing here imports JAX or NumPy at the top: help and errors answer at once."""

import dataclasses
import os
import signal
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter

from svgf_jax import SvgfError
from svgf_jax.atomic import short
from svgf_jax.commands import results, settings, terminal
from svgf_jax.commands.completing import PRESET
from svgf_jax.commands.settings import INPUT, Flag, Reading
from svgf_jax.processes import Process, check_meeting, leave, meet

if TYPE_CHECKING:
    from tune.fitting import Fit
    from tune.shots import Shot

Repeated: Parameter = Parameter(negative=(), consume_multiple=True, show_default=False)
SECOND = ("alt", "second", "noisy2")  # what the second render is called in a folder
MAPS = "sensitivity.exr"  # as `explore.write_maps` calls it
Names = tuple[str, ...]
WHAT, HOW, OUTPUT = (Group(name, sort_key=i) for i, name in enumerate(["What", "How", "Output"], 1))


def command(
    noisy: Annotated[tuple[str, ...], Parameter(name="NOISY", group=INPUT)],
    /,
    *,
    out: Annotated[Path, Parameter(name=["--out", "-o"], metavar="FILE.toml", group=OUTPUT)],
    reference: Annotated[tuple[str, ...], Repeated, Parameter(metavar="REF", group=INPUT)] = (),
    second: Annotated[tuple[str, ...], Repeated, Parameter(metavar="NOISY2", group=INPUT)] = (),
    validate: Annotated[tuple[str, ...], Repeated, Parameter(metavar="NOISY", group=INPUT)] = (),
    validate_reference: Annotated[tuple[str, ...], Repeated, Parameter(metavar="REF", group=INPUT)] = (),
    frames: Annotated[str | None, Parameter(metavar="RANGE", group=INPUT)] = None,
    validate_frames: Annotated[str | None, Parameter(metavar="RANGE", group=INPUT)] = None,
    reading: Reading = Reading(),
    preset: Annotated[str | None, PRESET, Parameter(metavar="NAME", group=WHAT)] = None,
    params: Annotated[Path | None, Parameter(metavar="FILE.toml", group=WHAT)] = None,
    set_: Annotated[
        tuple[str, ...], Parameter(name="--set", metavar="NAME=VALUE", negative=(), show_default=False, group=WHAT)
    ] = (),
    tune: Annotated[str | None, Parameter(metavar="NAMES", group=WHAT)] = None,
    per_level: Annotated[str | None, Parameter(metavar="NAMES", group=WHAT)] = None,
    freeze: Annotated[str | None, Parameter(metavar="NAMES", group=WHAT)] = None,
    space: Annotated[Literal["reinhard", "log1p"], Parameter(group=HOW)] = "reinhard",
    temporal: Annotated[float, Parameter(metavar="WEIGHT", group=HOW)] = 0.5,
    prior: Annotated[float | None, Parameter(metavar="WEIGHT", group=HOW)] = None,
    robust: Annotated[Literal["none", "huber", "geman-mcclure"], Parameter(group=HOW)] = "none",
    robust_width: Annotated[float, Parameter(metavar="ERROR", group=HOW)] = 0.1,
    solver: Annotated[Literal["lm", "dogleg", "gauss-newton"], Parameter(group=HOW)] = "lm",
    max_steps: Annotated[int, Parameter(metavar="N", group=HOW)] = 30,
    starts: Annotated[int, Parameter(metavar="N", group=HOW)] = 1,
    seed: Annotated[int, Parameter(metavar="N", group=HOW)] = 0,
    tangent_batch: Annotated[int, Parameter(metavar="N", group=HOW)] = 8,
    resume: Annotated[bool, Flag, Parameter(group=HOW)] = False,
    distributed: Annotated[bool, Flag, Parameter(group=HOW)] = False,
    coordinator: Annotated[str | None, Parameter(metavar="HOST:PORT", group=HOW)] = None,
    processes: Annotated[int | None, Parameter(metavar="N", group=HOW)] = None,
    process: Annotated[int | None, Parameter(metavar="I", group=HOW)] = None,
    report: Annotated[Path | None, Parameter(metavar="FILE.html", group=OUTPUT)] = None,
    maps: Annotated[Path | None, Parameter(metavar="FOLDER", group=OUTPUT)] = None,
    profiles: Annotated[bool, Flag, Parameter(group=OUTPUT)] = False,
    flip: Annotated[bool, Flag, Parameter(group=OUTPUT)] = False,
    json: Annotated[bool, Flag, Parameter(group=OUTPUT)] = False,
    accept: Annotated[bool, Flag, Parameter(group=OUTPUT)] = False,
    overwrite: Annotated[bool, Flag, Parameter(group=OUTPUT)] = False,
) -> int:
    """Find the filter's numbers that bring noisy sequences closest to their references, and write them to a file.

    Args:
        noisy: Sequences to tune on: folders, patterns or files as svgf-jax denoise takes them.
        out: The parameter file.
        reference: The references of the sequences, in the same order: folders (their ref_ sequence), patterns or files.
        second: Instead of references: independent noisy renders of the same frames. References, if also given, only measure.
        validate: Sequences that are measured, never tuned on.
        validate_reference: Their references, in the same order.
        frames: Only these frames of the sequences to tune on: 1-100, 1-100x2 or 1,3,5-9.
        validate_frames: Only these frames of the sequences to validate on.
        preset: The preset to start from; paper if neither it nor --params is given.
        params: The parameter file to start from.
        set_: One parameter of the start: sigma_normal=64. Repeatable.
        tune: What to tune: names, or single levels (sigma_luminance[2]), with commas; all = every parameter.
        per_level: Of these one number for each a-trous level; all = of all that have levels.
        freeze: What not to tune after all.
        space: In what the image error is taken: x / (1 + x), or log(1 + x).
        temporal: Weight of the temporal error against the image error's 1.
        prior: Weight of the distance from the start, in squared e-folds; 0.02, and 0.00001 with --second.
        robust: Let single large errors count for less: their square grows linearly (huber) or levels off (geman-mcclure).
        robust_width: From which error on.
        solver: optimistix's Levenberg-Marquardt, Dogleg or Gauss-Newton.
        max_steps: Trial points a start.
        starts: Start from so many points, all but the first scattered about it, and keep the best.
        seed: Of the scattered starts.
        tangent_batch: Derivatives taken at a time: fewer need less memory and more time.
        resume: Go on where an interrupted fit of the same options was; begin where there was none yet.
        distributed: Share the sequences with the other processes of this job: of Slurm, Kubernetes or MPI, or by hand.
        coordinator: By hand: where process 0 is to be reached.
        processes: By hand: how many there are.
        process: By hand: which this is, from 0 on.
        report: Write a page with curves, tables and pictures.
        maps: Write where in the image each number matters, as EXR.
        profiles: Measure the error along each parameter by itself, and tell it with --json and --report.
        flip: Measure HDR-FLIP too (slow; needs the extra `flip`).
        json: Print the result as JSON to the standard output; all else goes to the standard error.
        accept: Exit with 0 even if a validation sequence got worse.
        overwrite: Replace outputs that exist.
    """
    name, start, config = settings.choose(preset, params, set_)
    checkpoint = out.with_name(f".{short(out.name)}.progress.npz")
    _check(noisy, reference, second, validate, validate_reference, robust)
    _check_numbers(robust_width, temporal, prior, max_steps, starts, tangent_batch)
    _check_apart(noisy, frames, validate, validate_frames, second)
    if report is not None and report.resolve() == out.resolve():
        raise SvgfError(f"Got {out} for both --out and --report; wanted two files.")
    for path in filter(None, (out, report)):
        if not os.path.isdir(path.absolute().parent):
            raise SvgfError(f"{path}: there is no folder {path.absolute().parent}; make it, or choose another name.")
    if maps is not None and os.path.exists(maps) and not os.path.isdir(maps):
        raise SvgfError(f"--maps {maps} is a file; wanted a folder.")
    resume = resume and os.path.exists(checkpoint)  # else the fit begins, unless it is done
    results.require_writable((out, report, None if maps is None else maps / MAPS), overwrite=overwrite or resume)
    results.require_writable((checkpoint,), overwrite=True)
    check_meeting(distributed, coordinator, processes, process)
    opened = reading.options()
    if flip:
        from svgf_jax.metrics import require_flip

        require_flip()

    import tune.checkpoint as checkpoints
    from svgf_jax.plan import stamp
    from tune import residuals
    from tune.fitting import fit
    from tune.free import TUNED_BY_DEFAULT, choose
    from tune.share import share_with
    from tune.shots import shot_of_files
    from tune.targets import with_doubts
    from tune.telling import conclude, live, versions

    references = [shot_of_files(n, r, frames=frames, **opened) for n, r in zip(noisy, reference, strict=False)]
    seconds = [shot_of_files(n, s, frames=frames, prefer=SECOND, **opened) for n, s in zip(noisy, second, strict=False)]
    held = [
        shot_of_files(n, r, frames=validate_frames, **opened) for n, r in zip(validate, validate_reference, strict=True)
    ]
    opening = [note for shot in (*references, *seconds, *held) for note in shot.notes]
    terminal.warn(dict.fromkeys(opening))  # before a frame is read, which may fail
    references, seconds, held = (list(map(with_doubts, group)) for group in (references, seconds, held))
    shots: list[Shot] = seconds or references
    if second:
        terms = residuals.noisy_terms(temporal=temporal, **({} if prior is None else {"prior_weight": prior}))
    else:
        weight = {} if prior is None else {"prior_weight": prior}
        terms = residuals.reference_terms(space=space, temporal=temporal, robust=robust, width=robust_width, **weight)
    names = _names(tune) or TUNED_BY_DEFAULT
    levels: Any = True if per_level == "all" else _names(per_level)
    labels = choose(start, config, names=names, per_level=levels, freeze=_names(freeze)).labels
    identity = {
        "sequences": noisy,
        "reference": second or reference,
        "frames": frames,
        "start": name,
        "numbers": [str(leaf) for leaf in start],
        "tune": names,
        "per_level": levels,
        "freeze": _names(freeze),
        "solver": solver,
        "space": space,
        "temporal": temporal,
        "prior": prior,
        "robust": robust,
        "robust_width": robust_width,
        "seed": seed,
        "starts": starts,
        "choices": [str(choice) for choice in config],
        "reading": list(dataclasses.astuple(reading)),
        "files": [stamp(path) for shot in shots for path in shot.paths],
        "versions": versions(),
    }
    nobody: Any = lambda heard: None  # noqa: E731
    doubts = dict.fromkeys(note for shot in (*references, *seconds, *held) for note in shot.notes)
    terminal.warn(note for note in doubts if note not in opening)
    length = sum(shot.length for shot in shots)
    me = Process()
    with _terminated_as_interrupted(), ExitStack() as stack:
        if distributed:
            me = meet(coordinator, processes, process)
            stack.callback(leave, me)
        if len(shots) < me.size:
            raise SvgfError(
                f"Got {terminal.count(len(shots), 'sequence')} for {me.size} processes; wanted at least one each. Start fewer."
            )
        on_iteration = nobody if me.rank else stack.enter_context(live(len(shots), length, labels))
        found = fit(
            start,
            config,
            shots,
            terms,
            names=names,
            per_level=levels,
            freeze=_names(freeze),
            solver=solver,
            max_steps=max_steps,
            starts=starts,
            seed=seed,
            tangent_batch=tangent_batch,
            share=share_with(me) if distributed else None,
            on_iteration=on_iteration,
            save=nobody if me.rank else lambda progress: checkpoints.save(checkpoint, progress, identity),
            resume=(lambda fresh: checkpoints.load(checkpoint, fresh, identity)) if resume else None,
        )
    if me.rank:  # process 0 tells and writes
        return 130 if _interrupted(found) else 0
    code = conclude(
        found,
        start,
        config,
        measured=references,
        validated=held,
        fitted=shots,
        terms=terms,
        out=out,
        record={
            "start": name,
            "sequences": list(noisy),
            "targets": list(second or reference),
            "frames": frames or "all",
        },
        report=report,
        maps=maps,
        profiles=profiles,
        flip=flip,
        json=json,
    )
    terminal.warn(f"{note} (as said before the fit)" for note in doubts if note not in opening)
    if _interrupted(found):
        terminal.tell(f"interrupted; go on with the same command and --resume ({checkpoint.name})")
        return 130
    checkpoint.unlink(missing_ok=True)
    if found.diverged:
        return 1
    if code and accept:
        terminal.tell("accepted all the same (--accept)")
        return 0
    return code


def _check(
    noisy: Names, reference: Names, second: Names, validate: Names, validate_reference: Names, robust: str
) -> None:
    if not noisy:
        raise SvgfError(
            "Got no sequence to tune on; wanted at least one: svgf-tune NOISY --reference REF -o tuned.toml."
        )
    if not reference and not second:
        raise SvgfError(
            "Got neither --reference nor --second; wanted what the images should look like, for each sequence."
        )
    for given, option in ((reference, "--reference"), (second, "--second")):
        if given and len(given) != len(noisy):
            raise SvgfError(
                f"Got {len(noisy)} sequences and {len(given)} of {option}; wanted one for each, in the same order."
            )
    if len(validate) != len(validate_reference):
        raise SvgfError(
            f"Got {len(validate)} of --validate and {len(validate_reference)} of --validate-reference; wanted one for each."
        )
    if second and robust != "none":
        raise SvgfError(
            f"Got --robust {robust} with --second; wanted none: a robust mean of a noisy target is not "
            "its mean, the fit would be biased."
        )


def _check_numbers(
    robust_width: float, temporal: float, prior: float | None, max_steps: int, starts: int, tangent_batch: int
) -> None:
    if not robust_width > 0:
        raise SvgfError(f"Got --robust-width {robust_width:g}; wanted a number above 0.")
    for option, weight in (("--temporal", temporal), ("--prior", 0.0 if prior is None else prior)):
        if not weight >= 0:
            raise SvgfError(f"Got {option} {weight:g}; wanted a weight of 0 or more.")
    for option, count in (("--max-steps", max_steps), ("--starts", starts), ("--tangent-batch", tangent_batch)):
        if count < 1:
            raise SvgfError(f"Got {option} {count}; wanted at least 1.")


def _check_apart(noisy: Names, frames: str | None, validate: Names, validate_frames: str | None, second: Names) -> None:
    """What is validated on must not be tuned on, and a second render must not be the first: judged by the files."""
    tuned = set().union(*(_files(name, frames) for name in noisy)) if validate or second else set()
    for name in validate:
        if common := tuned & _files(name, validate_frames):
            raise SvgfError(
                f"{min(common)} is both tuned and validated on; the validation would say nothing. Take another sequence, "
                "or other frames of it: --frames 0-7 --validate-frames 8-15."
            )
    for name in second:
        if common := tuned & _files(name, frames, prefer=SECOND):
            raise SvgfError(f"{min(common)} is both the noisy frame and its --second; wanted an independent render.")


def _files(name: str, frames: str | None, **options: Any) -> set[Path]:
    from svgf_jax.sequences import find_sequence

    found = find_sequence(name, frames=frames, missing="reset", **options)
    return {Path(path).resolve() for _, path in found.files if path is not None}


def _names(text: str | None) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip()) if text else ()


def _interrupted(found: "Fit") -> bool:
    return found.result.startswith("interrupted")


@contextmanager
def _terminated_as_interrupted() -> Generator[None]:
    """SIGTERM ends a fit as Ctrl-C does: with the best so far; and Ctrl-C where scripts start it in the background, too."""

    def on_signal(number: int, _: object) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
