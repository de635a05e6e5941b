"""The two pictures of svgf_jax/docs/concepts.md: the filter's stages as a drawing, and what each makes of one frame.

    python tests/bench/draw_pipeline.py            both
    python tests/bench/draw_pipeline.py drawing    pipeline.svg alone, which needs no JAX

The strip runs the public functions one after the other on a frame of the bundled sample, preset `paper`.
"""

import sys
from html import escape
from pathlib import Path

DOCS = Path(__file__).parents[2] / "svgf_jax" / "docs"
FRAME = 7  # of the sample: the box has moved, and uncovered wall
COLUMNS = slice(30, 190)  # of it that the strip shows
WIDTH, LEFT, BOX, RIGHT = 920, 270, 330, 650  # of the drawing; x of the boxes, their width, x of the history

STYLE = """
:root { --back: #ffffff; --ink: #1b1f24; --soft: #59636e; --line: #6e7781; --stage: #e7f0fb; --edge: #2f6fb3; --data: #f1f1ec;
  --past: #fbeedd; --pastline: #a3640f }
@media (prefers-color-scheme: dark) { :root { --back: #14171b; --ink: #e8ecf0; --soft: #a3adb8; --line: #8b949e; --stage: #1b2c40;
  --edge: #6cacec; --data: #25282c; --past: #382a17; --pastline: #e2a450 } }
text { font: 14px system-ui, sans-serif; fill: var(--ink) }
.name { font: 600 15px ui-monospace, monospace } .said { font-weight: 600 }
.soft { font-size: 12.5px; fill: var(--soft) } .past { fill: var(--pastline) }
.stage { fill: var(--stage); stroke: var(--edge) } .choice { stroke-dasharray: 5 4; fill: none; stroke: var(--edge) }
.data { fill: var(--data); stroke: var(--line) } .history { fill: var(--past); stroke: var(--pastline) }
path { fill: none; stroke: var(--line); stroke-width: 1.5; marker-end: url(#tip) }
path.loop { stroke: var(--pastline); marker-end: url(#pasttip) }
"""

PAST = "illumination, moments, history_length of the past"
# A stage: its name, what it does, the kind of box, what it reads of the frame, what leaves it downwards.
STAGES = [
    ("sanitise", "not a number -> 0, counted", "stage", "all channels", "radiance [S, H, W, 3]"),
    ("demodulate", "radiance / albedo", "stage", "albedo", "illumination [S, H, W, 3]"),
    ("remove_outliers", "by choice: outlier_radius", "choice", "", None),
    ("reproject", "where was this point? (4.1)", "stage", "motion, prev_depth, normal, object_id", PAST),
    ("reproject_reflections", "by choice: channel hit_distance", "choice", "reflected_motion, ...", ""),
    ("follow the light", "by choice: light_cell (preset adaptive)", "choice", "", ""),
    ("clamp_history", "by choice: clamp_radius", "choice", "", ""),
    ("accumulate", "mean over time of light, moments (4.1)", "stage", "", "illumination, moments"),
    (
        "estimate_variance",
        "how noisy is it? (4.2)",
        "stage",
        "depth, normal, object_id",
        "illumination, variance [S, H, W]",
    ),
    (
        "atrous_filter",
        "5 x 5 taps, steps 1 2 4 8 16 (equations 1-5)",
        "stage",
        "depth, normal, object_id",
        "illumination",
    ),
    ("modulate", "x albedo, sum of signals, + emission", "stage", "albedo, emission", "image [H, W, 3]"),
    ("taa", "by choice: taa", "choice", "motion, depth", "image"),
]
READ_LIGHT = ("follow the light", "clamp_history", "accumulate")  # and the light of this frame, not of its past


def drawing():
    """The stages from top to bottom, the frame to their left, the history to their right: an SVG."""
    top, height, pitch = 30, 48, 80
    ys = [top + pitch * i for i in range(len(STAGES))]
    bottom = ys[-1] + height
    place = {stage[0]: y + height / 2 for stage, y in zip(STAGES, ys, strict=True)}
    middle, parts = LEFT + BOX / 2, []

    def box(x, y, wide, high, style):
        parts.append(f'<rect x="{x}" y="{y}" width="{wide}" height="{high}" rx="8" class="{style}"/>')

    def text(x, y, words, style="", anchor="middle"):
        parts.append(f'<text x="{x}" y="{y}" text-anchor="{anchor}" class="{style}">{escape(words)}</text>')

    def arrow(points, style=""):
        parts.append(f'<path d="M{" L".join(f"{x},{y}" for x, y in points)}" class="{style}"/>')

    box(15, top, 90, bottom - top, "data")
    text(60, top + 25, "Frame", "name")
    for i, name in enumerate(
        ["radiance", "albedo", "emission", "normal", "depth", "prev_depth", "motion", "object_id"]
    ):
        text(60, top + 55 + 20 * i, name, "soft")
    for y, (name, what, kind, channels, result) in zip(ys, STAGES, strict=True):
        box(LEFT, y, BOX, height, kind)
        text(middle, y + 20, name, "name" if "_" in name or " " not in name else "said")
        text(middle, y + 38, what, "soft")
        if channels:
            arrow([(105, y + height / 2), (LEFT - 2, y + height / 2)])
            words = channels.split(", ")
            first = ", ".join(words[:2]) + "," * (len(words) > 2)
            text(112, y + height / 2 - 7, first, "soft", "start")
            text(112, y + height / 2 + 17, ", ".join(words[2:]), "soft", "start")
        if result is not None:
            arrow([(middle, y + height), (middle, y + pitch - 2)])
            text(middle + 9, y + height + 20, result, "soft", "start")
    side = LEFT - 20
    parts.append(
        f'<path d="M{LEFT},{place["remove_outliers"]} H{side} V{place["accumulate"]}" style="marker-end: none"/>'
    )
    for name in READ_LIGHT:
        arrow([(side, place[name]), (LEFT - 2, place[name])])
    text(side - 7, place["clamp_history"] + 4, "illumination", "soft", "end")
    box(LEFT, bottom + 32, BOX, 34, "data")
    text(middle, bottom + 54, "Output", "name")

    reproject, accumulate, atrous = (place[name] for name in ("reproject", "accumulate", "atrous_filter"))
    past, following = (RIGHT, reproject - 120), (RIGHT, (accumulate + atrous) / 2 - 44)
    for (x, y), title, words in (
        (past, "History", ("illumination, moments,", "history_length,", "depth, normal, object_id")),
        (following, "History", ("of this frame, for the next;", "its depth, normal, object_id", "are in it, too")),
    ):
        box(x, y, 190, 88, "history")
        text(x + 95, y + 24, title, "name")
        for i, line in enumerate(words):
            text(x + 95, y + 44 + 17 * i, line, "soft")
    right = LEFT + BOX
    arrow([(past[0] + 40, past[1] + 88), (past[0] + 40, reproject), (right + 2, reproject)], "loop")
    arrow([(right, accumulate), (RIGHT + 40, accumulate), (RIGHT + 40, following[1] - 2)], "loop")
    text(RIGHT + 48, accumulate - 7, "moments, history_length", "soft past", "start")
    arrow([(right, atrous), (RIGHT + 40, atrous), (RIGHT + 40, following[1] + 90)], "loop")
    text(RIGHT + 48, atrous + 18, "illumination of level", "soft past", "start")
    text(RIGHT + 48, atrous + 35, "feedback_level (paper: the first)", "soft past", "start")
    edge = RIGHT + 190
    loop = [
        (edge, following[1] + 44),
        (edge + 32, following[1] + 44),
        (edge + 32, past[1] + 44),
        (edge + 2, past[1] + 44),
    ]
    arrow(loop, "loop")
    text(edge + 22, (past[1] + following[1]) / 2 + 40, "one frame later", "soft past", "end")

    tips = "".join(
        f'<marker id="{name}" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        f'<polygon points="0,0 8,4 0,8" style="fill: var({colour})"/></marker>'
        for name, colour in (("tip", "--line"), ("pasttip", "--pastline"))
    )
    tall = bottom + 86
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {tall}" width="{WIDTH}" height="{tall}" role="img" '
        f'aria-label="The stages of SVGF as functions of svgf_jax">\n<style>{STYLE}</style>\n<defs>{tips}</defs>\n'
        f'<rect width="{WIDTH}" height="{tall}" style="fill: var(--back)"/>\n' + "\n".join(parts) + "\n</svg>\n"
    )


def strip():
    """Two rows of pictures `[H, W, 3]` uint8: what each stage makes of the frame."""
    import jax
    import numpy as np

    import svgf_jax as svgf
    from svgf_jax.page import heat
    from svgf_jax.preview import side_by_side, to_8bit

    params, config = svgf.preset("paper")
    frames = svgf.load_sequence(svgf.sample(), frames=f"0-{FRAME}")
    reference = svgf.load_reference(svgf.sample(), frames=str(FRAME))[0]
    before, frame = (jax.tree.map(lambda a, part=part: a[part], frames) for part in (slice(0, FRAME), FRAME))
    history, _ = svgf.denoise(before, params=params, config=config)

    noisy = np.asarray(frame.radiance).sum(0) + np.asarray(frame.emission)
    frame, _ = svgf.sanitise(jax.tree.map(jax.numpy.asarray, frame))
    illumination = svgf.demodulate(frame.radiance, frame.albedo)
    previous = svgf.reproject(history, frame, params=params, config=config)
    accumulated = svgf.accumulate(illumination, previous, frame, params=params, config=config)
    variance = svgf.estimate_variance(
        accumulated.moments, accumulated.history_length, frame, params=params, config=config
    )
    first = svgf.atrous_level(accumulated.illumination, variance, frame, level=0, params=params)[0]
    filtered, _, _ = svgf.atrous_filter(accumulated.illumination, variance, frame, params=params, config=config)
    image = svgf.modulate(filtered, frame)

    def light(signals):
        return to_8bit(np.asarray(signals).sum(0), exposure=0.8)

    def shown(color):
        return to_8bit(color, exposure=1.6)

    decades = np.log10(np.maximum(np.asarray(variance).sum(0), 1e-30))
    rows = [
        [
            ("noisy frame", shown(noisy)),
            ("demodulate", light(illumination)),
            ("reproject", light(previous.illumination)),
            (f"history_length, 0-{FRAME + 1}", heat(np.asarray(accumulated.history_length) / (FRAME + 1))),
            ("accumulate", light(accumulated.illumination)),
        ],
        [
            ("estimate_variance", heat((decades + 6) / 7)),
            ("atrous_level 0", light(first)),
            ("atrous_filter", light(filtered)),
            ("modulate", shown(image)),
            ("reference", shown(reference)),
        ],
    ]
    return np.concatenate([side_by_side([(label, picture[:, COLUMNS]) for label, picture in row]) for row in rows])


def main():
    wanted = sys.argv[1:] or ["drawing", "strip"]
    if "drawing" in wanted:
        (DOCS / "pipeline.svg").write_text(drawing(), encoding="utf-8")
    if "strip" in wanted:
        from PIL import Image

        path = DOCS / "stages.jpg"
        Image.fromarray(strip()).save(path, quality=84)
        print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
