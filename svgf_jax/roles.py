"""Which channel of an EXR plays which role.

Native names, as they are looked for in each frame's file:

| role       | channels                     | where absent                                              |
|------------|------------------------------|-----------------------------------------------------------|
| `direct`   | `direct.R direct.G direct.B` | one of direct, indirect, radiance must be there           |
| `indirect` | `indirect.R ...`             |                                                           |
| `radiance` | `R G B`, if neither is there | (the full beauty: emission, if there is any, is taken off)|
| `emission` | `emission.R ...`             | 0: emitters are filtered like everything else             |
| `albedo`   | `albedo.R ...`               | 1: textures are filtered together with the light          |
| `normal`   | `normal.X normal.Y normal.Z` | one direction for all: normals stop no edges              |
| `depth`    | `depth.Z`, or `Z`            | 1: depth stops no edges                                   |
| `motion`   | `motion.X motion.Y`          | from the cameras; without them 0: everything stands still |
| `id`       | `id.I`                       | one object: only depth and normals tell surfaces apart    |
| `position` | `position.X ...`             | from depth and camera where needed                        |
| `hit_distance` | `hit_distance.Z`         | reflections move with their surface                       |
| `roughness` | `roughness.Y`               | 0, where there is a hit distance: mirrors                 |
| `alpha`    | `A`, if radiance is `R G B`  | every pixel may have a surface                            |
| `direct_variance`, `indirect_variance`, `radiance_variance` | `direct.variance` ... | estimated by the filter    |

A variance is that of the mean of a pixel's samples (the samples' own divided by their number), of its luminance. It is used
where every signal has one.

A renderer's own names are in its table (`svgf_jax.renderers`), with those kinds of light that it writes apart, each with its own
albedo. Where that table says nothing of a role, or a table of one's own names what is not there, the native name is looked for.
`environment` is added to the emission.

Any role can be given by hand: other channels (`channel`; "none" leaves the role out), another file (`file`), or both. What is in
neither is looked for in files of the same name beside `beauty_####.exr` (or color_): `normal_####.exr`, `depth_####.exr`, ...
"""

import difflib
import os
from collections.abc import Collection, Iterable, Mapping
from types import MappingProxyType
from typing import NamedTuple

from svgf_jax.renderers import ALIASES, NATIVE, WIDTH, Signal, Table, pick
from svgf_jax.types import SvgfError

_NATIVE = {
    "radiance": ("R G B",),
    "normal": ("normal.X normal.Y normal.Z",),
    "position": ("position.X position.Y position.Z",),
    "depth": ("depth.Z", "Z"),
    "motion": ("motion.X motion.Y",),
    "id": ("id.I",),
    "hit_distance": ("hit_distance.Z",),
    "roughness": ("roughness.Y",),
    "alpha": ("A",),
    **{f"{signal}_variance": (f"{signal}.variance",) for signal in ("direct", "indirect", "radiance")},
}
_IN_OWN_FILE = {3: ("R G B", "X Y Z"), 2: ("X Y", "R G"), 1: ("Z", "I", "Y", "V", "R", "A")}
_SIGNALS = ("direct", "indirect", "radiance")
_ABSENT = {
    "emission": "0: emitters are filtered like everything else",
    "albedo": "1: textures are filtered together with the light and will blur",
    "normal": "one direction for all: edges between faces are kept by depth and luminance alone",
    "depth": "1 everywhere: edges between objects are kept by normals and luminance alone",
    "motion": "0: what moves, or a camera that does, will leave trails",
    "id": "one object: surfaces are told apart by depth and normals alone",
}


class Layer(NamedTuple):
    """The channels of one role; `own_file` if they are in the role's own file (`file`), not in the frame's.

    `meaning` says what its numbers mean where that is not what this library means (`svgf_jax.renderers`).
    """

    channels: tuple[str, ...]
    own_file: bool
    reason: str
    meaning: str = ""


class Light(NamedTuple):
    """What a signal has for an albedo: a role ("" = none), and whether its light is already divided by it."""

    albedo: str
    divided: bool


class Bare(NamedTuple):
    """A kind of light whose albedo is not there: its channels, the albedo's name, and whether it is divided by that."""

    channels: tuple[str, ...]
    albedo: str
    divided: bool


REST = "rest"
"""The signal that is what a beauty has beyond the kinds of light that are there."""


class Roles(NamedTuple):
    """Layer by role for what is there, and for what is not the default that stands in and what that costs.

    `signals` names the roles that are filtered, in the order of `Frame.radiance`, and `light` says what each is. Where kinds of
    light and the beauty that they make up are both there, the layer `radiance` is that beauty, and no signal; `rest` names what
    of it has no signal of its own. `derived` says by role what tells it where no channel does, and `bare` which kinds of light
    lack their albedo; those that are divided by it are no signals.
    """

    layers: dict[str, Layer]
    absent: dict[str, str]
    signals: tuple[str, ...]
    light: dict[str, Light]
    renderer: str = NATIVE.name
    derived: Mapping[str, str] = MappingProxyType({})
    bare: Mapping[str, Bare] = MappingProxyType({})
    rest: tuple[str, ...] = ()

    def describe(self, *, absent: bool = True) -> str:
        """The mapping in one line a role, for people; `absent`: with those that are not there."""
        told = self.told(absent=absent)
        width = max(map(len, told))
        return "\n".join(f"{role:{width}}  {text}" for role, text in told.items())

    def told(self, *, absent: bool = True, types: Mapping[str, str] = MappingProxyType({})) -> dict[str, str]:
        """By role, in words, its channels, or what there is in place of them; `types`: what the channels of a role hold."""
        told: dict[str, str] = {}
        for role, layer in self.layers.items():
            if role.removesuffix("_albedo") in self.light and role.endswith("_albedo"):
                continue  # stands in its light's line
            by = self.layers.get(f"{role}_albedo") if role in self.light else None
            names = short_names(layer.channels) + (f", albedo {short_names(by.channels)}" if by else "")
            kind = f", {types[role]}" if role in types else ""
            told[role] = f"{names}{kind} ({layer.reason}{'; ' if layer.meaning else ''}{layer.meaning})"
        if REST in self.signals:
            without = f": {', '.join(map(self._in_rest, self.rest))}" if self.rest else ""
            told[REST] = f"{short_names(self.layers['radiance'].channels)} less the light above{without}"
        if absent:
            told |= {role: f"not there: {by}" for role, by in self.derived.items()}
            told |= {role: f"not there, taken as {default}" for role, default in self.absent.items()}
        return told

    def told_by(self, role: str, what: str) -> "Roles":
        """The same where something else tells a role that is not there: `cameras.json says`."""
        absent = {other: default for other, default in self.absent.items() if other != role}
        return self._replace(absent=absent, derived={**self.derived, role: what})

    def _in_rest(self, role: str) -> str:
        return f"{role} (no {self.bare[role].albedo})" if role in self.bare else role


def resolve_roles(
    channels: Collection[str],
    *,
    channel: Mapping[str, Iterable[str]] | None = None,
    files: Mapping[str, tuple[str, Collection[str]]] | None = None,
    beside: Collection[str] = (),
    table: Table = NATIVE,
    meaning: Mapping[str, str] | None = None,
    where: str = "the file",
) -> Roles:
    """Find the roles among the channel names of a frame's file.

    Args:
        channels: names in the frame's file.
        channel: role -> channel names, given by hand; one name may stand for all three of a colour.
        files: role -> (file name, its channel names) for roles with a file of their own.
        beside: those of `files` that were found beside the frames rather than given by hand.
        table: the renderer's own names.
        meaning: role -> what its numbers mean, in place of what the table says.
        where: the frame's file, for messages.

    Raises SvgfError: no radiance, an unknown role, a channel that is not there (the closest names are listed), a role
    with only some of its channels.
    """
    without = left_out(channel)
    by_hand = {canonical_role(role): tuple(names) for role, names in (channel or {}).items()}
    by_hand = {role: names for role, names in by_hand.items() if role not in without}
    own = {canonical_role(role): content for role, content in (files or {}).items()}
    means = {**table.meaning, **(meaning or {})}
    layers = {}
    for role in WIDTH:
        if role in without:
            continue
        if role in by_hand or role in own:
            file, names = own.get(role, (where, channels))
            layer = _given(role, by_hand.get(role), names, file, own_file=role in own, means=means.get(role, ""))
            layer = layer._replace(reason=f"in {os.path.basename(file)}") if role in beside else layer
        else:
            layer = _known(role, channels, where, table, means.get(role, ""))
        if layer:
            layers[role] = layer._replace(meaning=(meaning or {}).get(role) or layer.meaning or means.get(role, ""))
    asked = (by_hand.keys() | own.keys()) - set(beside)
    if "radiance" in asked and asked & {"direct", "indirect"}:
        raise SvgfError("radiance is the whole beauty; give by hand either it, or direct and indirect.")
    parts = layers.keys() & {"direct", "indirect"}
    for role in parts if "radiance" in asked else {"radiance"} if parts else ():
        layers.pop(role, None)
    light = {role: Light("albedo", False) for role in _SIGNALS if role in layers}
    bare, rest = {}, ()
    if not asked & {"radiance", "direct", "indirect"} and (kinds := _light_apart(layers, channels, table, where)):
        if "albedo" in asked:
            raise SvgfError(
                f"Got an albedo by hand, but in files of {table.title} each light has its own: {', '.join(kinds[0])}. Leave it "
                "out, or say by hand what light it belongs to (--channel radiance=NAME,NAME,NAME)."
            )
        layers.pop("albedo", None)
        light, bare, rest = kinds
    signals = tuple(light)
    if not signals:
        raise SvgfError(
            f"{where}: no radiance; wanted direct.R, direct.G, direct.B and indirect.R ..., or R, G, B. "
            f"{_nearest(['direct.R', 'indirect.R', 'R', 'radiance.R', 'beauty.R', 'Combined.R'], channels)} "
            "Say which it is: --channel radiance=NAME,NAME,NAME."
        )
    if "radiance" not in layers and "alpha" not in by_hand and table is NATIVE:
        layers.pop("alpha", None)
    measured = [f"{role}_variance" for role in signals]
    for role in [role for role in layers if role.endswith("_variance")]:
        if role not in measured or not layers.keys() >= set(measured):
            layers.pop(role)
    absent = {role: text for role, text in _ABSENT.items() if role not in layers}
    if any(f"{role}_albedo" in layers for role in signals):
        absent.pop("albedo", None)
    return Roles(layers, absent, signals, light, table.name, bare=bare, rest=rest)


def short_names(names: tuple[str, ...]) -> str:
    """`Normal.XYZ` for Normal.X, Normal.Y and Normal.Z; others as they are."""
    stems, letters = {name.rpartition(".")[0] for name in names}, [name.rpartition(".")[2] for name in names]
    if len(stems) > 1 or "" in stems or len(set(letters)) == 1 or max(map(len, letters)) > 1:
        return " ".join(names)
    return f"{stems.pop()}.{''.join(letters)}"


def check_channels(layer: Layer, channels: Collection[str], *, where: str, role: str) -> None:
    """Raise SvgfError where a later frame lacks a role's channels."""
    if gone := [name for name in layer.channels if name not in channels]:
        raise SvgfError(
            f"{where}: no channel {gone[0]!r}, which is {role} in the frames before. {_nearest(gone, channels)}"
        )


def canonical_role(name: str) -> str:
    """The role that a name given by hand means. Raises SvgfError."""
    role = ALIASES.get(name, name)
    if role not in WIDTH:
        raise SvgfError(f"no role is called {name!r}; roles are {', '.join(WIDTH)}.")
    return role


def left_out(channel: Mapping[str, Iterable[str]] | None) -> set[str]:
    """The roles that are "none" by hand: not to be read, though they may be there."""
    return {canonical_role(role) for role, names in (channel or {}).items() if tuple(names) == ("none",)}


def _light_apart(
    layers: dict[str, Layer], channels: Collection[str], table: Table, where: str
) -> tuple[dict[str, Light], dict[str, Bare], tuple[str, ...]] | None:
    """The kinds of light that a renderer wrote apart, put into `layers` with their albedos; those that lack one; `Roles.rest`."""
    light: dict[str, Light] = {}
    bare: dict[str, Bare] = {}
    for signal in table.light:
        names = pick(signal.name, signal.channels, 3, channels, table=table, where=where)
        albedo = pick(f"{signal.name}_albedo", signal.albedo, 3, channels, table=table, where=where)
        if names is None:
            continue
        if albedo is None and signal.albedo:
            bare[signal.name] = Bare(names, _of_its_kind(signal, names), signal.divided)
        if albedo is None and signal.divided:
            continue
        layers[signal.name] = Layer(
            names, False, f"{table.name} name", "divided by its albedo" if signal.divided else ""
        )
        if albedo is not None:
            layers[f"{signal.name}_albedo"] = Layer(albedo, False, f"{table.name} name")
        light[signal.name] = Light(f"{signal.name}_albedo" if albedo else "", signal.divided)
    if not light:
        return None
    rest = [role for role in table.complete if role not in layers]
    if "radiance" not in layers or (table.complete and not rest):
        return light, bare, ()
    rest += [role for role, one in bare.items() if one.divided and role not in rest]
    return light | {REST: Light("", False)}, bare, tuple(rest)


def _of_its_kind(signal: Signal, names: tuple[str, ...]) -> str:
    """What the albedo of a light is called where the light is called so: GlossCol where it is GlossDir, not Glossy Color."""
    at = next((i for i, text in enumerate(signal.channels) if names[0].endswith(text[:-2])), 0)
    return signal.albedo[min(at, len(signal.albedo) - 1)].replace(".RGB", "").replace(".rgb", "")


def _given(
    role: str, names: tuple[str, ...] | None, there: Collection[str], file: str, *, own_file: bool, means: str
) -> Layer:
    """A role that was given by hand: its names, or what a file of its own calls them."""
    width = _width(role, means)
    if names is None:
        sets = [text.split() for text in (*_spellings(role), *_IN_OWN_FILE[width])]
        names = next((tuple(names) for names in sets if all(name in there for name in names)), None)
        if names is None and width == 1 and len(there) == 1:
            names = tuple(there)
        if names is None:
            wanted = " or ".join(" ".join(names) for names in sets)
            raise SvgfError(
                f"{file}: channels for {role} not found; wanted {wanted}; there are {', '.join(sorted(there))}. "
                f"Say which: --channel {role}={','.join(['NAME'] * width)}."
            )
        return Layer(names, own_file, "file given by hand")
    if len(names) == 1 and width == 3 and role not in ("normal", "position"):
        names = names * 3
    if len(names) != width:
        raise SvgfError(f"{role} has {len(names)} channels by hand ({', '.join(names)}); wanted {width}.")
    if gone := [name for name in names if name not in there]:
        raise SvgfError(f"{file}: no channel {gone[0]!r} for {role}. {_nearest(gone, there)}")
    return Layer(names, own_file, "given by hand")


def _known(role: str, channels: Collection[str], where: str, table: Table, means: str) -> Layer | None:
    """A role by the renderer's names for it; by its native name where its table says nothing of it."""
    width = _width(role, means)
    if role not in table.channels and width == WIDTH[role]:
        return _native(role, channels, where)
    spellings = table.channels.get(role, ("motion.XYZ",))
    for texts, meaning in ((spellings, ""), (table.channels.get(f"camera_{role}", ()), "camera")):
        names = pick(role, texts, width, channels, table=table, where=where)
        if names is not None:
            return Layer(names, False, f"{table.name} name", meaning)
    return _native(role, channels, where) if table.file and width == WIDTH[role] else None


def _width(role: str, means: str) -> int:
    """Motion in world space has three channels."""
    return 3 if role == "motion" and "world" in means.split() else WIDTH[role]


def _native(role: str, channels: Collection[str], where: str) -> Layer | None:
    for text in _spellings(role):
        names = tuple(text.split())
        there = [name for name in names if name in channels]
        if len(there) == len(names):
            return Layer(names, False, "native name" if text == _spellings(role)[0] else "standard name")
        if there and role != "radiance":
            gone = next(name for name in names if name not in channels)
            raise SvgfError(
                f"{where}: {', '.join(there)} but no {gone}; wanted all of {role}. {_nearest([gone], channels)}"
            )
    return None


def _spellings(role: str) -> tuple[str, ...]:
    return _NATIVE.get(role, (f"{role}.R {role}.G {role}.B",))


def _nearest(wanted: Iterable[str], channels: Collection[str]) -> str:
    """The closest names that are there, for an error message."""
    close = [name for want in wanted for name in difflib.get_close_matches(want, channels, n=4, cutoff=0.5)]
    if close:
        return f"Closest: {', '.join(list(dict.fromkeys(close))[:6])}."
    names = sorted(channels)
    return f"There are {', '.join(names[:12])}" + (f" and {len(names) - 12} more." if len(names) > 12 else ".")
