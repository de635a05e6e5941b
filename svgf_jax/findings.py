"""What is wrong or odd about a sequence that was inspected, and what to change about it."""

import difflib
import math
import shlex
from collections.abc import Iterator
from typing import Literal, NamedTuple

from svgf_jax.geometry import RAY_DISTANCE, SPACES, VIEW_Z, WORLD, Z_AFTER_ALL, Z_BUFFER, Fit
from svgf_jax.inspection import SHORT, Facts, declared
from svgf_jax.motion import Convention
from svgf_jax.remedies import remedy
from svgf_jax.roles import WIDTH
from svgf_jax.sequences import format_range
from svgf_jax.warping import NEAR, Residual, off, shown

CORRELATED = 0.15
"""Correlation of neighbours' noise from which on it matters: Mitsuba's default filter has 0.37, independent pixels 0."""
LITTLE = 0.08
"""Deviation of light brought to 0 ... 1 below which shadows that move are taken for noise: converged pictures reach 0.05."""
REPEATED = 0.3
"""Correlation of the noise from frame to frame from which on it is the same."""
FIREFLIES = 0.15  # share of a signal's light
CONVERGED = 0.03  # relative noise


class Finding(NamedTuple):
    """One thing that an inspection found.

    Attributes:
        level: "error" (a run would not start), "warning" (to be mended), "note" (to be known).
        topic: what it is about, a word or two.
        text: what was found, with numbers.
        remedy: what to change; "" where there is nothing.
    """

    level: Literal["error", "warning", "note"]
    topic: str
    text: str
    remedy: str


def judge(facts: Facts, *, gaps_allowed: bool = True) -> tuple[Finding, ...]:
    """All findings, errors first. Without `gaps_allowed`, missing frames are an error."""
    renderer = facts.table.name
    found = [*_files(facts, gaps_allowed), *_roles(facts), *_light(facts, renderer), *_guides(facts, renderer)]
    found += [*_motion(facts, renderer), *_history(facts, renderer)]
    return tuple(sorted(found, key=lambda one: ("error", "warning", "note").index(one.level)))


def verdict(findings: tuple[Finding, ...]) -> str:
    """One line: whether a run would start, and how much there is to mend."""
    errors, warnings = (sum(one.level == level for one in findings) for level in ("error", "warning"))
    mend = f"{warnings} thing{'s' * (warnings != 1)} to mend"
    if errors:
        return f"cannot run: {errors} error{'s' * (errors != 1)}" + (f", {mend}" if warnings else "")
    return f"can run, {mend}" if warnings else "ready"


def _files(facts: Facts, gaps_allowed: bool) -> Iterator[Finding]:
    scan = facts.scan
    for text in scan.damaged.values():
        yield Finding("error", "files", text, "")
    if scan.missing:
        level = "note" if gaps_allowed else "error"
        text = f"frames {format_range(scan.missing)} are missing."
        yield Finding(
            level, "gaps", text, "" if gaps_allowed else "Render them, or go on without: --missing hold|reset."
        )
    if len(scan.there) == 1:
        text = "one frame only: there is no history, and the filter is left with what is around each pixel."
        yield Finding(
            "warning", "frames", text, "Give the whole sequence: a folder, or a pattern such as frame_####.exr."
        )
    if scan.checked < len(scan.there):
        yield Finding("note", "files", f"{scan.checked} of {len(scan.there)} headers were read.", "")


def _roles(facts: Facts) -> Iterator[Finding]:
    for role, cost in facts.roles.absent.items():
        level = "note" if role in ("emission", "id") else "warning"
        setting = facts.table.settings.get(role)
        switch = f"{facts.table.title}: {setting}." if setting else "Let the renderer write it."
        yield Finding(
            level, f"no {role}", f"no {role}: taken as {cost}.", f"{switch} {_elsewhere(role, facts.scan.unused)}"
        )
    for text in facts.warnings:
        yield Finding("warning", "reading", text, "")


def _elsewhere(role: str, unused: tuple[str, ...]) -> str:
    """How to name the channels of a role, with those that are called much like it."""
    stems: dict[str, list[str]] = {}
    for name in unused:
        stems.setdefault(name.rpartition(".")[0] or name, []).append(name)
    of_width = {stem.rpartition(".")[2]: names for stem, names in stems.items() if len(names) >= WIDTH[role]}
    close = difflib.get_close_matches(role, of_width, n=1, cutoff=0.6)
    if not close:
        return f"If it is there under another name: --channel {role}=NAMES, or --file {role}=PATTERN."
    names = sorted(of_width[close[0]], key=lambda name: "RGBXYZUVA".find(name[-1]))[: WIDTH[role]]
    given = f"{role}={','.join(names)}"
    return f"Or is it this: --channel {shlex.quote(given)}?"


def _light(facts: Facts, renderer: str) -> Iterator[Finding]:
    levels = [one.noise for one in facts.light.values() if one.noise is not None]
    if levels and max(levels) < CONVERGED:
        text = f"hardly any noise: at most {100 * max(levels):.2g} % of the light. Converged, or denoised already."
        yield Finding("warning", "noise", text, remedy("little noise", renderer))
    if facts.psnr == math.inf and facts.background < 1:
        text = "the light does not vary at all: black, or one colour."
        yield Finding("warning", "noise", text, "Look at the channels of light: is this what the renderer wrote?")
    if facts.correlation is not None and facts.correlation > CORRELATED and (doubt := doubtful(facts)):
        text = f"the noise of neighbouring pixels looks correlated ({facts.correlation:.2f}), but that may be texture: {doubt}."
        yield Finding("note", "correlated noise", text, f"If it is noise: {remedy('correlation', renderer)}")
    elif facts.correlation is not None and facts.correlation > CORRELATED:
        text = (
            f"the noise of neighbouring pixels is correlated ({facts.correlation:.2f}; independent pixels have 0): "
            "a wide pixel filter or a denoiser was at work. The filter will take blotches for detail."
        )
        yield Finding("warning", "correlated noise", text, remedy("correlation", renderer))
    if facts.repeated is not None and facts.repeated > REPEATED:
        text = (
            f"the noise is the same in every frame (correlation {facts.repeated:.2f}): averaging frames gains nothing."
        )
        yield Finding("warning", "seed", text, remedy("seed", renderer))
    for name, light in facts.light.items():
        pixels, share = light.fireflies
        if share > FIREFLIES and pixels * math.prod(facts.size) >= 10:
            text = f"{_percent(share)} of the light of {name} is in {_percent(pixels)} of its pixels."
            yield Finding("warning", "fireflies", text, remedy("fireflies", renderer))
    for role, (nan, infinite, negative) in facts.broken.items():
        bright = role in (*facts.roles.light, "emission", "environment")
        if nan or infinite:
            kinds = " and ".join(f"{count} {kind}" for count, kind in ((nan, "NaN"), (infinite, "infinite")) if count)
            text = f"{kinds} pixel{'s' * (nan + infinite != 1)} of {role} in {_frames(facts)}."
            yield Finding(
                "warning", f"broken {role}", text, remedy("broken light" if bright else "broken guides", renderer)
            )
        if negative:
            text = f"{negative} negative pixel{'s' * (negative != 1)} of {role} in {_frames(facts)}."
            yield Finding("warning", f"negative {role}", text, remedy("negative light", renderer))
    if (count := facts.repaired.get("excess", 0)) > 1e-3 * len(facts.read) * math.prod(facts.size):
        text = f"{count} pixels in {_frames(facts)} have more emission than the beauty that should contain it."
        yield Finding("warning", "emission", text, remedy("excess", renderer))
    if facts.halves.clipped:
        one = facts.halves.clipped == 1
        text = f"{facts.halves.clipped} pixel{' is' if one else 's are'} as bright as half float can be (65504): light is cut off."
        yield Finding("warning", "half float", text, remedy("half", renderer))


def doubtful(facts: Facts) -> str:
    """Why texture, or shadows that move, may count as correlated noise; "" if not."""
    lack = ""
    if facts.continuity is None:
        lack = "two frames in a row"
    elif "motion" in facts.roles.absent:
        lack = "motion"
    elif "albedo" in facts.roles.absent and facts.continuity.still < 0.98:
        lack = "an albedo"
    if lack:
        return f"without {lack} the two are not told apart"
    return "there is little noise, and shadows that move look the same" if (facts.spread or 0.0) < LITTLE else ""


def _guides(facts: Facts, renderer: str) -> Iterator[Finding]:
    if facts.below > 0.01:
        text = f"depth is negative in {_percent(facts.below)} of the pixels."
        kind = "z" if facts.roles.layers["depth"].meaning == "z-back" else "z-back"
        yield Finding(
            "warning", "depth sign", text, f"{remedy('depth sign', renderer)} Or say so: --meaning depth={kind}."
        )
    if facts.background == 1:
        text = "no pixel has a surface: everything would pass through unfiltered."
        yield Finding(
            "warning", "background", text, "Look at id, alpha, normal and depth: one of them says that nothing was hit."
        )
    if (count := facts.repaired.get("guides", 0)) > 1e-3 * len(facts.read) * math.prod(facts.size):
        text = f"{count} pixels in {_frames(facts)} were hit (by id or alpha), but have no usable depth or normal."
        yield Finding("warning", "guides", text, remedy("guides", renderer))
    if facts.packed:
        text = "normals are packed: from 0 to 1 in place of -1 to 1."
        yield Finding("warning", "normals", text, remedy("normals packed", renderer))
    elif (count := facts.repaired.get("normal", 0)) and count > 0.01 * len(facts.read) * math.prod(facts.size):
        text = f"{count} normals in {_frames(facts)} are not of unit length: brought to it."
        yield Finding("note", "normals", text, "")
    if facts.normals is not None and not facts.packed:
        found = _normals(facts.normals, renderer, facts.roles.layers["normal"].meaning)
        yield from (one._replace(remedy=_mend_first(facts) or one.remedy) for one in found)
    if facts.depth is not None and facts.depth.best != (VIEW_Z,):
        yield from _depth(facts.depth, facts)
    halves = facts.halves
    if halves.position is not None and halves.position > 0.25:
        text = f"positions in half float are rounded to steps of {halves.position:.2g} of the distance between neighbouring pixels."
        yield Finding("warning", "half float", text, remedy("half", renderer))
    if halves.motion is not None and halves.motion > 0.1:
        text = f"motion in half float is rounded to steps of {halves.motion:.2g} pixels where it is fast."
        yield Finding("warning", "half float", text, remedy("half", renderer))


def _mend_first(facts: Facts) -> str:
    """What to mend before what positions say can be believed: "" if they do not come from a depth that is none."""
    wrong = facts.depth is not None and facts.depth.best in ((), (Z_BUFFER,)) and "position" not in facts.roles.layers
    return "Mend depth first: this was judged by positions from it." if wrong and facts.cameras else ""


def _normals(fit: Fit, renderer: str, meaning: str) -> Iterator[Finding]:
    nearest = min(fit.misfit, key=lambda name: fit.misfit[name])
    either = "or" in meaning.split()  # whichever the cameras confirm
    read = SPACES.get(meaning, WORLD) if len(fit.misfit) > 1 and not either else WORLD
    if not fit.best:
        text = f"normals agree with those of the surfaces in no space ({fit.misfit[nearest]:.0f} degrees off in {nearest})."
        change = "Look at the channels of normal, position and depth: one of them is something else."
        yield Finding("warning", "normals", text, change)
    elif read not in fit.best and not (either and SPACES["camera"] in fit.best):
        off_by = f"{fit.misfit[read]:.0f} degrees off those of the surfaces in {read}"
        change = "" if nearest == WORLD else remedy("normal space", renderer)
        if len(fit.best) == 1:
            words = next((words for words, name in SPACES.items() if name == nearest), "world")
            change = f"{change} {'Or say' if change else 'Say'} so: --meaning {shlex.quote(f'normal={words}')}.".strip()
        text = f"normals are in {' or in '.join(fit.best)}, {off_by}{', as which they are read' * (read != WORLD)}."
        yield Finding("warning", "normals", text, change)


def _depth(fit: Fit, facts: Facts) -> Iterator[Finding]:
    renderer, read = facts.table.name, facts.roles.layers["depth"].meaning
    if fit.best == (RAY_DISTANCE,) and read == "distance":
        return  # without a camera nothing can be made of it: loading says so
    if fit.best == (RAY_DISTANCE,):
        text = "depth is the length of the ray, not the distance along the viewing axis: history and edges will be judged wrongly."
        change = remedy("depth kind", renderer)
        say = (
            "say so: --meaning depth=distance."
            if facts.cameras
            else "give a cameras.json, and say so: --meaning depth=distance."
        )
        yield Finding("warning", "depth", text, f"{change} Or {say}")
    elif fit.best == (Z_AFTER_ALL,):
        text = "depth is the distance along the viewing axis, not the length of the ray as which it is read."
        yield Finding("warning", "depth", text, "Say so: --meaning depth=z.")
    elif fit.best == (Z_BUFFER,):
        text = "depth is what a z buffer holds, not the distance along the viewing axis: history and edges will be judged wrongly."
        yield Finding("warning", "depth", text, f"{remedy('depth kind', renderer)} No --meaning makes z of a z buffer.")
    elif fit.best:
        yield Finding("note", "depth", f"cannot tell whether depth is {' or '.join(fit.best)} here.", "")
    else:
        text = "depth is neither view z nor the length of a ray: flat surfaces are not flat."
        change = f"{remedy('depth kind', renderer)} Is this channel depth at all, and the cameras.json of these frames?"
        yield Finding("warning", "depth", text, change)


def _motion(facts: Facts, renderer: str) -> Iterator[Finding]:
    if facts.background == 1:
        return
    if facts.motion is None:
        if facts.warped is not None and off(facts.warped):
            yield _as_read(facts.warped)
        return
    fits, residuals = facts.motion.fits, facts.motion.residuals
    if not fits:
        judged = any(one.judged for one in residuals.values())
        if judged and math.isinf(_off(facts, None)):
            yield Finding("note", "motion", "the guides are too plain to tell a motion convention by.", "")
            return
        moves, vectors = judged and _off(facts, None) > NEAR, residuals.keys() != {None}
        if not vectors and (moves or facts.moved):
            pixels = f"{facts.moved} pixels show another surface than in the frame before"
            text = f"motion vectors are all 0, though the scene moves: {shown(_off(facts, None))} pixels off."
            text = text if moves else f"motion vectors are all 0, though something moves: {pixels}."
            yield Finding("warning", "motion", text, f"{remedy('zero motion', renderer)} {_without_vectors(facts)}")
            return
        still = facts.continuity is not None and facts.continuity.still > 0.98
        if not judged or not vectors or (still and not moves):
            text = "nothing moves: the motion convention cannot be told, and does not matter."
            yield Finding("note", "motion", text, "")
            return
        best = min(_off(facts, one) for one in residuals if one is not None)
        text = (
            f"no motion convention fits: {shown(best)} pixels off at best, {shown(_off(facts, None))} without any motion. "
            "Motion blur, other frames' vectors, or motion that stands for something else?"
        )
        change = _mend_first(facts) or f"Look at the channels of motion. {_without_vectors(facts)}"
        yield Finding("warning", "motion", text, change)
        return
    own = declared(facts.roles)
    if own not in fits:
        read = " or ".join(f"'{one}'" for one in fits)
        text = f"motion vectors follow {read} ({shown(_off(facts, fits[0]))} pixels off), not '{own}' ({shown(_off(facts, own))})."
        change = f"Say so: --motion '{fits[0]}'."
        if len(fits) > 1:
            change = (
                "These frames do not tell which: inspect some in which the camera moves both ways and turns (--frames), or look "
                "it up in the renderer's documentation, and say it with --motion."
            )
        yield Finding("warning", "motion", text, change)
    elif facts.warped is not None and off(facts.warped):  # of the pair that is worse off
        yield _as_read(facts.warped)
    elif len(fits) > 1:
        others = ", ".join(f"'{one}'" for one in fits if one != own)
        yield Finding("note", "motion", f"motion could as well be {others}: these frames do not tell.", "")


def _without_vectors(facts: Facts) -> str:
    """How to do without the motion vectors in the files."""
    if facts.cameras:
        return "Or take it from the cameras: --channel motion=none."
    return "Or take it from cameras: write a cameras.json, and say --channel motion=none."


def _as_read(warped: Residual) -> Finding:
    text = f"motion leads past the same point of the frame before: {shown(warped.pixels)} pixels off, by position."
    change = "Look at the channels of motion and at cameras.json: of another frame, of another size, or smoothed?"
    return Finding("warning", "motion", text, change)


def _off(facts: Facts, one: Convention | None) -> float:
    assert facts.motion is not None
    residual = facts.motion.residuals.get(one)
    return math.inf if residual is None or math.isnan(residual.pixels) else residual.pixels


def _history(facts: Facts, renderer: str) -> Iterator[Finding]:
    if facts.continuity is not None and facts.continuity.share < SHORT and facts.background < 1:
        text = f"only {_percent(facts.continuity.share)} of the pixels find their surface in the frame before"
        text += f": {facts.lost}s differ where the motion leads." if facts.lost else "."
        topic = "history, id" if facts.lost == "id" else "history"
        yield Finding("warning", "history", text, remedy(topic, renderer))


def _frames(facts: Facts) -> str:
    return f"{len(facts.read)} frame{'s' * (len(facts.read) != 1)}"


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.995 else f"{100 * share:.1f} %"
