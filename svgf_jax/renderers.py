"""What renderers call their channels and files, and what they mean by the numbers: one table a renderer, `tables/NAME.toml`.

A table is data. Its keys (all may be absent):

- `[detect]`: `channels`, `attributes` (of the header) and `files` (in the frame's folder); the table whose lines match most is it.
- `layered`: channels have a layer's name in front ("ViewLayer.Combined.R").
- `other_layers`: layers that are not meant unless they are asked for, or alone.
- `main`: which of several sequences in a folder holds the radiance, the likeliest first.
- `cameras`: where cameras are, if not in a cameras.json: `header` or `camera_matrices.h`.
- `[channels]`: role -> spellings, the best first. "Normal.XYZ" is Normal.X, Normal.Y and Normal.Z; "*" stands for anything.
- `[files]`: role -> names of the files beside the frames that hold it; # is the frame number.
- `[meaning]`: role -> what its numbers mean (below), where it is not what this library means.
- `[[light]]`: a signal of its own: `name`, `channels`, `albedo` (spellings too), `divided = true` if it is already divided by it.
- `complete`: signals and roles that make up the beauty; where not all of them are there, the rest of it is a signal too.
- `uncertain`: roles whose meaning is not known for certain; they are taken as this library's own, and that is told.
- `[settings]`: role -> what to switch on in the renderer to get it.

Meanings: of `motion` a convention (`svgf_jax.motion`); of `depth` "z" (this library's), "z-back" (negative in front) or "distance"
(along the ray); of `normal` and `position` "world" (this library's), "camera" (x right, y up, z into the picture), "camera z-back"
(y up, z out of it), "camera y-down" (z into it), or "camera or world" (whichever the cameras confirm); of `id` the number that
stands for no object.
"""

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from fnmatch import fnmatchcase, translate
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from svgf_jax.motion import parse_convention
from svgf_jax.parameters import sentences, suggest
from svgf_jax.toml import TomlFile, place, read_toml
from svgf_jax.types import SvgfError

_NONE: Mapping[str, Any] = MappingProxyType({})
WIDTH = {
    "direct": 3,
    "indirect": 3,
    "radiance": 3,
    "emission": 3,
    "environment": 3,
    "albedo": 3,
    "normal": 3,
    "depth": 1,
    "motion": 2,
    "id": 1,
    "position": 3,
    "hit_distance": 1,
    "roughness": 1,
    "alpha": 1,
    "direct_variance": 1,
    "indirect_variance": 1,
    "radiance_variance": 1,
}
"""Number of channels of each role."""

ALIASES = {"color": "radiance", "colour": "radiance", "beauty": "radiance", "object_id": "id"}

_NAMES: dict[str, tuple[str, ...]] = {
    "detect": ("channels", "attributes", "files"),
    "channels": (*WIDTH, "camera_normal", "camera_position"),
    "files": tuple(WIDTH),
    "meaning": ("motion", "depth", "normal", "position", "id"),
    "settings": tuple(WIDTH),
}
"""What may stand in each table of a table."""
FOLDER = Path(__file__).parent / "tables"


class Signal(NamedTuple):
    """A kind of light that is filtered by itself; `divided` if its albedo is already taken out of it."""

    name: str
    channels: tuple[str, ...]
    albedo: tuple[str, ...]
    divided: bool


class Table(NamedTuple):
    """A renderer's table; see the top of this module. `file` is where a table of one's own lies."""

    name: str
    title: str
    detect: Mapping[str, tuple[str, ...]] = _NONE
    layered: bool = False
    other_layers: tuple[str, ...] = ()
    main: tuple[str, ...] = ()
    cameras: str = ""
    channels: Mapping[str, tuple[str, ...]] = _NONE
    files: Mapping[str, tuple[str, ...]] = _NONE
    meaning: Mapping[str, str] = _NONE
    light: tuple[Signal, ...] = ()
    complete: tuple[str, ...] = ()
    uncertain: tuple[str, ...] = ()
    settings: Mapping[str, str] = _NONE
    file: str = ""


_OURS = ("direct.R", "indirect.R", "normal.X", "depth.Z", "motion.X", "id.I")
NATIVE = Table("native", "the names of svgf_jax itself", {"channels": _OURS})


def renderer_names() -> tuple[str, ...]:
    """The renderers that have a table, `native` first."""
    return (NATIVE.name, *sorted(path.stem for path in FOLDER.glob("*.toml")))


def load_table(name: str) -> Table:
    """The table of a renderer by name, or from a file of one's own (`NAME.toml` with its path). Raises SvgfError."""
    if name == NATIVE.name:
        return NATIVE
    path = Path(name) if name.endswith(".toml") else FOLDER / f"{name}.toml"
    if path.parent == FOLDER and path.stem not in renderer_names():
        known = ", ".join(renderer_names())
        hint = ". Did you mean cycles?" if name.lower() == "blender" else suggest(name, renderer_names())
        raise SvgfError(
            f"no renderer is called {name!r}{hint or '.'} There are {known}, or give a table of your own: "
            "shot/mine.toml."
        )
    return _load(path)


@cache
def _load(path: Path) -> Table:
    file = read_toml(path, "table of a renderer")
    fields: dict[str, Any] = {"name": path.stem, "title": path.stem, "file": "" if path.parent == FOLDER else str(path)}
    for key, value in file.content.items():
        _require_known(file, key, Table._fields[1:-1], "a table of a renderer", key)
        if key == "light":
            fields[key] = tuple(_signal(file, i, one) for i, one in enumerate(_of_type(file, list, value, key)))
        elif key in _NAMES:
            table = _of_type(file, dict, value, key)
            for name in table:
                _require_known(file, name, _NAMES[key], f"[{key}]", key, name)
            kind = str if key in ("meaning", "settings") else tuple
            fields[key] = {name: _of_type(file, kind, one, key, name) for name, one in table.items()}
        else:
            kind = bool if key == "layered" else str if key in ("title", "cameras") else tuple
            fields[key] = _of_type(file, kind, value, key)
    for role, text in fields.get("meaning", {}).items():
        try:
            check_meaning(role, text)
        except SvgfError as error:
            raise SvgfError(f"{place(file, 'meaning', role)}: {error}") from None
    for role, spellings in fields.get("channels", {}).items():
        for spelling in spellings:
            stem, _, letters = spelling.rpartition(".")
            if 1 < (width := WIDTH[role.removeprefix("camera_")]) > len(letters):
                example = f"{stem or role}.{'XY' if width == 2 else 'XYZ or .RGB'}"
                raise SvgfError(
                    f"{place(file, 'channels', role)}: {role} = {spelling!r}; wanted {width} channels: {example}."
                )
    lights = {signal.name for signal in fields.get("light", ())}
    for key, known in (("complete", {*lights, *WIDTH}), ("uncertain", set(WIDTH))):
        for name in fields.get(key, ()):
            _require_known(file, name, sorted(known), key, key, what="light or role" if key == "complete" else "role")
    cameras = fields.get("cameras", "header")
    if cameras != "header" and "." not in cameras:
        raise SvgfError(f"{place(file, 'cameras')}: cameras = {cameras!r}; wanted header, or the name of a file.")
    return Table(**fields)


def _signal(file: TomlFile, index: int, value: Any) -> Signal:
    """One [[light]]."""
    for key in _of_type(file, dict, value, "light", index):
        _require_known(file, key, Signal._fields, "[[light]]", "light", index, key)
    for key in ("name", "channels"):
        if key not in value:
            raise SvgfError(
                f"{place(file, 'light', index)}: [[light]] without {key!r}; wanted {', '.join(Signal._fields)}."
            )
    kinds = {"name": str, "channels": tuple, "albedo": tuple, "divided": bool}
    given: dict[str, Any] = {"albedo": (), "divided": False}
    given |= {key: _of_type(file, kinds[key], one, "light", index, key) for key, one in value.items()}
    return Signal(**given)


def _require_known(
    file: TomlFile, name: str, known: Collection[str], where: str, *keys: str | int, what: str = "key"
) -> None:
    if name not in known:
        near = ALIASES.get(name)
        hint = f". Did you mean {near}?" if near in known else suggest(name, known)
        raise SvgfError(f"{place(file, *keys)}: no {what} {name!r} in {where}{sentences(hint, known)}")


def _of_type(file: TomlFile, kind: type, value: Any, *keys: str | int) -> Any:
    """`value` if it is of this type; tuple: one text or a list of them. Raises SvgfError with its line."""
    if kind is tuple and isinstance(value, str):
        return (value,)
    if kind is tuple and isinstance(value, list) and all(isinstance(one, str) for one in value):
        return tuple(value)
    if kind is not tuple and isinstance(value, kind):
        return value
    wanted = {tuple: "a text, or a list of texts", str: "a text", bool: "true or false", dict: "a table"}
    name = ".".join(map(str, keys))
    raise SvgfError(f"{place(file, *keys)}: {name} = {value!r}; wanted {wanted.get(kind, 'tables, [[light]]')}.")


def check_meaning(role: str, text: str) -> None:
    """Raise SvgfError where a role's numbers cannot mean this."""
    spaces = ("world", "camera", "camera y-down", "camera z-back", "camera or world")
    known = {"depth": ("z", "z-back", "distance"), "normal": spaces, "position": spaces}
    if role == "motion":
        parse_convention(text)
    elif role == "id":
        if not text.lstrip("-").isdigit():
            raise SvgfError(f"id means {text!r}; wanted the number that stands for no object.")
    elif role not in known:
        raise SvgfError(f"no meanings of {role!r} are known; only of {', '.join(_NAMES['meaning'])}.")
    elif text not in known[role]:
        raise SvgfError(f"{role} means {text!r}; wanted {', '.join(known[role])}.")


def detect_renderer(channels: Collection[str], attributes: Iterable[str] = (), files: Collection[str] = ()) -> Table:
    """The renderer that wrote a file with these channels and header attributes, among these sequences of files in a folder.

    It is the table of which most lines are there; `NATIVE` if none says more than the native names do.
    """
    names = {"channels": channels, "attributes": attributes, "files": files}
    there = {kind: tuple(map(str.lower, ones)) for kind, ones in names.items()}
    tables = [load_table(name) for name in renderer_names()]
    found = [
        sum(_is_there(line, there[kind], table) for kind, lines in table.detect.items() for line in lines)
        for table in tables
    ]
    return tables[found.index(max(found))]


def _is_there(line: str, names: Iterable[str], table: Table) -> bool:
    """Whether one of the names, in lower case, is like a line of the table."""
    lines = (line, f"*.{line}") if table.layered else (line,)
    return any(map(re.compile("|".join(map(translate, map(str.lower, lines)))).match, names))


def layers_of(table: Table, channels: Iterable[str]) -> tuple[str, ...]:
    """The names in front of a layered table's channels; "" for channels without one."""
    found: dict[str, None] = {}
    spellings = [*table.channels.get("radiance", ()), *(text for signal in table.light for text in signal.channels)]
    for spelling in spellings:
        for names in spelled(spelling, 3, channels, layered=True):
            found.setdefault(names[0][: len(names[0]) - len(spelling) + 2].rstrip("."))
    return tuple(sorted(found))


def in_layer(
    table: Table, channels: Collection[str], layer: str | None, *, where: str, choose: str = "Say which: --layer NAME."
) -> tuple[str, ...]:
    """The channels of the layer that is wanted, or of the only one. Raises SvgfError: several, none of that name.

    `choose` is what the error says there is to do about several.
    """
    if not table.layered:
        if layer is not None:
            raise SvgfError(f"Got --layer {layer}, but channels of {table.title} have no layers. Leave it out.")
        return tuple(channels)
    there = layers_of(table, channels)
    listed = ", ".join(repr(name) for name in there) or "none"
    if layer is not None and layer not in there:
        raise SvgfError(f"{where}: no layer {layer!r}; there are {listed}. {choose}")
    likely = [name for name in there if name not in table.other_layers] or list(there)
    if layer is None and len(likely) > 1:
        raise SvgfError(f"{where}: {len(likely)} view layers: {listed}. {choose}")
    name = layer if layer is not None else likely[0] if likely else ""
    inner = tuple(f"{other}." for other in there if other != name and (not name or other.startswith(f"{name}.")))
    return tuple(one for one in channels if (one.startswith(f"{name}.") or not name) and not one.startswith(inner))


def spelled(spelling: str, width: int, channels: Iterable[str], *, layered: bool = False) -> Iterator[tuple[str, ...]]:
    """Every set of channels that a spelling of a role with `width` channels stands for."""
    letters = spelling[-width:] if width > 1 else ("",)
    base = spelling[:-width] if width > 1 else spelling
    there = dict.fromkeys(channels)
    for first in there:
        stem = first[: len(first) - len(letters[0])]
        if first.endswith(letters[0]) and (_like(stem, base) or (layered and base and _like(stem, f"*.{base}"))):
            names = tuple(stem + letter for letter in letters)
            if all(name in there for name in names):
                yield names


def pick(
    role: str, spellings: Iterable[str], width: int, channels: Collection[str], *, table: Table, where: str
) -> tuple[str, ...] | None:
    """The channels of the first spelling that is there. Raises SvgfError where it stands for several."""
    for spelling in spellings:
        found = list(spelled(spelling, width, channels, layered=table.layered))
        if len(found) > 1:
            listed = "; ".join(",".join(names) for names in found)
            raise SvgfError(
                f"{where}: several channels may be {role}: {listed}. Say which: --channel {role}={','.join(found[0])}."
            )
        if found:
            return found[0]
    return None


def find_file(role: str, globs: Iterable[str], patterns: Mapping[str, str], *, where: str) -> str | None:
    """The sequence (pattern by its name with one #) that a table's names of files stand for. Raises SvgfError: several."""
    for glob in globs:
        found = [name for name in patterns if _like(name, glob)]
        if len(found) > 1:
            listed = ", ".join(patterns[name] for name in found)
            raise SvgfError(
                f"{where}: several files may be {role}: {listed}. Say which: --file {role}={patterns[found[0]]}."
            )
        if found:
            return patterns[found[0]]
    return None


def _like(name: str, pattern: str) -> bool:
    return fnmatchcase(name.lower(), pattern.lower())
