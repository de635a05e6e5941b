"""What `svgf-jax denoise --method` may be besides SVGF: the filters and the pipeline that SVGF grew from, with their numbers.

A method is a pair (params, config), as a preset is of SVGF, for `baseline_step` and `baseline_denoise`.
"""

import difflib
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from svgf_jax.parameters import suggest
from svgf_jax.types import CHOICES, Config, Params, SvgfError, bounds_of, choices_of, is_choice


class GaussianParams(NamedTuple):
    """Attributes: sigma_space: standard deviation in pixels, >= 0."""

    sigma_space: Any = 32.0


class BilateralParams(NamedTuple):
    """Attributes: sigma_space: see `GaussianParams`; sigma_color: in units of the radiance, >= 0."""

    sigma_space: Any = 32.0
    sigma_color: Any = 0.6


class JointBilateralParams(NamedTuple):
    """Attributes: as `BilateralParams`; sigma_normal: in radians, >= 0; sigma_plane: sine of an angle, >= 0."""

    sigma_space: Any = 32.0
    sigma_color: Any = 0.6
    sigma_normal: Any = 0.1
    sigma_plane: Any = 0.1


class AccumulateParams(NamedTuple):
    """Attributes: alpha: weight of the new frame, in [0, 1]; clamp_sigma: standard deviations that history may be off, >= 0."""

    alpha: Any = 0.2
    clamp_sigma: Any = 1.0


class Games202Params(NamedTuple):
    """The numbers of GAMES202's homework 5: those of `JointBilateralParams` and of `AccumulateParams`.

    Attributes:
        sigma_space: standard deviation of the window, in pixels, >= 0.
        sigma_color: how far colours may differ, in units of the radiance, >= 0.
        sigma_normal: how far normals may turn, in radians, >= 0.
        sigma_plane: how far a pixel may rise from the other's plane, the sine of an angle, >= 0.
        alpha: weight of the new frame, in [0, 1].
        clamp_sigma: standard deviations that the history may lie off this frame's mean, >= 0.
    """

    sigma_space: Any = 32.0
    sigma_color: Any = 0.6
    sigma_normal: Any = 0.1
    sigma_plane: Any = 0.1
    alpha: Any = 0.2
    clamp_sigma: Any = 1.0


class MethodConfig(NamedTuple):
    """The static choices of these methods.

    Attributes:
        filter: "none", "gaussian", "bilateral" or "joint-bilateral", for each frame alone.
        radius: of its window, in pixels.
        footprint: how the window is covered: "full", "separable" or "atrous" (see `svgf_jax.joint_bilateral`).
        levels, last_pass: of "atrous": its passes, None = as many as the radius asks for, and whether 3 x 3 taps follow.
        temporal: whether frames are reprojected and accumulated after that.
        reprojection, fallback, id_test, warm_up, clamp_radius: as in `Config`; read only with `temporal`.
        demodulate: filter the radiance over the albedo instead of the beauty; emission is then left alone.
    """

    filter: str = "joint-bilateral"
    radius: int = 16
    footprint: str = "full"
    levels: int | None = None
    last_pass: bool = False
    temporal: bool = True
    reprojection: str = "nearest"
    fallback: bool = False
    id_test: bool = True
    warm_up: bool = False
    clamp_radius: int = 3
    demodulate: bool = False


class Method(NamedTuple):
    """A method: what it does in a sentence, its defaults, and the fields of `config` that can be set."""

    summary: str
    params: Any
    config: MethodConfig
    choices: tuple[str, ...]


_WINDOW = ("radius", "footprint", "levels", "last_pass", "demodulate")
OVER_TIME = ("reprojection", "fallback", "id_test", "warm_up", "clamp_radius")
_FRAME = MethodConfig(temporal=False)

METHODS: dict[str, Method] = {
    "games202": Method(
        "joint bilateral filter, then project and accumulate: GAMES202's homework 5",
        Games202Params(),
        MethodConfig(),
        (*_WINDOW, *OVER_TIME),
    ),
    "games202-atrous": Method(
        "the same with the filter in a-trous passes",
        Games202Params(),
        MethodConfig(footprint="atrous"),
        (*_WINDOW, *OVER_TIME),
    ),
    "accumulate": Method(
        "project and accumulate only",
        AccumulateParams(),
        MethodConfig(filter="none", radius=0),
        ("demodulate", *OVER_TIME),
    ),
    "joint-bilateral": Method(
        "filter only, guided by color, normals and planes", JointBilateralParams(), _FRAME, _WINDOW
    ),
    "joint-bilateral-atrous": Method(
        "the same in a-trous passes", JointBilateralParams(), _FRAME._replace(footprint="atrous"), _WINDOW
    ),
    "bilateral": Method(
        "filter only, guided by color", BilateralParams(), _FRAME._replace(filter="bilateral"), _WINDOW
    ),
    "gaussian": Method("filter only, blind", GaussianParams(), _FRAME._replace(filter="gaussian"), _WINDOW),
}
"""The methods by name. The defaults are the homework's; the plain filters have the same window, so that only the guides differ."""

BOUNDS = dict.fromkeys(Games202Params._fields, (0.0, math.inf)) | {"alpha": (0.0, 1.0)}
"""Where each number may lie: (least, most), both included; infinity is not a number."""
METHOD_CHOICES: dict[str, range | tuple[Any, ...]] = {
    "filter": ("none", "gaussian", "bilateral", "joint-bilateral"),
    "radius": range(129),
    "footprint": ("full", "separable", "atrous"),
    "levels": (None, *range(9)),
    "last_pass": (False, True),
    "temporal": (True, False),
    "demodulate": (True, False),
    **{name: CHOICES[name] for name in OVER_TIME},
}
"""What each field of `MethodConfig` may be."""


def method(name: str) -> tuple[Any, MethodConfig]:
    """The numbers and choices of a method by name: games202, accumulate, joint-bilateral, bilateral, gaussian, and two -atrous.

    Raises SvgfError: no such method.
    """
    if name not in METHODS:
        hint = suggest(name, METHODS) or "; SVGF itself has presets"
        raise SvgfError(f"no method {name!r}; there are {', '.join(METHODS)}{hint}")
    return METHODS[name].params, METHODS[name].config


def settable(name: str) -> tuple[str, ...]:
    """What can be set of a method: its numbers, then its choices; `svgf` is one too here."""
    if name == "svgf":
        return (*Params._fields, *Config._fields)
    return (*METHODS[name].params._fields, *METHODS[name].choices)


def check_settable(name: str, keys: Mapping[str, Any]) -> None:
    """Raise `SvgfError` where something is set that the method does not have, saying whose it is."""
    own = settable(name)
    for key in keys:
        if key in own:
            continue
        others = [other for other in ("svgf", *METHODS) if key in settable(other)]
        if not others and name == "svgf":
            continue  # its own error has a suggestion
        near = difflib.get_close_matches(key, own, n=1)
        whose = (
            f"it belongs to {', '.join(others)}"
            if others
            else f"did you mean {near[0]}?"
            if near
            else "nor has another"
        )
        raise SvgfError(f"method {name} has no {key!r} ({whose}); wanted {', '.join(own)}")


def override_method(name: str, values: Mapping[str, Any]) -> tuple[Any, MethodConfig]:
    """A method with some numbers and choices replaced by name. Raises SvgfError: not of this method, out of range."""
    params, config = method(name)
    check_settable(name, values)
    for key, value in values.items():
        if key in params._fields:
            least, most = BOUNDS[key]
            number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
            if not (number and least <= value <= most):
                raise SvgfError(f"{key} = {value!r}; wanted {bounds_of(least, most)}")
            params = params._replace(**{key: float(value)})
        else:
            config = config._replace(**{key: value})
    check_method_config(config)
    return params, config


def check_method_config(config: MethodConfig) -> None:
    """Raise `SvgfError` unless every choice is one that there is."""
    for key, value in config._asdict().items():
        if not is_choice(key, value, choices=METHOD_CHOICES):
            raise SvgfError(f"{key} is {value!r}; wanted {choices_of(key, choices=METHOD_CHOICES)}")
    if config.footprint != "atrous" and (config.levels is not None or config.last_pass):
        raise SvgfError(
            f"levels and last_pass are of the footprint atrous; got levels = {config.levels}, last_pass = {config.last_pass} "
            f"with footprint = {config.footprint}. Leave them out, or set footprint=atrous."
        )
