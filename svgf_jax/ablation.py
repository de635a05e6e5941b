"""What each part of the filter is worth: rows that differ from a base in one thing, each run over the whole sequence.

JAX is imported once the first frame is filtered, so that every error before that is answered at once.
"""

import fnmatch
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from svgf_jax import frames
from svgf_jax.compiled import Pipeline, compile_filters, to_host
from svgf_jax.metrics import Scores, mean_scores, score_frames
from svgf_jax.parameters import override, suggest
from svgf_jax.references import read_reference
from svgf_jax.types import Config, Frame, Params, SvgfError


class Row(NamedTuple):
    """One choice.

    Attributes:
        name: `no-...` leaves a part out, `with-...` adds one, others replace one.
        changes: fields of `Params` and `Config` that differ from the base.
        meaning: in a line.
        alter: what becomes of each frame (NumPy arrays) before the filter; None = nothing.
    """

    name: str
    changes: Mapping[str, Any]
    meaning: str
    alter: Callable[[Frame], Frame] | None = None


class Measured(NamedTuple):
    """A row's result.

    Attributes:
        row: which.
        scores: of the whole sequence (`metrics.mean_scores`).
        seconds: median time of a frame, compilation excluded.
        frames: the scores of each frame that has a reference, by number.
    """

    row: Row
    scores: Scores
    seconds: float
    frames: Mapping[int, Scores] = {}


def _without_history(frame: Frame) -> Frame:
    return _on_the_surface(frame)._replace(motion=np.full_like(frame.motion, 1e6))


def _without_albedo(frame: Frame) -> Frame:
    return frame._replace(albedo=np.ones_like(frame.albedo))


def _summed(frame: Frame) -> Frame:
    """One signal: its measured variance is the sum, as of independent ones; not known where one is not."""
    variance = frame.variance
    if variance is not None:
        variance = np.where((variance < 0).any(0), -1, variance.sum(0)).astype(variance.dtype)[None]
    one = {"radiance": frame.radiance.sum(0, keepdims=True), "albedo": frame.albedo[:1], "variance": variance}
    return _on_the_surface(frame)._replace(**one)


def _on_the_surface(frame: Frame) -> Frame:
    return frame._replace(reflected_motion=None, reflected_prev_depth=None, longest_history=None)


BASE = Row("base", {}, "as chosen")
NO_DEMODULATION = Row(
    "no-demodulation", {}, "textures filtered together with the light: an albedo of 1", _without_albedo
)
ONE_SIGNAL = Row("one-signal", {}, "direct and indirect light added up before the filter", _summed)
ROWS = (
    Row(
        "unfiltered",
        {"levels": 0, "alpha": 1.0, "taa": False, "outlier_radius": 0, "light_cell": 0},
        "the noisy frames as they are",
    ),
    # Signals
    NO_DEMODULATION,
    ONE_SIGNAL,
    # Reprojection
    Row("no-history", {}, "each frame by itself: nothing is reprojected", _without_history),
    Row("nearest", {"reprojection": "nearest"}, "history of the nearest pixel"),
    Row("bilinear", {"reprojection": "bilinear"}, "history of 2 x 2 pixels"),
    Row("no-fallback", {"fallback": False}, "no history where the 2 x 2 pixels give none; 3 x 3 not tried"),
    Row("with-fallback", {"fallback": True}, "3 x 3 pixels where the first give no history"),
    Row("no-id-test", {"id_test": False}, "history of other objects, if depth and normal fit"),
    Row("with-id-test", {"id_test": True}, "history of the same object only"),
    # Accumulation
    Row("no-warm-up", {"warm_up": False}, "alpha from the second frame on, no plain mean of the first ones"),
    Row("with-warm-up", {"warm_up": True}, "the plain mean of the first frames"),
    Row("no-feedback", {"feedback_level": -1}, "the history is never filtered"),
    *(
        Row(f"feedback-{level}", {"feedback_level": level}, f"the history is the output of level {level}")
        for level in range(3)
    ),
    # Variance
    Row("variance-svgf", {"variance": "svgf"}, "over time; over 7 x 7 pixels while history is short"),
    Row("variance-spatial", {"variance": "spatial"}, "always over 7 x 7 pixels"),
    Row("variance-temporal", {"variance": "temporal"}, "over time only, times variance_scale"),
    Row("variance-temporal-1", {"variance": "temporal", "variance_scale": 1.0}, "over time only, times 1"),
    Row("no-prefilter", {"prefilter": False}, "the variance is not blurred before use"),
    Row("with-prefilter", {"prefilter": True}, "the variance is blurred over 3 x 3 before use"),
    # Edge-stopping
    Row("no-luminance-weight", {"luminance_epsilon": 1e9}, "light edges stop nothing: the variance guides nothing"),
    Row("no-normal-weight", {"sigma_normal": 0.0}, "normals stop nothing"),
    Row("no-depth-weight", {"depth_epsilon": 1e9}, "depth stops nothing"),
    # Levels
    *(Row(f"levels-{n}", {"levels": n}, f"{n} a-trous level{'s' * (n != 1)}") for n in range(6)),
    # What the paper does not have, or names only
    Row("no-outlier-removal", {"outlier_radius": 0}, "illumination taken as it is"),
    Row("with-outlier-removal", {"outlier_radius": 3}, "illumination clamped to its 7 x 7 neighbours first"),
    Row("no-clamp", {"clamp_radius": 0}, "history taken as it is"),
    Row("with-clamp", {"clamp_radius": 3}, "history clamped to this frame's 7 x 7 pixels"),
    Row("no-light", {"light_cell": 0}, "changes of the light not followed"),
    Row("with-light", {"light_cell": 4}, "history follows changes of the light"),
    Row("no-taa", {"taa": False}, "no temporal anti-aliasing"),
    Row("with-taa", {"taa": True}, "temporal anti-aliasing of the result"),
)
"""All rows, those for any base; `grid` leaves out what a base has already."""


def settings_of(row: Row, params: Params, config: Config) -> tuple[Params, Config]:
    """A row's parameters and choices. Values per level are cut to its number of levels, or their last one repeated.

    Raises SvgfError: a change that is not possible.
    """
    levels = row.changes.get("levels", config.levels)

    def fit(leaf: np.ndarray) -> np.ndarray:
        return leaf if leaf.ndim == 0 else leaf[np.minimum(np.arange(levels), len(leaf) - 1)] if levels else leaf[0]

    return override(Params(*(fit(np.asarray(leaf)) for leaf in params)), config, row.changes)


def grid(params: Params, config: Config, *, signals: int = 2, albedo: bool = True) -> tuple[Row, ...]:
    """The rows that differ from a base with these parameters, for frames of so many signals, with an albedo or without."""

    def differs(row: Row) -> bool:
        if row.alter is not None:
            return albedo if row is NO_DEMODULATION else signals > 1 if row is ONE_SIGNAL else True
        changed_params, changed_config = settings_of(row, params, config)
        same = all(np.array_equal(*pair) for pair in zip(changed_params, params, strict=True))
        return not (changed_config == config and same)

    return tuple(row for row in ROWS if differs(row))


def choose_rows(only: Iterable[str], among: Sequence[Row]) -> tuple[Row, ...]:
    """The rows of `among` that names or patterns (`levels-*`) stand for; all if there are none. SvgfError: a name of none."""
    patterns = list(only)
    names = [row.name for row in among]
    for pattern in patterns:
        if fnmatch.filter(names, pattern):
            continue
        if fnmatch.filter((row.name for row in ROWS), pattern):
            raise SvgfError(
                f"row {pattern} changes nothing here: the base is so already. There are {', '.join(names)}."
            )
        raise SvgfError(f"no row {pattern!r}; there are {', '.join(names)}{suggest(pattern, names)}")
    return tuple(row for row in among if not patterns or any(fnmatch.fnmatchcase(row.name, p) for p in patterns))


def ablate(
    source: frames.Source,
    references: Mapping[int, str],
    *,
    rows: Sequence[Row] = ROWS,
    params: Params = Params(),
    config: Config = Config(),
    device: str | None = None,
    pipeline: Pipeline | None = None,
    on_frame: Callable[[Row, int], None] = lambda row, number: None,
    on_image: Callable[[str, int, np.ndarray, np.ndarray | None], None] = lambda name, number, image, target: None,
) -> Iterator[Measured]:
    """Measure the base and then each row. The sequence is read anew for each, one frame in memory at a time.

    A frame's time is that of `step` alone: nothing is read or scored meanwhile.

    Args:
        source: the noisy frames; a missing one starts the history anew.
        references: their files by frame number (`references.pair_references`).
        rows: besides the base.
        params, config: the base.
        device, pipeline: as for `streaming.run`.
        on_frame: called with the row and the number of each frame that is done.
        on_image: called with the row's name, the frame's number, its filtered image `[H, W, 3]` and its reference or None.

    Raises:
        SvgfError: a row that is not possible (before any work), unreadable or mismatching input.
    """
    chosen = [(row, *settings_of(row, params, config)) for row in (BASE, *rows)]
    return (_measure(source, references, *one, device, pipeline, on_frame, on_image) for one in chosen)


def _measure(
    source: frames.Source,
    references: Mapping[int, str],
    row: Row,
    params: Params,
    config: Config,
    device: str | None,
    pipeline: Pipeline | None,
    on_frame: Callable[[Row, int], None],
    on_image: Callable[[str, int, np.ndarray, np.ndarray | None], None],
) -> Measured:
    times: list[float] = []
    numbers: list[int] = []

    def filtered() -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
        filters = history = None
        for index, (number, path) in enumerate(source.sequence.files):
            if path is None:
                history = None
                continue
            frame = frames.read_frame(source, index).frame
            size = frame.depth.shape
            target = read_reference(references[number], size=size, number=number) if number in references else None
            frame = frame if row.alter is None else row.alter(frame)
            if filters is None:
                filters = compile_filters(params, config, device=device, pipeline=pipeline)
                to_host(filters.step(filters.init(frame), frame)[1], path)  # compiles
            history = filters.init(frame) if history is None else history
            began = time.perf_counter()
            history, output = filters.step(history, frame)
            image = np.asarray(to_host(output, path).image)
            times.append(time.perf_counter() - began)
            numbers.append(number)
            on_image(row.name, number, image, target)
            yield image, target
            on_frame(row, number)

    every = list(score_frames(filtered()))
    scores = {number: score for number, score in zip(numbers, every, strict=True) if score is not None}
    return Measured(row, mean_scores(scores.values()), float(np.median(times)), scores)
