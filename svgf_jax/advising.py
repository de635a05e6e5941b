"""What is said of a sequence before it is read: what is missing, what that costs, and what to switch on in the renderer."""

from collections.abc import Collection, Iterator

from svgf_jax.cameras import Cameras
from svgf_jax.motion import parse_convention
from svgf_jax.remedies import remedy
from svgf_jax.renderers import Table
from svgf_jax.roles import REST, Roles, short_names


def absences(roles: Roles, cameras: Cameras | None, table: Table) -> dict[str, str]:
    """By role that is not there and should be: what stands in for it, what that costs, and what to switch on."""
    wanted = [role for role in ("albedo", "normal", "depth", "motion") if role in roles.absent]
    return {
        role: f"no {role}: taken as {roles.absent[role]}.{_switch_on(role, table)}"
        for role in wanted
        if not (role == "motion" and cameras)
    }


def advice(roles: Roles, half: Collection[str], cameras: Cameras | None, table: Table) -> Iterator[str]:
    """What the user should know before the work starts, as sentences.

    Args:
        roles: which channel plays which role.
        half: the roles that are stored in half float.
        cameras: if there are any.
        table: the renderer's, which says what to switch on.
    """
    yield from _lacking(roles, table)
    yield from absences(roles, cameras, table).values()
    for albedo, divided in dict.fromkeys((one.albedo, one.divided) for one in roles.bare.values()):
        lights = [short_names(one.channels) for one in roles.bare.values() if one.albedo == albedo]
        if not divided:
            cost = "textures are filtered together with this light and will blur"
        elif REST in roles.signals:
            cost = f"this light goes to {REST}, in which textures are filtered together with the light and will blur"
        else:
            cost = "what this light was divided by is not known, and it is left out"
        setting = f" ({table.settings['albedo']})" if "albedo" in table.settings else ""
        yield f"{' and '.join(lights)} without {albedo}: {cost}. In {table.title}: switch on {albedo}{setting}."
    for role in set(table.uncertain) & roles.layers.keys():
        yield (
            f"what {role} means in files of {table.title} is not certain; taken as {parse_convention(roles.layers[role].meaning)}. "
            f"`svgf-jax inspect` measures it; say it with --{role}."
        )
    means = {role: layer.meaning.split() for role, layer in roles.layers.items()}
    if not cameras and "camera" in means.get("normal", ()) and "or" not in means["normal"]:
        setting = _switch_on("normal", table)
        text = "normals are in camera space, and no camera is known: where it turns, history will be lost. Give a cameras.json."
        yield f"{text}{setting}"
    if not cameras and means.get("depth") == ["distance"]:
        text = (
            "depth is the distance along the ray, and no camera is known to make z of it: slopes will be a little off."
        )
        yield f"{text} Give a cameras.json."
    for role in ("depth", "position"):
        if role in half:
            yield f"{role} is in half float, in steps of 0.1 %: slopes become stairs. {remedy('half', table.name)}"
    if cameras and not roles.layers.keys() & {"depth", "position"}:
        yield f"{cameras.path} is of no use without depth or position."


def _lacking(roles: Roles, table: Table) -> Iterator[str]:
    """What a table of one's own names, and the files do not have."""
    if not table.file:
        return
    for role in dict.fromkeys(name.removeprefix("camera_") for name in table.channels):
        layer = roles.layers.get(role)
        if layer and (layer.own_file or layer.reason in ("given by hand", f"{table.name} name")):
            continue
        named = [text for key in (role, f"camera_{role}") for text in table.channels.get(key, ())]
        if named:
            instead = f"taken is {short_names(layer.channels)}, the {layer.reason}" if layer else f"there is no {role}"
            yield f"{table.file}: {role} is {' or '.join(named)} there, but the files have no such channels; {instead}."
    for signal in table.light:
        if signal.name not in roles.layers and signal.name not in roles.bare:
            yield f"{table.file}: light {signal.name} is {' or '.join(signal.channels)} there, but the files have no such channels."


def _switch_on(role: str, table: Table) -> str:
    return f" In {table.title}: {table.settings[role]}." if role in table.settings else ""
