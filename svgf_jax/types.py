"""The data that flows through the filter: `Frame`, `History`, `Output`, `Params`, `Config`.

Conventions, stated here once:

- Arrays are `[H, W, C]`, a sequence has a leading `T`, a frame has S >= 1 *signals*. Row 0 is at the top, x points right,
  y down; the centre of pixel (x, y) is at (x + 0.5, y + 0.5).
- Radiance is scene-linear and unclamped. Luminance is Rec. 709: 0.2126 R + 0.7152 G + 0.0722 B.
- A *signal* is reflected radiance with an albedo of its own. SVGF's direct and indirect light share one albedo (S = 2); a
  plain beauty pass is S = 1. beauty = sum of radiance over the signals + emission.
- `prev_` marks the previous frame; no prefix means this one.

| channel       | shape                  | unit and range                                                                    |
|---------------|------------------------|-----------------------------------------------------------------------------------|
| `radiance`    | `[S, H, W, 3]`         | scene-linear, >= 0                                                                |
| `albedo`      | `[S or 1, H, W, 3]`    | reflectance, >= 0 (1 where the radiance is already demodulated)                   |
| `emission`    | `[H, W, 3]`            | scene-linear; emitters and background, never filtered                             |
| `normal`      | `[H, W, 3]`            | unit length, world space                                                          |
| `depth`       | `[H, W]`               | linear view-space z, > 0 in front of the camera                                   |
| `prev_depth`  | `[H, W]`               | the depth that this surface point had in the previous frame's camera, else `depth`|
| `motion`      | `[H, W, 2]`            | pixels: previous position = this position + motion (x right, y down)              |
| `object_id`   | `[H, W]` int32         | any number per object; -1 = no surface (background)                               |
| `position`    | `[H, W, 3]` or None    | world space; None = not known; only the joint bilateral filter reads it            |
| `variance`    | `[S, H, W]` or None    | measured variance of the pixel's mean, of the radiance's luminance; < 0 = unknown |
| `reflected_motion`     | `[S, H, W, 2]` or None | as `motion`, of what the surface reflects; not finite = moves with the surface |
| `reflected_prev_depth` | `[S, H, W]` or None    | depth of the reflecting surface at that previous position                      |
| `longest_history`      | `[S, H, W]` or None    | frames of history worth keeping, >= 1                                          |

The last three, from `svgf_jax.trace_reflections`, come together or not at all.
"""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from jax import Array
else:
    Array = Any  # importing this module must not import jax: the command line answers errors without it


class SvgfError(Exception):
    """An error its reader can act on: the message says what was got, what was wanted and what to try."""


class Frame(NamedTuple):
    """One frame as the renderer wrote it. Shapes and units: the table at the top of this module."""

    radiance: Array
    albedo: Array
    emission: Array
    normal: Array
    depth: Array
    prev_depth: Array
    motion: Array
    object_id: Array
    variance: Array | None = None
    position: Array | None = None
    reflected_motion: Array | None = None
    reflected_prev_depth: Array | None = None
    longest_history: Array | None = None


class TaaHistory(NamedTuple):
    """What temporal anti-aliasing needs of the past.

    Attributes:
        color: `[H, W, 3]`, the frame before, anti-aliased, on the tone curve c / (1 + luma): its display image.
        frames: how many frames went into it, a scalar of the image's dtype; 0 = none.
    """

    color: Array
    frames: Array


class History(NamedTuple):
    """What the next frame needs of the past.

    Attributes:
        illumination: `[S, H, W, 3]`, accumulated demodulated radiance, filtered up to `Config.feedback_level`.
        moments: `[S, H, W, 2]`, accumulated first and second moment of the illumination's luminance.
        history_length: `[H, W]`, frames accumulated, a real number in [0, max_history]; 0 = no history.
        depth, normal, object_id: the sanitised guides of the frame that this history ends with.
        taa: what temporal anti-aliasing remembers; None where `Config.taa` is off.
        effective_history: `[S, H, W]`, as in `Output`; None = not kept; `init` is asked for it.
    """

    illumination: Array
    moments: Array
    history_length: Array
    depth: Array
    normal: Array
    object_id: Array
    taa: TaaHistory | None = None
    effective_history: Array | None = None


class Reprojected(NamedTuple):
    """History brought to this frame's pixels; 0 where there is none.

    Attributes:
        illumination: `[S, H, W, 3]`.
        moments: `[S, H, W, 2]`.
        history_length: `[H, W]`, a real number.
        valid: `[H, W]` bool, whether there is history.
        change, effective_history: `[S, H, W]`, as in `Output`.
    """

    illumination: Array
    moments: Array
    history_length: Array
    valid: Array
    change: Array | None = None
    effective_history: Array | None = None


class Rejected(NamedTuple):
    """How many pixels of a frame had to be repaired before filtering (int32 scalars).

    Attributes:
        radiance: pixels with a non-finite radiance component (set to 0), over all signals.
        negative: pixels with a finite negative radiance component (set to 0), over all signals.
        emission: pixels with a non-finite emission component (set to 0).
        surface: surface pixels dropped for a non-finite normal, depth or albedo.
        motion: surface pixels without history for a non-finite motion or prev_depth.
        normal: surface pixels with a normal not of unit length (brought to it).
        bright: pixels with a radiance component above 2**40, about 1e12 (set to that), over all signals.
    """

    radiance: Array
    negative: Array
    emission: Array
    surface: Array
    motion: Array
    normal: Array
    bright: Array


class Output(NamedTuple):
    """What a frame gives to the world.

    Attributes:
        image: `[H, W, 3]`, the filtered beauty, scene-linear; anti-aliased where `Config.taa` is on.
        illumination: `[S, H, W, 3]`, the filtered demodulated signals.
        variance: `[S, H, W]`, luminance variance before the a-trous filter; None from methods that have none.
        variance_filtered: `[S, H, W]`, the same after its last level.
        history_length: `[H, W]`, frames accumulated, this one included; 0 where there is no surface.
        valid: `[H, W]` bool, whether reprojection found history.
        rejected: counts of repaired pixels.
        display: `[H, W, 3]`, the anti-aliased image on its tone curve, c / (1 + luma); None where `Config.taa` is off.
        change: `[S, H, W]`, by how much the history's luminance was corrected to this frame's light, as a share of the brighter
            of the two: 0.5 = doubled, -0.9 = a tenth of it is left, 0 = as it was; None where `Config.light_cell` is 0.
        effective_history: `[S, H, W]`, how many frames the accumulated illumination is worth: the mean of so many frames of
            this one's light has its noise per pixel, spatial filters left out; 0 where there is no surface; None where the
            history has none.
    """

    image: Array
    illumination: Array
    variance: Array | None
    variance_filtered: Array | None
    history_length: Array
    valid: Array
    rejected: Rejected
    display: Array | None = None
    change: Array | None = None
    effective_history: Array | None = None


class Params(NamedTuple):
    """The filter's numbers. Traced and differentiable; each a scalar or one value per a-trous level.

    The defaults are the preset `paper`. Where a stage other than the a-trous filter reads a per-level value, it takes entry 0.
    Falcor's SVGFPass has other names for some: Alpha, MomentsAlpha, PhiNormal (sigma_normal), PhiColor (sigma_luminance).

    Attributes:
        alpha: least weight of the new frame in the accumulated illumination, in [0, 1].
        alpha_moments: the same for the moments.
        sigma_depth: depth edge-stopping, in units of the depth that the local slope predicts, >= 0.
        sigma_normal: normal edge-stopping, exponent of the cosine, >= 0.
        sigma_luminance: luminance edge-stopping, in standard deviations, >= 0.
        short_history_boost: factor on the spatial variance estimate at history length 1, >= 1.
        max_history: cap of the history length, in frames, >= 1.
        albedo_floor: smallest albedo divided by, >= 2**-30 (about 1e-9).
        depth_epsilon: depth tolerance relative to depth, >= 0.
        luminance_epsilon: luminance tolerance, >= 0.
        reproject_depth: largest relative depth difference of a consistent previous pixel, >= 0.
        reproject_normal: smallest cosine between the normals of consistent pixels, in [-1, 1].
        kernel_near: a-trous tap at distance 1 relative to the centre tap (B3 spline: 2/3), >= 0.
        kernel_far: a-trous tap at distance 2 relative to the centre tap (B3 spline: 1/6), >= 0.
        light_gain_threshold: standard errors by which the light over a wide neighbourhood must differ from the history's
            before the history is scaled to it, >= 0. This and the next two are read only where `light_cell` > 0.
        light_offset_threshold: the same over a narrow neighbourhood, before the rest of the difference is added, >= 0.
        light_sigma_normal: normal edge-stopping of these neighbourhoods, exponent of the cosine, >= 0.
        initial_variance: the variance of a pixel without history, >= 0. This and the next are read only where `variance` is
            "temporal".
        variance_scale: factor on the temporal variance, >= 0.
        clamp_sigma: standard deviations that the history may lie off this frame's mean, >= 0. Read only where
            `clamp_radius` > 0.
        taa_alpha: least weight of the new frame in temporal anti-aliasing, in [0, 1]. Read only where `taa` is on.
        outlier_sigma: standard deviations that a pixel may lie off its neighbours' mean, >= 0. Read only where
            `outlier_radius` > 0.
    """

    alpha: Any = 0.2
    alpha_moments: Any = 0.2
    sigma_depth: Any = 1.0
    sigma_normal: Any = 128.0
    sigma_luminance: Any = 4.0
    short_history_boost: Any = 1.0
    max_history: Any = 32.0
    albedo_floor: Any = 1e-3
    depth_epsilon: Any = 1e-3
    luminance_epsilon: Any = 1e-6
    reproject_depth: Any = 0.1
    reproject_normal: Any = 0.9
    kernel_near: Any = 2 / 3
    kernel_far: Any = 1 / 6
    light_gain_threshold: Any = 1.5
    light_offset_threshold: Any = 2.1
    light_sigma_normal: Any = 64.0
    initial_variance: Any = 100.0
    variance_scale: Any = 100.0
    clamp_sigma: Any = 1.0
    taa_alpha: Any = 0.1
    outlier_sigma: Any = 10.0


class Config(NamedTuple):
    """The filter's static choices: hashable, part of what jit compiles for.

    Attributes:
        levels: number of a-trous levels, >= 0; level i has step size 2**i.
        feedback_level: the level whose output becomes the history illumination; -1 = the unfiltered accumulation.
            Beyond the last level it is the last.
        light_cell: follow changes of the light, judged over cells of this many pixels squared; 0 = do not.
        variance: the estimator: "svgf" (temporal, spatial while history is short), "temporal" or "spatial" (always).
        reprojection: `bilinear` takes the consistent ones of the 2 x 2 previous pixels around a point, `nearest` the one
            pixel that it falls into.
        fallback: where those give nothing, take the mean of the consistent ones of 3 x 3.
        id_test: a previous pixel is consistent only if it shows the same object.
        warm_up: weigh the first frames of a history equally (1 / history length) until alpha is reached; off, alpha
            holds from the second frame on.
        clamp_radius: clamp the history to mean +- clamp_sigma standard deviations of this frame's illumination over
            a window of this radius (3 = 7 x 7); 0 = do not.
        taa: temporal anti-aliasing of the image, after everything else.
        outlier_radius: clamp this frame's illumination to mean +- outlier_sigma standard deviations of the neighbours in
            a window of this radius (3 = 7 x 7) before anything reads it; 0 = do not.
        prefilter: blur the variance (3 x 3 Gaussian) before it scales the luminance edge-stopping of an a-trous level.
    """

    levels: int = 5
    feedback_level: int = 0
    light_cell: int = 0
    variance: str = "svgf"
    reprojection: str = "bilinear"
    fallback: bool = True
    id_test: bool = True
    warm_up: bool = True
    clamp_radius: int = 0
    taa: bool = False
    outlier_radius: int = 0
    prefilter: bool = True


CHOICES: dict[str, range | tuple[Any, ...]] = {
    "levels": range(13),
    "feedback_level": range(-1, 13),
    "light_cell": range(13),
    "variance": ("svgf", "temporal", "spatial"),
    "reprojection": ("bilinear", "nearest"),
    "fallback": (True, False),
    "id_test": (True, False),
    "warm_up": (True, False),
    "clamp_radius": range(13),
    "taa": (False, True),
    "outlier_radius": range(13),
    "prefilter": (True, False),
}
"""What each field of `Config` may be."""

_READ_WHERE: dict[str, tuple[str, Any]] = {
    "light_gain_threshold": ("light_cell", range(1, 13)),
    "light_offset_threshold": ("light_cell", range(1, 13)),
    "light_sigma_normal": ("light_cell", range(1, 13)),
    "initial_variance": ("variance", ("temporal",)),
    "variance_scale": ("variance", ("temporal",)),
    "clamp_sigma": ("clamp_radius", range(1, 13)),
    "taa_alpha": ("taa", (True,)),
    "outlier_sigma": ("outlier_radius", range(1, 13)),
}
"""Parameters that are read only where a choice has one of some values."""


def unread(config: Config) -> frozenset[str]:
    """The parameters that nothing reads with these choices."""
    return frozenset(name for name, (choice, values) in _READ_WHERE.items() if getattr(config, choice) not in values)


def is_choice(name: str, value: Any, *, choices: Mapping[str, range | tuple[Any, ...]] = CHOICES) -> bool:
    """Whether a field of `Config` may have this value: True is not 1."""
    return any(type(value) is type(one) and value == one for one in choices[name])


def choices_of(name: str, *, choices: Mapping[str, range | tuple[Any, ...]] = CHOICES) -> str:
    """The values that a field of `Config` may have, in words."""
    values = choices[name]
    if isinstance(values, range):
        return f"a whole number from {values[0]} to {values[-1]}"
    return " or ".join(str(value).lower() for value in values)


def bounds_of(least: float, most: float) -> str:
    """A range of numbers in words; infinity is not a number."""
    return f"a number >= {least:g}" if math.isinf(most) else f"a number from {least:g} to {most:g}"


def at_level(params: Params, level: int) -> Params:
    """The scalars that an a-trous level reads: entry `level` of per-level leaves, scalar leaves as they are."""
    return Params(*(leaf[level] if getattr(leaf, "ndim", 0) == 1 else leaf for leaf in params))
