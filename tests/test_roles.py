"""Channel names to roles: found, given by hand, absent, wrong."""

import numpy as np
import pytest

from svgf_jax import SvgfError
from svgf_jax.assembly import Place, assemble
from svgf_jax.roles import WIDTH, Layer, Light, Roles, check_channels, resolve_roles, short_names


def rgb(*names):
    return [f"{name}.{c}" for name in names for c in "RGB"]


NATIVE = [*rgb("direct", "indirect", "emission", "albedo"), "depth.Z", "motion.X", "motion.Y", "id.I"]
NATIVE += [f"{name}.{c}" for name in ("normal", "position") for c in "XYZ"]


def test_only_letters_of_one_layer_are_told_together():
    for names, told in (
        ("N.X N.Y N.Z", "N.XYZ"),
        ("R G B", "R G B"),
        ("a.R b.R", "a.R b.R"),
        ("`.R `.R `.R", "`.R `.R `.R"),
        ("svgf.valid svgf.change", "svgf.valid svgf.change"),
    ):
        assert short_names(tuple(names.split())) == told


MEASURED = {"direct_variance", "indirect_variance", "radiance_variance"}


def test_measured_variances_are_taken_where_every_signal_has_one():
    both = [*NATIVE, "direct.variance", "indirect.variance", "radiance.variance"]
    layers = resolve_roles(both).layers
    assert layers["direct_variance"].channels == ("direct.variance",)
    assert MEASURED & layers.keys() == {"direct_variance", "indirect_variance"}
    assert not MEASURED & resolve_roles([*NATIVE, "direct.variance"]).layers.keys()
    beauty = resolve_roles(["R", "G", "B", "V"], channel={"radiance_variance": ["V"]})
    assert beauty.layers["radiance_variance"].channels == ("V",)


def test_the_native_schema():
    roles = resolve_roles(NATIVE)
    assert roles.signals == ("direct", "indirect")
    assert (
        set(roles.layers) == set(WIDTH) - {"radiance", "alpha", "environment", "hit_distance", "roughness"} - MEASURED
    )
    assert roles.layers["normal"].channels == ("normal.X", "normal.Y", "normal.Z")
    assert roles.absent == {}
    assert all(layer.reason == "native name" and not layer.own_file for layer in roles.layers.values())


def test_a_plain_beauty_is_one_signal_and_every_absence_says_what_it_costs():
    roles = resolve_roles(["R", "G", "B", "A", "Z"])
    assert roles.signals == ("radiance",)
    assert roles.layers["depth"].channels == ("Z",)
    assert roles.layers["alpha"].channels == ("A",)
    assert set(roles.absent) == {"emission", "albedo", "normal", "motion", "id"}
    text = roles.describe()
    assert "radiance  R G B (native name)" in text
    assert "albedo    not there, taken as 1: textures" in text


def test_long_names_and_what_else_says_a_role_are_told_in_line():
    layers = {"radiance": Layer(("R",), False, "x"), "glossy_indirect": Layer(("G",), False, "x")}
    roles = Roles(layers, {"motion": "0: trails"}, ("radiance",), {}).told_by("motion", "cameras.json says")
    assert roles.absent == {}
    text = roles.describe()
    assert text == "radiance         R (x)\nglossy_indirect  G (x)\nmotion           not there: cameras.json says"


def test_direct_alone_is_one_signal():
    assert resolve_roles(rgb("direct")).signals == ("direct",)


def test_separate_light_is_preferred_to_the_beauty_unless_it_is_asked_for():
    names = [*NATIVE, "R", "G", "B", "A"]
    assert resolve_roles(names).signals == ("direct", "indirect")
    assert "alpha" not in resolve_roles(names).layers
    assert resolve_roles(names, channel={"radiance": "RGB"}).signals == ("radiance",)
    assert resolve_roles(names, channel={"color": "RGB"}).signals == ("radiance",)


def test_channels_by_hand():
    names = [*rgb("Combined", "DiffCol"), "Dist.V"]
    roles = resolve_roles(
        names,
        channel={"radiance": rgb("Combined"), "albedo": rgb("DiffCol"), "depth": ["Dist.V"], "emission": ["Dist.V"]},
    )
    assert roles.layers["albedo"].channels == ("DiffCol.R", "DiffCol.G", "DiffCol.B")
    assert roles.layers["emission"].channels == ("Dist.V",) * 3
    assert roles.layers["depth"].reason == "given by hand"


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (["R", "G", "B", "A"], ("R", "G", "B")),
        (["X", "Y", "Z"], ("X", "Y", "Z")),
        (["normal.X", "normal.Y", "normal.Z", "R", "G", "B"], ("normal.X", "normal.Y", "normal.Z")),
    ],
)
def test_a_file_of_its_own(names, found):
    layer = resolve_roles(["R", "G", "B"], files={"normal": ("n.exr", names)}).layers["normal"]
    assert (layer.channels, layer.own_file) == (found, True)


def test_a_file_of_its_own_with_one_channel_of_any_name():
    files = {"depth": ("d.exr", ["whatever"]), "object_id": ("i.exr", ["Y"]), "motion": ("m.exr", ["R", "G", "B"])}
    layers = resolve_roles(["R", "G", "B"], files=files).layers
    assert layers["depth"].channels == ("whatever",)
    assert layers["id"].channels == ("Y",)
    assert layers["motion"].channels == ("R", "G")


def test_file_and_channels_together():
    files = {"albedo": ("a.exr", rgb("foo", "bar"))}
    layer = resolve_roles(["R", "G", "B"], files=files, channel={"albedo": rgb("bar")}).layers["albedo"]
    assert (layer.channels, layer.own_file) == (("bar.R", "bar.G", "bar.B"), True)


def test_no_radiance_lists_the_closest_names():
    with pytest.raises(SvgfError, match=r"shot\.exr: no radiance; .*Closest: .*Direct\.R.*--channel radiance="):
        resolve_roles([*rgb("Direct", "Combined"), "Z"], where="shot.exr")
    with pytest.raises(SvgfError, match=r"no radiance; .*There are P, Q\."):
        resolve_roles(["Q", "P"])


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"channel": {"albdo": ["R"]}}, "no role is called 'albdo'; roles are direct, indirect"),
        ({"channel": {"albedo": ["R", "G"]}}, r"albedo has 2 channels by hand \(R, G\); wanted 3"),
        ({"channel": {"normal": ["R"]}}, "normal has 1 channels"),
        ({"channel": {"albedo": rgb("albedos")}}, r"the file: no channel 'albedos\.R' for albedo\. Closest: albedo\.R"),
        (
            {"files": {"normal": ("n.exr", ["U", "V"])}},
            r"n\.exr: channels for normal not found; .*there are U, V\. Say",
        ),
        ({"files": {"normal": ("n.exr", ["U"])}, "channel": {"normal": "XYZ"}}, r"n\.exr: no channel 'X' for normal"),
    ],
)
def test_wrong_choices_by_hand(kwargs, message):
    with pytest.raises(SvgfError, match=message):
        resolve_roles(NATIVE, **kwargs)


def test_beauty_and_parts_of_it_by_hand():
    with pytest.raises(SvgfError, match="either it, or direct and indirect"):
        resolve_roles(["R", "G", "B"], channel={"radiance": "RGB", "direct": "RGB"})


def test_some_channels_of_a_role_are_an_error():
    names = [name for name in NATIVE if name != "albedo.G"]
    with pytest.raises(SvgfError, match=r"albedo\.R, albedo\.B but no albedo\.G; wanted all of albedo"):
        resolve_roles(names)


def test_a_later_frame_without_a_channel():
    layer = resolve_roles(NATIVE).layers["albedo"]
    check_channels(layer, NATIVE, where="f.exr", role="albedo")
    with pytest.raises(
        SvgfError, match=r"f7\.exr: no channel 'albedo\.R', which is albedo in the frames before\. Closest"
    ):
        check_channels(layer, rgb("direct", "albed"), where="f7.exr", role="albedo")


@pytest.mark.parametrize("signals", [("direct", "indirect"), ("direct", "indirect", "rest")])
@pytest.mark.parametrize("share", [0.005, 1.0])
def test_a_denoised_beauty_is_left_out(signals, share):
    rng = np.random.default_rng(0)
    parts = {role: rng.gamma(1.0, 1.0, (20, 20, 3)).astype(np.float32) for role in ("direct", "indirect")}
    total = parts["direct"] + parts["indirect"]
    denoised = np.where(rng.random((20, 20, 1)) < share, total.mean((0, 1)), total).astype(np.float32)
    layers = {role: Layer((role,), False, "") for role in (*parts, "radiance")}
    roles = Roles(layers, {}, signals, {role: Light("", False) for role in signals})
    planes = parts | {"radiance": denoised}
    place = Place(1, None, (0, 0), (20, 20), None)
    frame, counts, notes = assemble(roles, planes, place, motion_before=lambda: None)
    if share == 1:
        assert counts["changed"] > 300
        assert "radiance is not the sum of its parts" in notes[0]
        assert (frame.radiance.sum(0) == total).all()
        assert not frame.emission.any()
    else:
        assert "changed" not in counts
        assert notes == ()
