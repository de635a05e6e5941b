"""From files to frames: roles applied, surfaces decided, the past derived, everything odd reported."""

import json
import subprocess
import sys

import numpy as np
import pytest

from svgf_jax import SvgfError, exr
from svgf_jax.frames import load_sequence, open_source, read_frame
from svgf_jax.references import load_reference, read_radiance

H, W = 6, 8


def layer(name, value, letters="RGB", dtype=np.float16):
    values = np.broadcast_to(np.asarray(value, dtype), (H, W, len(letters)))
    return {f"{name}.{c}": values[..., i].copy() for i, c in enumerate(letters)}


def native():
    """One frame of the native schema: a wall at depth 4."""
    channels = layer("direct", 1) | layer("indirect", 0.25) | layer("emission", 0) | layer("albedo", [0.5, 0.25, 1])
    channels |= layer("normal", [0, 0, 1], "XYZ") | layer("depth", 4, "Z", np.float32)
    return channels | layer("motion", [0.5, -1], "XY", np.float32) | layer("id", 3, "I", np.float32)


def beauty(value=1.0):
    return {c: np.full((H, W), value, np.float16) for c in "RGB"}


@pytest.fixture
def put(tmp_path):
    """Write frames (dictionaries of channels) as frame_0000.exr and so on; the folder."""

    def put(*frames, name="frame"):
        for number, channels in enumerate(frames):
            if channels is not None:
                exr.write(tmp_path / f"{name}_{number:04d}.exr", exr.new_image(channels))
        return tmp_path

    return put


def first(folder, index=0, **options):
    return read_frame(open_source(folder, **options), index)


def test_a_native_frame(put):
    source = open_source(put(native()))
    assert source.warnings == ()
    item = read_frame(source, 0)
    assert (item.number, item.counts, item.notes) == (0, {}, ())
    assert item.path.endswith("frame_0000.exr")
    assert set(item.image.channels) == set(native())
    frame = item.frame
    assert frame.variance is None
    shapes = {name: array.shape for name, array in frame._asdict().items() if array is not None}
    assert shapes == {
        "radiance": (2, H, W, 3),
        "albedo": (1, H, W, 3),
        "emission": (H, W, 3),
        "normal": (H, W, 3),
        "depth": (H, W),
        "prev_depth": (H, W),
        "motion": (H, W, 2),
        "object_id": (H, W),
    }
    types = {name: array.dtype.name for name, array in frame._asdict().items() if array is not None}
    assert types == dict.fromkeys(shapes, "float32") | {"object_id": "int32"}
    np.testing.assert_array_equal(frame.radiance[:, 0, 0, 0], [1, 0.25])
    np.testing.assert_array_equal(frame.albedo[0, 0, 0], [0.5, 0.25, 1])
    np.testing.assert_array_equal(frame.motion[0, 0], [0.5, -1])
    np.testing.assert_array_equal(frame.prev_depth, frame.depth)
    assert (frame.object_id == 3).all()


def test_a_plain_beauty_gets_honest_defaults_and_warnings(put):
    source = open_source(put(beauty(2)))
    assert [text.split(":")[0] for text in source.warnings] == ["no albedo", "no normal", "no depth", "no motion"]
    frame = read_frame(source, 0).frame
    assert frame.radiance.shape == (1, H, W, 3)
    assert (frame.radiance == 2).all()
    assert (frame.albedo == 1).all()
    assert (frame.depth == 1).all()
    assert not frame.emission.any()
    assert not frame.motion.any()
    assert not frame.object_id.any()
    np.testing.assert_array_equal(np.linalg.norm(frame.normal, axis=-1), 1)


def test_emission_is_taken_off_a_beauty_that_contains_it(put):
    channels = beauty(2) | layer("emission", 0.5)
    channels["emission.R"][1, 2] = 3
    item = first(put(channels))
    assert item.frame.radiance[0, 0, 0].tolist() == [1.5, 1.5, 1.5]
    assert item.frame.radiance[0, 1, 2].tolist() == [0, 1.5, 1.5]
    assert item.frame.emission[1, 2].tolist() == [3, 0.5, 0.5]
    assert item.counts == {"excess": 1}


def test_what_is_not_finite_in_the_radiance_is_left_to_the_filter(put):
    channels = native()
    channels["direct.R"][0, 0], channels["emission.G"][0, 1] = np.nan, np.inf
    frame = first(put(channels)).frame
    assert np.isnan(frame.radiance[0, 0, 0, 0])
    assert np.isinf(frame.emission[0, 1, 1])
    plain = beauty() | layer("emission", 0.5)
    plain["emission.G"][0, 1] = np.nan
    assert np.isfinite(first(put(plain)).frame.radiance).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("id.I", value) for value in (-1, np.nan)),
        *(("depth.Z", value) for value in (0, -1, np.nan, np.inf, 1e8, 1e10)),
        ("normal.Z", 0),
    ],
)
def test_every_sign_of_no_surface_counts(put, name, value):
    channels = native()
    channels[name][2, 3] = value
    item = first(put(channels))
    frame = item.frame
    assert frame.object_id[2, 3] == -1
    assert (frame.object_id != -1).sum() == H * W - 1
    assert frame.depth[2, 3] == frame.prev_depth[2, 3] == 0
    assert not frame.normal[2, 3].any()
    sky = name == "id.I" or value in (1e8, 1e10)
    assert item.counts == ({} if sky else {"guides": 1})  # a hit without guides is odd, the sky is not


def test_alpha_of_a_beauty_says_where_nothing_was_hit(put):
    channels = beauty() | {"A": np.ones((H, W), np.float16)}
    channels["A"][0] = 0
    frame = first(put(channels)).frame
    assert (frame.object_id[0] == -1).all()
    assert (frame.object_id[1:] == 0).all()


def test_a_normal_that_is_not_finite_stays_for_the_filter_to_count(put):
    channels = native()
    channels["normal.X"][1, 1] = np.nan
    frame = first(put(channels)).frame
    assert frame.object_id[1, 1] == 3
    assert np.isnan(frame.normal[1, 1]).any()


def test_motion_that_is_not_finite_is_kept_on_surfaces_only(put):
    channels = native()
    channels["motion.X"][0, :2] = np.nan
    channels["id.I"][0, 0] = -1
    frame = first(put(channels)).frame
    assert np.isfinite(frame.motion[0, 0]).all()
    assert np.isnan(frame.motion[0, 1, 0])


def test_normals_come_to_unit_length_and_gross_ones_are_counted(put):
    channels = native() | layer("normal", [0.577, 0.577, 0.577], "XYZ")
    for c in "XYZ":
        channels[f"normal.{c}"][0, 0] *= 2
    item = first(put(channels))
    np.testing.assert_allclose(np.linalg.norm(item.frame.normal, axis=-1), 1, atol=1e-6)
    assert item.counts == {"normal": 1}


def test_ids_of_every_type(put):
    for dtype, value in ((np.uint32, 2**32 - 1), (np.float16, -1), (np.float32, -1)):
        ids = np.full((H, W), 7, dtype)
        ids[0] = value
        frame = first(put(native() | {"id.I": ids})).frame
        assert (frame.object_id[0] == -1).all()
        assert (frame.object_id[1:] == 7).all()
    large = np.arange(H * W, dtype=np.uint32).reshape(H, W) + 2**24
    assert len(np.unique(first(put(native() | {"id.I": large})).frame.object_id)) == H * W


def test_half_float_ids_and_depth_are_warned_about(put):
    fine = native() | layer("id", 2048, "I") | layer("depth", 4, "Z")
    source = open_source(put(fine))
    assert source.warnings == (
        "depth is in half float, in steps of 0.1 %: slopes become stairs. Let the renderer write this channel as 32-bit float.",
    )
    assert read_frame(source, 0).notes == ()
    (note,) = first(put(native() | layer("id", 4096, "I"))).notes
    assert note.startswith("object ids up to 4096 in half float: above 2048")


def test_other_channels_and_other_files(put):
    folder = put(*[beauty() | layer("foo", [0.1, 0.2, 0.3], dtype=np.float32)] * 2)
    put(*[{c: np.full((H, W), i, np.float32) for i, c in enumerate("RGB")}] * 2, name="n")
    source = open_source(
        folder / "frame_####.exr",
        channel={"albedo": ["foo.R", "foo.G", "foo.B"]},
        file={"normal": "n_####.exr"},
    )
    frame = read_frame(source, 1).frame
    np.testing.assert_allclose(frame.albedo[0, 0, 0], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(frame.normal[0, 0], np.array([0, 1, 2]) / 5**0.5, rtol=1e-6)
    assert "given by hand" in source.roles.describe()


def test_a_file_of_its_own_that_lacks_a_frame_is_found_before_the_work(put):
    folder = put(beauty(), beauty())
    put(beauty(), name="n")
    with pytest.raises(SvgfError, match=r"n_####\.exr: frames 1 of .* are missing here"):
        open_source(folder, file={"normal": folder / "n_####.exr"})


def test_sizes_that_change_and_windows_that_move(put):
    folder = put(native(), None, {name: pixels[:, :-1] for name, pixels in native().items()})
    source = open_source(folder, missing="hold")
    with pytest.raises(SvgfError, match=r"frame_0002\.exr: data window \(0, 0, 6, 5\) .*wanted \(0, 0, 7, 5\)"):
        read_frame(source, 2)
    moved = exr.new_image(native())._replace(data_window=(1, 0, W, H - 1))
    exr.write(folder / "frame_0002.exr", moved)
    with pytest.raises(SvgfError, match=r"frame_0002\.exr: data window \(1, 0, 8, 5\)"):
        read_frame(source, 2)
    with pytest.raises(SvgfError, match="frame 1 is missing"):
        read_frame(source, 1)


def test_a_file_of_its_own_must_have_the_same_size(put):
    folder = put(beauty())
    put({name: pixels[:-1] for name, pixels in beauty().items()}, name="n")
    source = open_source(folder, file={"normal": folder / "n_####.exr"})
    with pytest.raises(SvgfError, match=r"n_0000\.exr: data window"):
        read_frame(source, 0)


def test_a_broken_frame_in_the_middle_names_itself(put):
    folder = put(*[native()] * 3)
    source = open_source(folder)
    path = folder / "frame_0001.exr"
    path.write_bytes(path.read_bytes()[:-30])
    assert read_frame(source, 0).number == 0
    with pytest.raises(SvgfError, match=r"frame_0001\.exr: the pixel data is cut off"):
        read_frame(source, 1)


def test_a_later_frame_without_a_channel_names_itself(put):
    less = {name: pixels for name, pixels in native().items() if not name.startswith("albedo")}
    source = open_source(put(native(), less))
    with pytest.raises(SvgfError, match=r"frame_0001\.exr: no channel 'albedo\.R'"):
        read_frame(source, 1)


def test_pictures_beyond_the_limit(put):
    with pytest.raises(SvgfError, match="8 x 6 pixels; wanted at most 10"):
        first(put(native()), max_pixels=10)


def cameras(numbers, shift=0.5, **top):
    """Cameras that go forward by `shift` a frame."""
    screen = np.array([[10, 0, W / 2, 0], [0, 10, H / 2, 0], [0, 0, 1, -0.1], [0, 0, 1, 0]])
    frames = []
    for number in numbers:
        matrix = np.eye(4)
        matrix[2, 3] = -shift * number
        frames.append({"frame": number, "world_to_camera": matrix.tolist(), "camera_to_screen": screen.tolist()})
    return json.dumps({"per_frame": frames, **top})


def test_cameras_beside_the_frames_give_the_previous_depth_and_the_file_its_motion(put):
    folder = put(native(), native())
    (folder / "cameras.json").write_text(cameras([0, 1]))
    np.testing.assert_array_equal(first(folder).frame.prev_depth, 4)
    frame = first(folder, 1).frame
    np.testing.assert_allclose(frame.prev_depth, 4.5)
    np.testing.assert_array_equal(frame.motion[0, 0], [0.5, -1])
    np.testing.assert_array_equal(first(folder, 1, cameras=None).frame.prev_depth, 4)


def test_cameras_give_the_motion_where_it_is_absent(put):
    still = {name: pixels for name, pixels in native().items() if not name.startswith("motion")}
    folder = put(still, still)
    assert any(text.startswith("no motion") for text in open_source(folder).warnings)
    (folder / "cameras.json").write_text(cameras([0, 1]))
    source = open_source(folder)
    assert source.warnings == ()
    assert "cameras.json says" in source.roles.describe()
    motion = read_frame(source, 1).frame.motion
    np.testing.assert_allclose(motion[0, 0], np.array([0.5 - W / 2, 0.5 - H / 2]) * (4 / 4.5 - 1), rtol=1e-5)
    assert not read_frame(source, 0).frame.motion.any()


def test_frames_on_twos_need_cameras_and_say_so(put):
    folder = put(native(), None, native(), None, native())
    item = first(folder, 1, frames="0-4x2")
    assert item.notes[0].startswith("frame 2 follows frame 0, but its motion vectors lead to frame 1")
    assert "follows frame 0" in first(folder, 2, missing="hold").notes[0]
    (folder / "cameras.json").write_text(cameras([0, 1, 2, 3, 4]))
    for index, options in ((1, {"frames": "0-4x2"}), (2, {"missing": "hold"})):
        item = first(folder, index, **options)
        assert item.notes == ()
        np.testing.assert_allclose(item.frame.prev_depth, 5)
        np.testing.assert_allclose(item.frame.motion[0, 0, 0], (0.5 - W / 2) * (4 / 5 - 1), rtol=1e-5)


def test_a_crop_is_seen_by_the_same_camera(put):
    still = {name: pixels for name, pixels in native().items() if not name.startswith("motion")}
    folder = put(still, still)
    (folder / "cameras.json").write_text(cameras([0, 1]))
    whole = first(folder, 1).frame
    for number in (0, 1):
        crop = {name: pixels[2:, 3:] for name, pixels in still.items()}
        exr.write(folder / f"frame_{number:04d}.exr", exr.Image(crop, (3, 2, W - 1, H - 1), (0, 0, W - 1, H - 1), {}))
    np.testing.assert_allclose(first(folder, 1).frame.motion, whole.motion[2:, 3:], atol=1e-6)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (cameras([0]), "no camera for frame 1; .*--cameras none"),
        (
            cameras([0, 1], width=W, height=2 * H),
            r"cameras for pictures of \(8, 12\), but .*frame_0000\.exr shows \(8, 6\)",
        ),
        ("{}", 'no list "per_frame".*--cameras none'),
    ],
)
def test_cameras_that_do_not_fit_are_found_before_the_work(put, content, message):
    folder = put(native(), native())
    (folder / "cameras.json").write_text(content)
    with pytest.raises(SvgfError, match=message) as raised:
        open_source(folder)
    assert str(raised.value).count("--cameras none") == 1
    assert open_source(folder, cameras=None).cameras is None


def test_cameras_given_by_name(put, tmp_path):
    folder = put(native(), native())
    (tmp_path / "other.json").write_text(cameras([0, 1]))
    np.testing.assert_allclose(first(folder, 1, cameras=tmp_path / "other.json").frame.prev_depth, 4.5)
    with pytest.raises(SvgfError, match=r"none\.json: cannot be read"):
        open_source(folder, cameras=tmp_path / "none.json")


def test_cameras_without_depth_are_of_no_use(put):
    folder = put(beauty())
    (folder / "cameras.json").write_text(cameras([0]))
    assert "of no use without depth or position" in open_source(folder).warnings[-1]


def test_no_surface_anywhere_is_a_frame_all_the_same(put):
    frame = first(put(native() | layer("id", -1, "I", np.float32))).frame
    assert (frame.object_id == -1).all()
    assert all(np.isfinite(array).all() for array in frame if array is not None)


def test_a_sequence_is_stacked(put):
    folder = put(native(), native(), native())
    frames = load_sequence(folder, frames="0-1")
    assert frames.radiance.shape == (2, 2, H, W, 3)
    assert frames.object_id.shape == (2, H, W)


def test_total_radiance_of_any_image(put, tmp_path):
    put(native() | layer("emission", 0.5), name="ref")
    np.testing.assert_array_equal(read_radiance(tmp_path / "ref_0000.exr"), 1.75)
    put(native() | beauty(9), name="out")
    np.testing.assert_array_equal(read_radiance(tmp_path / "out_0000.exr"), 9)
    put({"Z": np.ones((H, W), np.float32)}, name="depth")
    with pytest.raises(SvgfError, match="no radiance"):
        read_radiance(tmp_path / "depth_0000.exr")
    put(beauty(), beauty())
    assert load_reference(tmp_path).shape == (1, H, W, 3)  # ref_, not frame_
    assert load_reference(tmp_path / "frame_####.exr").shape == (2, H, W, 3)


def test_reading_does_not_import_jax():
    code = "import sys, svgf_jax.frames, svgf_jax.references; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
