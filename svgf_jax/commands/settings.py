"""Options that set numbers and names: `--preset`, `--params`, `--set NAME=VALUE`, `--channel ROLE=...`. No JAX."""

from collections.abc import Generator, Iterable, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Group, Parameter

from svgf_jax import limits
from svgf_jax.commands.completing import LAYER, RENDERER
from svgf_jax.methods import METHOD_CHOICES, MethodConfig, check_settable, override_method
from svgf_jax.types import CHOICES, Config, Params, SvgfError, choices_of

Tonemap = Literal["reinhard-extended", "reinhard", "aces-narkowicz", "aces-hill", "linear"]  # tonemapping.CURVES


def choose(preset: str | None, file: Path | None, changes: Iterable[str]) -> tuple[str, Params, Config]:
    """(name for the record, parameters, choices) from a preset or a file, with single values changed."""
    from svgf_jax import parameters

    if preset is not None and file is not None:
        raise SvgfError(f"Got --preset {preset} and --params {file}; wanted one of them. --set changes single values.")
    name = preset or "paper"
    params, config = parameters.preset(name) if file is None else parameters.load_params(file)
    texts = assignments(changes, option="--set", example="sigma_normal=64")
    check_settable("svgf", texts)
    params, config = parameters.override(params, config, {key: _value(key, text) for key, text in texts.items()})
    record = name if file is None else file.name
    return " ".join([record, *(f"{key}={text}" for key, text in texts.items())]), params, config


def choose_method(
    method: str, preset: str | None, file: Path | None, changes: Iterable[str]
) -> tuple[str, Any, Config | MethodConfig]:
    """The same for any method."""
    if method == "svgf":
        return choose(preset, file, changes)
    for option, given in (("--preset", preset), ("--params", file)):
        if given is not None:
            raise SvgfError(
                f"Got {option} {given} and --method {method}; {option} is of svgf. --set changes single values."
            )
    texts = assignments(changes, option="--set", example="sigma_color=0.3")
    check_settable(method, texts)
    values = {key: _value(key, text, METHOD_CHOICES, per_level=False) for key, text in texts.items()}
    return " ".join([method, *(f"{key}={text}" for key, text in texts.items())]), *override_method(method, values)


Method = Literal[
    "svgf",
    "games202",
    "games202-atrous",
    "accumulate",
    "joint-bilateral",
    "joint-bilateral-atrous",
    "bilateral",
    "gaussian",
]
INPUT, PROJECT = Group("Input", sort_key=0), Group("Project", sort_key=9)
Flag: Parameter = Parameter(negative=(), show_default=False)
Repeated: Parameter = Parameter(negative=(), consume_multiple=False, show_default=False)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Largest:
    """How large the pictures may be that a command reads: one group for every command of both programs.

    Attributes:
        max_pixels: Read pictures of up to so many pixels.
        max_ratio: Above 256 MB of pixels, believe a file that claims up to so many times its own bytes.
    """

    max_pixels: Annotated[int, Parameter(metavar="COUNT", group=PROJECT)] = limits.MAX_PIXELS
    max_ratio: Annotated[int, Parameter(metavar="TIMES", group=PROJECT)] = limits.MAX_RATIO

    @contextmanager
    def held(self) -> Generator[None]:
        """Let them hold meanwhile."""
        limits.set_limits(self.max_pixels, self.max_ratio)
        try:
            yield
        finally:
            limits.set_limits()


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Reading:
    """The options that say what the input's channels and files mean: one group for every command that reads a sequence.

    (Not a NamedTuple: of its fields cyclopts sees no annotations.)

    Attributes:
        channel: The channels of a role, for example albedo=foo.R,foo.G,foo.B; motion=none leaves it out. Repeatable.
        file: The files of a role, for example normal=normal_####.exr. Repeatable.
        cameras: The cameras.json of the sequence, or matrix_#.mat; auto takes the one beside the frames, none ignores it.
        renderer: Whose names and conventions: native, mitsuba, cycles, falcor, pbrt, ..., or a table of your own (mine.toml).
        layer: The view layer, where a file has several.
        motion: What motion vectors mean: pixel|fraction|ndc|world, y-down|y-up, to-previous|from-previous|to-next|from-next.
        meaning: What others mean: depth=z|z-back|distance, normal=world|camera|camera y-down|camera z-back. Repeatable.
    """

    channel: Annotated[tuple[str, ...], Repeated, Parameter(metavar="ROLE=NAMES", group=INPUT)] = ()
    file: Annotated[tuple[str, ...], Repeated, Parameter(metavar="ROLE=PATTERN", group=INPUT)] = ()
    cameras: Annotated[str, Parameter(metavar="FILE", group=INPUT)] = "auto"
    renderer: Annotated[str, RENDERER, Parameter(metavar="NAME", group=INPUT)] = "auto"
    layer: Annotated[str | None, LAYER, Parameter(metavar="NAME", group=INPUT)] = None
    motion: Annotated[str | None, Parameter(metavar="WORDS", group=INPUT)] = None
    meaning: Annotated[tuple[str, ...], Repeated, Parameter(metavar="ROLE=WORDS", group=INPUT)] = ()

    def options(self) -> dict[str, Any]:
        """What they mean to `open_source`."""
        roles = assignments(self.channel, option="--channel", example="albedo=foo.R,foo.G,foo.B")
        return {
            "channel": {role: names.split(",") for role, names in roles.items()},
            "file": assignments(self.file, option="--file", example="normal=normal_####.exr"),
            "cameras": None if self.cameras == "none" else self.cameras,
            "renderer": self.renderer,
            "layer": self.layer,
            "motion": self.motion,
            "meaning": assignments(self.meaning, option="--meaning", example="depth=distance"),
        }


def assignments(texts: Iterable[str], *, option: str, example: str) -> dict[str, str]:
    """`NAME=VALUE` texts as a dictionary, each name once."""
    pairs: dict[str, str] = {}
    for text in texts:
        key, value = _split(text, option=option, example=example)
        if key in pairs:
            raise SvgfError(f"{option} {key} is given twice: {pairs[key]} and {value}. Leave one out.")
        pairs[key] = value
    return pairs


def _split(text: str, *, option: str, example: str) -> tuple[str, str]:
    key, equals, value = (part.strip() for part in text.partition("="))
    if not (key and equals and value):
        raise SvgfError(f"Got {option} {text!r}; wanted NAME=VALUE, for example {option} {example}.")
    return key, value


def _value(
    key: str, text: str, choices: Mapping[str, range | tuple[Any, ...]] = CHOICES, *, per_level: bool = True
) -> Any:
    """A number, or a comma list of one per a-trous level; for a choice one of its values."""
    if key in choices:
        named = {str(value).lower(): value for value in choices[key]}
        if text.lower() not in named:
            raise SvgfError(f"Got --set {key}={text}; wanted {choices_of(key, choices=choices)}.")
        return named[text.lower()]
    try:
        values = [float(item) for item in text.split(",")]
    except ValueError as error:
        wanted = "a number" + (f", or one per a-trous level: {key}=4,3,2,1,1" if per_level else "")
        raise SvgfError(f"Got --set {key}={text}; wanted {wanted}.") from error
    return values[0] if len(values) == 1 else values
