"""The files that renderers write: real ones (tests/data), and tiny ones written to each renderer's documented conventions."""

from pathlib import Path

import numpy as np
import pytest

from svgf_jax import SvgfError, exr
from svgf_jax.cameras import eye_ray_lengths, find_camera
from svgf_jax.frames import open_source, read_frame
from svgf_jax.motion import Convention
from svgf_jax.references import read_radiance
from svgf_jax.warping import Step, find_convention, warp_residual

DATA = Path(__file__).parent / "data"
H, W = 6, 8
KINDS = ["diffuse_direct", "diffuse_indirect", "glossy_direct", "glossy_indirect"]
KINDS += ["transmission_direct", "transmission_indirect"]


def planes(name, value, letters="RGB", dtype=np.float32):
    """Channels `name.R` and so on of one value (or an array `[H, W]` or `[H, W, C]`)."""
    values = np.broadcast_to(np.asarray(value, dtype), (H, W, len(letters)))
    stem = f"{name}." if name else ""
    return {f"{stem}{letter}": values[..., i].copy() for i, letter in enumerate(letters)}


def put(folder, channels, name, *, attributes=None, window=None):
    """Write one file; `window` is (data window, display window)."""
    image = exr.new_image(channels, attributes=attributes)
    if window:
        image = image._replace(data_window=window[0], display_window=window[1])
    folder.mkdir(parents=True, exist_ok=True)
    exr.write(folder / name, image)
    return folder


def cycles_oracle(path, layer="ViewLayer"):
    """Combined of a file with Blender's names of 5.x, by the identity that Blender's manual gives, pixel for pixel."""
    channels = exr.read(path).channels
    total = {}
    for c in "RGB":
        plane = {name: channels[f"{layer}.{name}.{c}"].astype(np.float64) for name in ("Emission", "Environment")}
        total[c] = plane["Emission"] + plane["Environment"]
        for kind in ("Diffuse", "Glossy", "Transmission"):
            direct, indirect, color = (
                channels[f"{layer}.{kind} {part}.{c}"] for part in ("Direct", "Indirect", "Color")
            )
            total[c] += (direct.astype(np.float64) + indirect) * color
    return np.stack(list(total.values()), -1)


@pytest.mark.parametrize(("name", "beauty"), [("multipart", "Combined"), ("half", "Noisy Image")])
def test_blender_files_are_recognised_and_put_together(name, beauty):
    source = open_source(DATA / "cycles" / name)
    assert (source.table.name, source.warnings) == ("cycles", ())
    assert source.roles.signals == tuple(KINDS)  # complete: no rest
    assert source.roles.layers["radiance"].channels[0] == f"ViewLayer.{beauty}.R"
    item = read_frame(source, 1)
    assert (item.counts, item.notes) == ({}, ())
    frame = item.frame
    assert frame.radiance.shape == frame.albedo.shape == (6, 27, 48, 3)
    total = frame.radiance.sum(0) + frame.emission
    np.testing.assert_allclose(total, cycles_oracle(item.path), rtol=1e-6, atol=1e-6)
    file = item.image.channels
    combined = np.stack([file[f"ViewLayer.{beauty}.{c}"] for c in "RGB"], -1).astype(np.float32)
    np.testing.assert_allclose(total, combined, rtol=4e-3 if name == "half" else 1e-5, atol=2e-4)
    np.testing.assert_array_equal(frame.albedo[1, ..., 0], file["ViewLayer.Diffuse Color.R"].astype(np.float32))
    divided = frame.radiance[2] / np.maximum(frame.albedo[2], 1e-3)  # what the filter will see
    light = np.stack([file[f"ViewLayer.Glossy Direct.{c}"] for c in "RGB"], -1).astype(np.float32)
    bright = frame.albedo[2] > 1e-3
    np.testing.assert_allclose(divided[bright], light[bright], rtol=1e-5)
    sky = file["ViewLayer.Depth.Z"] > 1e9
    np.testing.assert_array_equal(frame.object_id == -1, sky)
    assert 0.01 < sky.mean() < 0.2
    np.testing.assert_allclose(np.linalg.norm(frame.normal[~sky], axis=-1), 1, atol=1e-5)
    np.testing.assert_allclose(read_radiance(item.path), combined, rtol=1e-6)


@pytest.mark.parametrize("at", [1, 2])
def test_blender_motion_leads_to_the_frame_before(at):
    source = open_source(DATA / "cycles" / "multipart", position=True)
    before, now = (read_frame(source, i).frame for i in (at - 1, at))
    found = warp_residual(before, now, now.motion)
    assert found.guides == ("position",)
    assert found.pixels < 0.02
    assert found.share > 0.95
    upside_down = warp_residual(before, now, now.motion * np.array([1, -1], np.float32))
    assert upside_down.pixels > 0.2


def test_the_convention_of_blender_is_found_from_its_file():
    source = open_source(DATA / "cycles" / "multipart", position=True, motion="")  # as the numbers are
    frames = [read_frame(source, i).frame for i in range(3)]
    steps = [Step(frames[i - 1], frames[i], frames[i].motion, frames[i - 1].motion) for i in (1, 2)]
    assert find_convention(steps).fits == (Convention(y="y-up"),)


def test_view_layers_are_listed_and_chosen():
    path = DATA / "cycles" / "layers"
    with pytest.raises(
        SvgfError, match=r"shot_0001\.exr: 2 view layers: 'Other', 'ViewLayer'\. Say which: --layer NAME"
    ):
        open_source(path)
    with pytest.raises(SvgfError, match="no layer 'Third'; there are 'Other', 'ViewLayer'"):
        open_source(path, layer="Third")
    with pytest.raises(SvgfError, match="2 view layers: .* Wanted a picture with one of them"):
        read_radiance(path / "shot_0001.exr")
    source = open_source(path, layer="Other")
    assert source.roles.layers["depth"].channels == ("Other.Depth.Z",)
    assert source.roles.signals == tuple(KINDS)
    with pytest.raises(SvgfError, match="--layer x, but channels of the names of svgf_jax itself have no layers"):
        open_source(path, layer="x", renderer="native")


def test_layers_whose_names_begin_alike_and_the_compositor(tmp_path):
    channels = (
        planes("A.Combined", 1, "RGBA") | planes("A.B.Combined", 2, "RGBA") | planes("Composite.Combined", 3, "RGBA")
    )
    folder = put(tmp_path, channels, "a_1.exr")
    with pytest.raises(SvgfError, match="2 view layers: 'A', 'A.B', 'Composite'"):
        open_source(folder)
    for layer, value in (("A", 1), ("A.B", 2), ("Composite", 3)):
        assert (read_frame(open_source(folder, layer=layer), 0).frame.radiance == value).all()
    put(folder, planes("A.Combined", 1, "RGBA") | planes("Composite.Combined", 3, "RGBA"), "a_1.exr")
    assert (read_frame(open_source(folder), 0).frame.radiance == 1).all()
    put(folder, planes("Combined", 4, "RGBA") | planes("Vector", 0, "XYZW"), "a_1.exr")  # a single layer without a name
    assert (read_frame(open_source(folder), 0).frame.radiance == 4).all()


def old_cycles(**without):
    """One frame with the names of Blender 4.x and simple numbers; beauty 4."""
    channels = planes("RL.Noisy Image", 4, "RGBA") | planes("RL.Combined", 9, "RGBA") | planes("RL.Depth", 5, "Z")
    channels |= planes("RL.DiffDir", 2) | planes("RL.DiffInd", 1) | planes("RL.DiffCol", 0.5)
    channels |= planes("RL.GlossDir", 3) | planes("RL.GlossInd", 0) | planes("RL.GlossCol", 0.25)
    channels |= planes("RL.VolumeDir", 0.25) | planes("RL.Emit", 0.25) | planes("RL.Env", 0)
    channels |= planes("RL.Denoising Normal", [0, 0.6, -0.8], "XYZ") | planes("RL.Vector", [1, 2, 3, 4], "XYZW")
    channels |= planes("RL.IndexOB", 3, "X")
    return {name: pixels for name, pixels in channels.items() if name.split(".")[1] not in without}


def test_the_names_of_blender_4_and_what_no_pass_has(tmp_path):
    source = open_source(put(tmp_path, old_cycles(), "a_1.exr"))
    assert source.roles.signals == (*KINDS[:4], "volume_direct", "rest")  # transmission is not there
    assert source.roles.layers["radiance"].channels[0] == "RL.Noisy Image.R"
    frame = read_frame(source, 0).frame
    np.testing.assert_allclose(frame.radiance[:, 2, 3, 1], [1, 0.5, 0.75, 0, 0.25, 4 - 2.75], atol=1e-6)
    np.testing.assert_allclose(frame.albedo[:, 2, 3, 1], [0.5, 0.5, 0.25, 0.25, 1, 1])
    np.testing.assert_allclose(frame.radiance.sum(0) + frame.emission, 4)
    assert frame.motion[0, 0].tolist() == [1, -2]
    assert (frame.object_id == 3).all()
    (told,) = source.warnings
    assert "normals are in camera space, and no camera is known" in told
    assert "In Blender Cycles: View Layer > Passes > Data > Normal" in told
    np.testing.assert_allclose(frame.normal[0, 0], [0, -0.6, -0.8], atol=1e-6)  # y down; not in the world


def test_light_without_its_colour_is_left_to_the_rest(tmp_path):
    names = old_cycles(DiffCol=True)
    source = open_source(put(tmp_path, names, "a_1.exr"))
    assert source.roles.signals == ("glossy_direct", "glossy_indirect", "volume_direct", "rest")
    frame = read_frame(source, 0).frame
    np.testing.assert_allclose(frame.radiance[-1], 4 - 0.75 - 0.25 - 0.25)
    (told,) = [text for text in source.warnings if "Diff" in text]
    assert told.startswith(
        "RL.DiffDir.RGB and RL.DiffInd.RGB without DiffCol: this light goes to rest, in which textures"
    )
    assert "In Blender Cycles: switch on DiffCol (View Layer > Passes > Light" in told
    assert source.roles.told()["rest"] == (
        "RL.Noisy Image.RGB less the light above: diffuse_direct (no DiffCol), diffuse_indirect (no DiffCol), "
        "transmission_direct, transmission_indirect"
    )


def test_light_without_its_colour_and_without_a_beauty_is_left_out_and_told(tmp_path):
    channels = {
        name: plane
        for name, plane in old_cycles(GlossCol=True).items()
        if "Combined" not in name and "Noisy" not in name
    }
    source = open_source(put(tmp_path, channels, "a_1.exr"))
    assert source.roles.signals == (*KINDS[:2], "volume_direct")
    assert any(" without GlossCol: " in text and "it is left out" in text for text in source.warnings)
    assert "rest" not in source.roles.told()


def test_a_blender_file_with_its_beauty_alone(tmp_path):
    channels = planes("View.Layer.Combined", 2, "RGBA") | planes("View.Layer.Denoising Albedo", 0.5)
    source = open_source(put(tmp_path, channels, "a_1.exr"))
    assert source.roles.signals == ("radiance",)
    assert source.roles.layers["albedo"].channels[0] == "View.Layer.Denoising Albedo.R"
    assert [told.split(":")[0] for told in source.warnings] == ["no normal", "no depth", "no motion"]
    assert "In Blender Cycles: View Layer > Passes > Data > Vector, with Render > Motion Blur off" in source.warnings[2]


def test_what_is_given_by_hand_comes_before_the_table(tmp_path):
    folder = put(tmp_path, old_cycles() | planes("RL.Mine", 7), "a_1.exr")
    by_hand = [f"RL.Mine.{c}" for c in "RGB"]
    assert open_source(folder, channel={"radiance": by_hand}).roles.signals == ("radiance",)
    frame = read_frame(open_source(folder, motion="fraction from-previous"), 0).frame
    np.testing.assert_allclose(frame.motion[0, 0], [-1 * W, -2 * H])


def test_an_albedo_by_hand_is_not_passed_over():
    with pytest.raises(SvgfError, match="each light has its own: diffuse_direct"):
        open_source(DATA / "cycles" / "half", channel={"albedo": ["ViewLayer.Diffuse Color.R"]})


def test_mitsuba_files():
    """Real ones: the AOVs are called albedo, nn, dd.y, pos, shape and emission; the ids hold for one loaded scene."""
    source = open_source(DATA / "mitsuba", position=True, channel={"id": ["shape.I"]})
    assert (source.table.name, source.warnings) == ("mitsuba", ())
    got = {role: layer.channels[0] for role, layer in source.roles.layers.items()}
    assert got == {
        "radiance": "R",
        "emission": "emission.R",
        "albedo": "albedo.R",
        "normal": "nn.X",
        "depth": "dd.y.T",
        "id": "shape.I",
        "position": "pos.X",
    }
    before, now = (read_frame(source, i) for i in (0, 1))
    frame, file = now.frame, now.image.channels
    assert (now.counts, now.notes) == ({}, ())  # positions are jittered within their pixels, and well
    surface = frame.object_id != -1
    np.testing.assert_array_equal(surface, file["shape.I"] != 0)
    bulb = file["emission.R"] > 0
    assert bulb.any()
    np.testing.assert_allclose(
        frame.radiance[0][bulb], np.stack([file[c] for c in "RGB"], -1)[bulb] - frame.emission[bulb]
    )
    camera = find_camera(source.cameras, 1)
    along = eye_ray_lengths(camera, surface.shape)
    z = (file["dd.y.T"] + 0.01 * along) / along  # Mitsuba's rays start on the near clipping plane, at z = 0.01
    np.testing.assert_allclose(frame.depth[surface], z[surface], rtol=0.02)  # the ray went somewhere in the pixel
    assert np.abs(frame.depth / np.where(surface, file["dd.y.T"], 1) - 1)[surface].max() > 0.05  # it was no z
    good, wrong = (warp_residual(before.frame, frame, sign * frame.motion).pixels for sign in (1, -1))
    assert good < 0.75  # of the jitter of both frames: half a pixel
    assert wrong > 2 * good


def test_without_cameras_distances_stay_and_are_told(tmp_path):
    source = open_source(DATA / "mitsuba", cameras=None)
    assert [told.split(",")[0] for told in source.warnings] == [
        "no motion: taken as 0: what moves",
        "depth is the distance along the ray",
    ]
    assert "a cameras.json beside the frames" in source.warnings[0]
    assert "id" not in source.roles.layers  # shape_index is numbered anew whenever a scene is loaded
    frame = read_frame(source, 0)
    np.testing.assert_array_equal(frame.frame.depth, frame.image.channels["dd.y.T"])
