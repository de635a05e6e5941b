"""EXR in and out. Every known trap of the bindings has a test by its name."""

import resource
import struct
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from svgf_jax import SvgfError, exr
from svgf_jax.limits import Limits


def ramp(height=10, width=12, dtype=np.float32):
    return np.arange(height * width, dtype=dtype).reshape(height, width)


def write_parts(path, *parts):
    """A multi-part file as the bindings write it: (name, channels) each."""
    display = (np.array([0, 0], np.int32), np.array([11, 9], np.int32))
    bare = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION, "displayWindow": display}
    OpenEXR.File([OpenEXR.Part(dict(bare), dict(channels), name) for name, channels in parts]).write(str(path))


@pytest.fixture
def good(tmp_path) -> Path:
    path = tmp_path / "good.exr"
    noise = np.random.default_rng(0).random((64, 48), np.float32)
    exr.write(path, exr.new_image({"R": noise, "Z": ramp(64, 48)}, attributes={"spp": 4}))
    return path


def test_half_float_and_uint_come_back_as_they_were(tmp_path):
    channels = {"a.R": ramp(dtype=np.float16), "depth.Z": ramp() + 0.1, "id.I": ramp(dtype=np.uint32) + 2**31}
    exr.write(tmp_path / "x.exr", exr.new_image(channels))
    got = exr.read(tmp_path / "x.exr").channels
    assert got.keys() == channels.keys()
    for name, pixels in channels.items():
        assert got[name].dtype == pixels.dtype
        np.testing.assert_array_equal(got[name], pixels)
    assert exr.read_header(tmp_path / "x.exr").channels == {name: pixels.dtype for name, pixels in channels.items()}


@pytest.mark.parametrize(
    "view",
    [lambda a: a[:, ::-1], lambda a: a[::-1], lambda a: a.T, lambda a: a[:, 3:9], lambda a: np.asfortranarray(a)],
)
def test_arrays_that_are_not_contiguous_are_written_right(tmp_path, view):
    pixels = view(ramp())
    exr.write(tmp_path / "x.exr", exr.new_image({"Z": pixels}))
    np.testing.assert_array_equal(exr.read(tmp_path / "x.exr").channels["Z"], pixels)


def test_one_channel_of_an_interleaved_array_is_written_right(tmp_path):
    colour = np.random.default_rng(0).random((5, 7, 3), np.float32)
    exr.write(tmp_path / "x.exr", exr.new_image({c: colour[..., i] for i, c in enumerate("RGB")}))
    got = exr.read(tmp_path / "x.exr").channels
    np.testing.assert_array_equal(np.stack([got[c] for c in "RGB"], -1), colour)


def test_big_endian_arrays_are_written_right(tmp_path):
    exr.write(tmp_path / "x.exr", exr.new_image({"Z": ramp().astype(">f4")}))
    np.testing.assert_array_equal(exr.read(tmp_path / "x.exr").channels["Z"], ramp())


@pytest.mark.parametrize("keep", [0.02, 0.5, 0.99, -1])
def test_truncated_pixel_data_raises_and_says_nothing_on_the_terminal(good, capfd, keep):
    whole = good.read_bytes()
    good.write_bytes(whole[: int(len(whole) * keep) if keep > 0 else -1])
    with pytest.raises(SvgfError, match=r"good\.exr: .*cut off.*[Rr]ender"):
        exr.read(good)
    with pytest.raises(SvgfError, match="cut off"):
        exr.read_header(good)
    assert capfd.readouterr() == ("", "")


def test_truncated_multi_part_and_tiled_raise(tmp_path):
    write_parts(tmp_path / "parts.exr", ("a", {"R": ramp()}), ("b", {"Z": ramp(), "Y": ramp()}))
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    OpenEXR.File(tiles, {"Z": ramp(70, 70)}).write(str(tmp_path / "tiles.exr"))
    for path in tmp_path.iterdir():
        path.write_bytes(path.read_bytes()[:-20])
        with pytest.raises(SvgfError, match="cut off"):
            exr.read(path)


def test_an_interrupted_render_with_an_empty_chunk_table_raises(good):
    raw = bytearray(good.read_bytes())
    chunks = 64 // 16
    first = min(i for i in range(len(raw) - 8) if struct.unpack_from("<Q", raw, i)[0] == i + 8 * chunks)
    raw[first + 8 : first + 8 * chunks] = bytes(8 * (chunks - 1))
    good.write_bytes(raw)
    with pytest.raises(SvgfError, match="3 of 4 chunks missing"):
        exr.read(good)


def test_corrupt_pixel_data_raises(good):
    raw = bytearray(good.read_bytes())
    raw[len(raw) // 2 : len(raw) // 2 + 400] = np.random.default_rng(1).bytes(400)
    good.write_bytes(raw)
    with pytest.raises(SvgfError, match=r"good\.exr: the pixel data is corrupt"):
        exr.read(good)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty"),
        (b"v/1", "not an EXR file"),
        (b"\x89PNG\r\n" + bytes(100), r"not an EXR file \(it starts with b'\\x89PNG'"),
        (b"v/1\x01" + bytes(3), "header is damaged"),
        (b"v/1\x01\x02\x00\x00\x00" + b"a" * 1000, "header is damaged"),
        (b"v/1\x01\x02\x00\x00\x00\x00", "header is damaged"),
    ],
)
def test_empty_foreign_and_damaged_files(tmp_path, content, message):
    (tmp_path / "x.exr").write_bytes(content)
    for read in exr.read, exr.read_header:
        with pytest.raises(SvgfError, match=rf"x\.exr: .*{message}"):
            read(tmp_path / "x.exr")


def test_every_cut_of_the_header_is_an_svgf_error(good):
    whole = good.read_bytes()
    for size in range(0, 450, 7):
        good.write_bytes(whole[:size])
        with pytest.raises(SvgfError, match=r"good\.exr"):
            exr.read(good)


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(SvgfError, match=r"none\.exr: cannot be read \(No such file"):
        exr.read(tmp_path / "none.exr")
    with pytest.raises(SvgfError, match="this is a folder"):
        exr.read(tmp_path)


def test_data_window_apart_from_the_display_window_is_kept(tmp_path):
    crop = exr.Image({"Z": ramp()}, (5, -3, 16, 6), (0, 0, 31, 19), {})
    exr.write(tmp_path / "x.exr", crop)
    got = exr.read(tmp_path / "x.exr")
    assert (got.data_window, got.display_window) == (crop.data_window, crop.display_window)
    np.testing.assert_array_equal(got.channels["Z"], ramp())
    exr.write(tmp_path / "y.exr", exr.new_image({"R": ramp()}, like=got, attributes={"by": "me"}))
    header = exr.read_header(tmp_path / "y.exr")
    assert (header.data_window, header.display_window) == (crop.data_window, crop.display_window)
    assert header.attributes["by"] == "me"


def test_multi_part_is_merged_and_equal_names_keep_their_part(tmp_path):
    write_parts(tmp_path / "x.exr", ("left", {"R": ramp(), "left.Z": ramp() + 1}), ("right", {"R": ramp() + 2}))
    got = exr.read(tmp_path / "x.exr").channels
    assert {name: pixels[0, 0] for name, pixels in got.items()} == {"left.R": 0, "left.Z": 1, "right.R": 2}
    header = exr.read_header(tmp_path / "x.exr")
    assert header.parts == ("left", "right")
    assert header.channels.keys() == got.keys()


def test_parts_of_different_size_are_refused(tmp_path):
    write_parts(tmp_path / "x.exr", ("a", {"R": ramp()}), ("b", {"Z": ramp(5, 5)}))
    with pytest.raises(SvgfError, match="different data windows"):
        exr.read(tmp_path / "x.exr")


def test_tiled_is_read(tmp_path):
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    OpenEXR.File(tiles, {"Z": ramp(70, 50)}).write(str(tmp_path / "x.exr"))
    np.testing.assert_array_equal(exr.read(tmp_path / "x.exr").channels["Z"], ramp(70, 50))


def test_layers_are_never_merged(tmp_path):
    channels = {f"{layer}.{c}": ramp() + i for i, layer in enumerate(("direct", "albedo")) for c in "RGBA"}
    exr.write(tmp_path / "x.exr", exr.new_image(channels))
    assert set(exr.read(tmp_path / "x.exr").channels) == set(channels)


def edit(path, old, new):
    raw = path.read_bytes()
    assert old in raw
    path.write_bytes(raw.replace(old, new, 1))


def test_deep_is_refused(tmp_path):
    path = tmp_path / "x.exr"
    write_parts(path, ("a", {"R": ramp()}), ("b", {"Z": ramp()}))
    edit(path, b"scanlineimage", b"deepscanline\0")
    with pytest.raises(SvgfError, match="deep pixel data"):
        exr.read(path)


def test_subsampled_is_refused(good):
    edit(good, b"Z\0" + struct.pack("<4i", 2, 0, 1, 1), b"Z\0" + struct.pack("<4i", 2, 0, 2, 2))
    with pytest.raises(SvgfError, match="'Z' is subsampled by 2 x 2"):
        exr.read(good)


def test_a_size_that_no_memory_holds_is_refused_before_it_is_allocated(good):
    window = struct.pack("<4i", 0, 0, 47, 63)
    edit(
        good,
        b"dataWindow\0box2i\0\x10\0\0\0" + window,
        b"dataWindow\0box2i\0\x10\0\0\0" + struct.pack("<4i", 0, 0, 2**30, 63),
    )
    with pytest.raises(SvgfError, match="1073741825 x 64 pixels; wanted at most"):
        exr.read(good)


def test_max_pixels(good):
    assert exr.read(good, most=Limits(64 * 48)).channels
    with pytest.raises(SvgfError, match="48 x 64 pixels; wanted at most 3071"):
        exr.read(good, most=Limits(64 * 48 - 1))


def test_strings_and_paths_are_both_file_names(good):
    assert (
        exr.read(str(good)).channels.keys()
        == exr.read(good).channels.keys()
        == exr.read_header(str(good)).channels.keys()
    )


def test_the_callers_dictionaries_are_left_alone(good):
    image = exr.read(good)
    channels, attributes = dict(image.channels), dict(image.attributes)
    exr.write(good, image)
    assert image.channels.keys() == channels.keys()
    assert all(image.channels[name] is pixels for name, pixels in channels.items())
    assert image.attributes == attributes
    again = exr.read(good)
    assert again.attributes["spp"] == 4
    assert again.channels["R"].flags.writeable


def test_attributes_survive_and_what_cannot_be_written_is_named(tmp_path):
    matrix = np.arange(16, dtype=np.float32).reshape(4, 4)
    kept = {
        "owner": "é",
        "spp": 7,
        "gain": 0.5,
        "worldToCamera": matrix,
        "double": matrix.astype(np.float64),
        "names": ["a", "b"],
        "pixelAspectRatio": 2.0,
        "many": [1.0, 2.0, 3.0, 4.0],
        "chromaticities": (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.31, 0.33),
    }
    lost = {"none": None, "bytes": b"x", "big": 2**40, "empty": [], "vector": np.zeros(9, np.float32)}
    odd = {"numpy": np.float32(2.0), "yes": True, "turned": matrix.T}
    dropped = exr.write(
        tmp_path / "x.exr", exr.new_image({"R": ramp()}, attributes=kept | lost | odd | {"type": "deep"})
    )
    assert set(dropped) == set(lost)
    got = exr.read(tmp_path / "x.exr").attributes
    assert got["owner"] == "é"
    assert (got["spp"], got["gain"], got["pixelAspectRatio"]) == (7, 0.5, 2.0)
    assert (got["numpy"], got["yes"], got["names"]) == (2.0, 1, ["a", "b"])
    np.testing.assert_array_equal(got["worldToCamera"], matrix)
    np.testing.assert_array_equal(got["double"], matrix)
    np.testing.assert_array_equal(got["turned"], matrix.T)
    np.testing.assert_allclose(got["many"], kept["many"])
    np.testing.assert_allclose(got["chromaticities"], kept["chromaticities"], rtol=1e-6)
    assert "type" not in got
    exr.write(tmp_path / "y.exr", exr.read(tmp_path / "x.exr"))  # what was read can be written
    assert exr.read_header(tmp_path / "y.exr").attributes.keys() == got.keys()


@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        (ramp().astype(np.float64), "'Z' is float64; EXR holds float16, float32, uint32"),
        (ramp().astype(np.int32), "'Z' is int32"),
        (np.zeros((3, 3), np.float32), r"shape \(3, 3\)"),
        (np.zeros((10, 12, 2), np.float32), r"shape \(10, 12, 2\)"),
    ],
)
def test_arrays_that_an_exr_cannot_hold_are_refused(tmp_path, pixels, message):
    with pytest.raises(SvgfError, match=message):
        exr.write(tmp_path / "x.exr", exr.Image({"Z": pixels}, (0, 0, 11, 9), (0, 0, 11, 9), {}))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("compression", exr.COMPRESSIONS)
def test_every_compression(tmp_path, compression):
    exr.write(tmp_path / "x.exr", exr.new_image({"Z": ramp(40, 30)}), compression=compression)
    np.testing.assert_allclose(exr.read(tmp_path / "x.exr").channels["Z"], ramp(40, 30), rtol=1e-2, atol=1)


def test_unknown_compression(tmp_path):
    with pytest.raises(SvgfError, match="'lzw' is not known; choose one of none, rle, zips, zip"):
        exr.write(tmp_path / "x.exr", exr.new_image({"Z": ramp()}), compression="lzw")


def test_disk_full_leaves_the_old_file_and_nothing_else(good, capfd):
    before = good.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(SvgfError, match=r"good\.exr: cannot be written .*disk full"):
            exr.write(good, exr.new_image({"Z": np.random.default_rng(0).random((100, 100), np.float32)}))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert good.read_bytes() == before
    assert [path.name for path in good.parent.iterdir()] == ["good.exr"]
    assert capfd.readouterr() == ("", "")


def test_a_failing_rename_leaves_no_temporary_file(good, monkeypatch):
    names = []

    def fail(self, target):
        names.append(self.name)
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(SvgfError, match=r"cannot be written \(Permission denied\)"):
        exr.write(good, exr.new_image({"Z": ramp()}))
    assert names[0].startswith(".good.exr.")
    assert [path.name for path in good.parent.iterdir()] == ["good.exr"]


def test_missing_folder_is_named(tmp_path):
    with pytest.raises(SvgfError, match=r"there is no folder .*nowhere"):
        exr.write(tmp_path / "nowhere" / "x.exr", exr.new_image({"Z": ramp()}))


def test_an_old_openexr_is_refused():
    exr._check_version("3.5.3")
    exr._check_version("4.0.0-dev")
    for version in "3.5.2", "3.4.17", "2.9":
        with pytest.raises(SvgfError, match=rf"OpenEXR {version} is installed; wanted 3\.5\.3 or later"):
            exr._check_version(version)


def test_many_threads_read_and_write_at_once(good, tmp_path):
    want = exr.read(good).channels["R"]

    def work(i):
        exr.write(tmp_path / f"{i}.exr", exr.new_image({"R": want + i}))
        return exr.read(good).channels["R"], exr.read(tmp_path / f"{i}.exr").channels["R"] - i

    with ThreadPoolExecutor(8) as pool:
        for read, written in pool.map(work, range(40)):
            np.testing.assert_array_equal(read, want)
            np.testing.assert_allclose(written, want, atol=1e-5)


def test_a_real_frame(data):
    path = data / "cornell-dolly" / "frame_0001.exr"
    image, header = exr.read(path), exr.read_header(path)
    assert len(image.channels) == 22
    assert {name: pixels.dtype for name, pixels in image.channels.items()} == header.channels
    assert image.attributes["sequence"] == header.attributes["sequence"] == "cornell-dolly"
    assert image.channels["id.I"].shape == (270, 480)


@pytest.mark.parametrize("compression", exr.COMPRESSIONS)
def test_the_header_tells_the_compression(tmp_path, compression):
    exr.write(tmp_path / "x.exr", exr.new_image({"Z": ramp()}), compression=compression)
    assert exr.read_header(tmp_path / "x.exr").compression == compression
