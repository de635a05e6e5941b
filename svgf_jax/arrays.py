"""From arrays in memory to a frame, as from a file's channels: names, defaults and checks are those of `svgf_jax.frames`."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from svgf_jax import renderers
from svgf_jax.assembly import Place, assemble, check_roles, meaning_of
from svgf_jax.cameras import Cameras, parse_camera
from svgf_jax.motion import parse_convention
from svgf_jax.roles import ALIASES, WIDTH, Roles, canonical_role, resolve_roles
from svgf_jax.types import Frame, SvgfError

_HERE = "the images"  # what messages call them, as they would a file


def frame_of(
    images: Any,
    *,
    names: Sequence[str] | None = None,
    renderer: str = "auto",
    layer: str | None = None,
    channel: Mapping[str, Iterable[str]] | None = None,
    motion: str | None = None,
    previous_motion: Any = None,
    camera: Mapping[str, Any] | None = None,
    previous_camera: Mapping[str, Any] | None = None,
    position: bool = False,
) -> Frame:
    """A frame from images in memory: whatever `numpy.asarray` takes, a Mitsuba or JAX array for one.

    Not to be traced: inside jit, grad or vmap take a frame from outside and put in what is traced, `frame._replace(radiance=...)`.

    Args:
        images: one of these:

            - images by role (`svgf_jax.roles`), `[H, W, C]`, or `[H, W]` where C is 1: `radiance`, or `direct` and `indirect`;
              `albedo`, `emission`, `normal`, `depth`, `motion`, `id`, `position`, `direct_variance`, ... What is not there, or is
              None, gets the default of that role. A radiance `[H, W, 4]` has an alpha;
            - channels `[H, W]` by the names that the renderer would give them in a file: `direct.R`, `ViewLayer.Combined.R`, ...
              (both kinds may stand in one dict);
            - an array `[H, W, C]` with `names` for its channels.
        names: of the channels of an array; `integrator.aov_names()` for what `mitsuba.render` returns, or the film's bitmap.
        renderer: whose names and conventions: a name of `svgf_jax.renderers`, a table of one's own (`mine.toml`), or "auto": by the
            names of the channels. Images by role alone are then in this library's conventions.
        layer: the view layer, where channels have several.
        channel: role -> channel names, where the renderer's table does not tell.
        motion: what the motion vectors mean (words of `svgf_jax.motion`), in place of what the renderer's table says.
        previous_motion: the motion vectors of the frame before, as they were given; for `to-next` and `from-next` alone.
        camera: of this frame, an entry of `per_frame` in a cameras.json (`svgf_jax.cameras`): matrices as lists or arrays.
        previous_camera: of the frame before; with `camera` it gives exact previous depths, and the motion where there is none.
        position: also give the frame its world positions, which the joint bilateral filter reads.

    Returns:
        A frame of NumPy arrays, float32. Radiance is left as it is: what is not finite in it the filter repairs and counts. What is
        odd is warned of (UserWarning).

    Raises SvgfError: no light, unknown names, images that do not fit together or are not numbers, names that are not clear.
    """
    channels, by_role = _channels(images, names)
    by_hand = {canonical_role(role): tuple(own) for role, own in (channel or {}).items()}
    if twice := by_role.keys() & by_hand.keys():
        raise SvgfError(f"{', '.join(sorted(twice))}: given as an image and by channel; wanted one of them.")
    own = [name for role in by_role.values() for name in role]
    named = [name for name in channels if name not in own]
    table = renderers.detect_renderer(named) if renderer == "auto" else renderers.load_table(renderer)
    if named or layer is not None:
        named = list(renderers.in_layer(table, named, layer, where=_HERE, choose="Say which: layer=NAME."))
    roles = resolve_roles(
        (*named, *own),
        channel=by_role | by_hand,
        table=table,
        meaning={} if motion is None else {"motion": str(parse_convention(motion))},
        where=_HERE,
    )
    cameras = _cameras(camera, previous_camera)
    check_roles(roles, cameras, position=position, where=_HERE)
    later = _motion_before(roles, previous_motion, camera, previous_camera)
    planes = {role: _stack(channels, one.channels, role) for role, one in roles.layers.items()}
    height, width = next(iter(planes.values())).shape[:2]
    before = None if later is None and previous_camera is None else 0
    frame, _, notes = assemble(
        roles,
        planes,
        Place(1, before, (0, 0), (width, height), cameras),
        half={role for role, one in roles.layers.items() if channels[one.channels[0]].dtype == np.float16},
        position=position,
        motion_before=lambda: later,
    )
    for note in notes:
        warnings.warn(note, stacklevel=2)
    return frame


def _channels(images: Any, names: Sequence[str] | None) -> tuple[dict[str, np.ndarray], dict[str, tuple[str, ...]]]:
    """`[H, W]` by name, and the names of the roles that were given as images."""
    if not isinstance(images, Mapping):
        array = _as_array(images, _HERE)
        if names is None or array.ndim != 3:
            raise SvgfError(
                f"{_HERE}: got an array {array.shape} {'without' if names is None else 'with'} names; wanted a dict of images by "
                "role, or an array [H, W, C] with the names of its C channels: frame_of(tensor, names=integrator.aov_names())."
            )
        images = _by_name(array, tuple(names))
    elif names is not None:
        raise SvgfError("names are of an array's channels; the images of a dict have theirs. Leave names out.")
    given: Mapping[str, Any] = images
    channels: dict[str, np.ndarray] = {}
    by_role: dict[str, tuple[str, ...]] = {}
    for name, value in given.items():
        if value is None:
            continue
        array, role = _as_array(value, name), ALIASES.get(name, name)
        if role not in WIDTH and not (array.ndim == 2 or array.shape[2:] == (1,)):
            raise SvgfError(
                f"{name!r} is {array.shape}, and no role; wanted a channel [H, W], or an image of one of {', '.join(WIDTH)}."
            )
        if array.ndim not in (2, 3) or 0 in array.shape:
            raise SvgfError(
                f"{name} has shape {array.shape}; wanted [H, W, {WIDTH.get(role, 1)}] of one frame. For several signals of "
                "one's own call svgf_jax.Frame."
            )
        planes = np.moveaxis(array.reshape(*array.shape[:2], -1), -1, 0)
        if role not in WIDTH:
            channels[name] = planes[0]
            continue
        if role in by_role:
            raise SvgfError(f"{role} is there twice, once as {name}; wanted it once.")
        if role == "radiance" and len(planes) == 4 and given.get("alpha") is None:
            by_role["alpha"] = ("alpha[0]",)
            channels["alpha[0]"], planes = planes[3], planes[:3]
        by_role[role] = tuple(f"{role}[{at}]" for at in range(len(planes)))
        channels |= zip(by_role[role], planes, strict=True)
    if len({plane.shape for plane in channels.values()}) > 1:
        sizes = ", ".join(f"{name} {plane.shape}" for name, plane in channels.items())
        raise SvgfError(f"{_HERE} differ in height and width: {sizes}; wanted one size.")
    return channels, by_role


def _by_name(array: np.ndarray, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The channels of a Mitsuba tensor.

    `aov_names` has the channels of inner integrators, R, G, B and A of each, then those of AOVs. With a film of RGB none has an A,
    and a film's bitmap begins with the channels of its pixels, which are those of the first integrator.
    """
    inner = [name[:-2] for name in names if name.endswith(".A") and f"{name[:-2]}.R" in names]
    opaque = tuple(name for name in names if name[:-2] not in inner or not name.endswith(".A"))
    layouts = (names, opaque, ("R", "G", "B", *names), ("R", "G", "B", "A", *names))
    found = next((one for one in layouts if len(one) == array.shape[2]), None)
    if found is None or len(set(found)) != len(found):
        raise SvgfError(
            f"{_HERE}: got {array.shape[2]} channels and {len(names)} names ({', '.join(names)}); wanted one each, no two alike."
        )
    channels = {name: array[..., at] for at, name in enumerate(found)}
    if inner and "R" not in channels:  # the first integrator renders the beauty
        channels |= {letter: channels[name] for letter in "RGBA" if (name := f"{inner[0]}.{letter}") in channels}
    return channels


def _as_array(value: Any, name: str) -> np.ndarray:
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError) as error:  # the first is what JAX raises where it traces
        raise SvgfError(
            f"{name}: {type(value).__name__} cannot be read as an array here. Inside jit, grad or vmap take a frame from outside "
            "and put in what is traced: frame._replace(radiance=...)."
        ) from error
    if array.dtype.kind not in "fiub":
        raise SvgfError(f"{name} is {array.dtype}; wanted real numbers.")
    return array


def _stack(channels: Mapping[str, np.ndarray], names: tuple[str, ...], role: str) -> np.ndarray:
    """`[H, W, C]` float32, or float64 for ids, which float32 does not hold."""
    planes = np.stack([channels[name] for name in names], -1)
    if role != "id" and planes.dtype.kind in "iu":
        raise SvgfError(
            f"{role} is {planes.dtype}; wanted floating-point numbers, as the renderer computes them. (A picture of 8 bits is not "
            "scene-linear: svgf_jax.decode_srgb.)"
        )
    with np.errstate(over="ignore"):  # becomes infinite: the filter repairs and counts it
        return planes.astype(np.float64 if role == "id" else np.float32)


def _cameras(camera: Mapping[str, Any] | None, previous: Mapping[str, Any] | None) -> Cameras | None:
    if camera is None:
        if previous is not None:
            raise SvgfError("Got a previous_camera without a camera; wanted both, or camera alone.")
        return None
    found = {1: parse_camera(camera, "camera")}
    if previous is not None:
        found[0] = parse_camera(previous, "previous_camera")
    return Cameras("the camera", found, None)


def _motion_before(roles: Roles, given: Any, camera: Any, previous_camera: Any) -> np.ndarray | None:
    """The motion vectors of the frame before, where the convention wants them."""
    convention = parse_convention(" ".join(meaning_of(roles, "motion")))
    wanted = "motion" in roles.layers and convention.unit != "world" and convention.from_frame_before
    if wanted != (given is not None):
        raise SvgfError(
            f"motion {convention} is {'of' if wanted else 'not of'} the frame before, and previous_motion is "
            f"{'not there' if given is None else 'there'}; wanted it for to-next and from-next alone (zeros for the first frame)."
        )
    if wanted and camera is not None and previous_camera is None:
        raise SvgfError("Got previous_motion and camera; wanted previous_camera too.")
    return None if given is None else _as_array(given, "previous_motion")
