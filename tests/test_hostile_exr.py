"""Files that lie: refused by checks of our own before the library sees them, or read right. More of them: bench/fuzz_exr.py."""

import itertools
import struct
import subprocess
import sys
import threading
from pathlib import Path

import exr_files
import numpy as np
import pytest

import tune.__main__ as tuner
from svgf_jax import SvgfError, cli, exr, limits, prints
from svgf_jax.limits import Limits

WINDOW = (-3, 4, 17, 20)
SHAPE = (17, 21)


def part(seed=0, **options) -> exr_files.Part:
    rng = np.random.default_rng(seed)
    pixels = {
        "R": rng.random(SHAPE).astype("<f4"),
        "Z": np.ones(SHAPE, "<f2"),
        "id": rng.integers(0, 3, SHAPE).astype("<u4"),
    }
    return exr_files.Part(**{"pixels": pixels, "window": WINDOW, "display": (0, 0, 30, 30)} | options)


@pytest.fixture
def put(tmp_path):
    def write(raw, name="x.exr") -> Path:
        (tmp_path / name).write_bytes(raw)
        return tmp_path / name

    return write


def refused(path, message):
    with pytest.raises(SvgfError, match=rf"^{path}: .*{message}"):
        exr.read(path)


KINDS = [(None, "one"), ((8, 8), "one"), ((7, 5), "mip"), ((7, 5), "rip")]


@pytest.mark.parametrize("compression", exr_files.COMPRESSIONS)
def test_every_kind_is_read_as_it_was_written_by_hand(put, compression):
    for (tile, levels), round_up, order, count in itertools.product(KINDS, (False, True), (0, 1), (1, 2)):
        options = {
            "compression": compression,
            "tile": tile,
            "levels": levels,
            "round_up": round_up,
            "line_order": order,
        }
        parts = [part(i, name=f"p{i}", **options) for i in range(count)]
        raw = exr_files.write(parts)
        image = exr.read(put(raw))
        assert image.data_window == WINDOW
        plain = exr_files.read(raw)
        for one, same in zip(parts, plain, strict=True):
            for name, pixels in one.pixels.items():
                full = name if count == 1 else f"{one.name}.{name}"
                np.testing.assert_array_equal(image.channels[full], pixels)
                np.testing.assert_array_equal(same[name], pixels)


def put_at(raw, at, form, *values) -> bytes:
    raw = bytearray(raw)
    struct.pack_into(form, raw, at, *values)
    return bytes(raw)


@pytest.mark.parametrize("tile", [None, (8, 8)])
def test_a_table_that_does_not_lead_to_its_chunks_is_refused(put, tile):
    raw = exr_files.write([part(name="a", tile=tile), part(1, name="b", tile=tile)])
    (start, _), (other, _) = exr_files.dissect(raw).tables
    first, second = struct.unpack_from("<2Q", raw, start)
    elsewhere = struct.unpack_from("<Q", raw, other)[0]
    for entries in (second, first), (first, first), (elsewhere, second), (first + 1, second):
        refused(put(put_at(raw, start, "<2Q", *entries)), "corrupt .chunk 1|2 of .* is not where the table says")
    for entry in 0, start, len(raw), 2**63, 2**64 - 1:
        refused(put(put_at(raw, start, "<Q", entry)), "cut off|corrupt")


def test_a_chunk_that_says_another_place_or_size_is_refused(put):
    raw = exr_files.write([part(tile=(8, 8), levels="mip", compression="zip")])
    chunk, head, size = exr_files.dissect(raw).chunks[0][3]
    for field, value in (0, 5), (1, -1), (2, 1), (3, 1), (4, -1), (4, 2**31 - 1):
        refused(put(put_at(raw, chunk + 4 * field, "<i", value)), "chunk 4 of")
    assert size > 0
    assert head == 20


def test_every_truncation_is_refused(put):
    for options in ({}, {"tile": (8, 8), "levels": "rip"}, {"compression": "zip"}):
        raw = exr_files.write([part(**options), part(1, name="b", **options)])
        for keep in [*range(0, len(raw), 331), len(raw) - 1]:
            refused(put(raw[:keep]), "cut off|damaged|empty|not an EXR")


def with_attribute(raw, name, value) -> bytes:
    at, size = exr_files.dissect(raw).attributes[0][name]
    assert len(value) == size
    return raw[:at] + value + raw[at + size :]


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("dataWindow", struct.pack("<4i", 0, 0, 29999, 29999), "damaged .*9 chunks; 14062500 make the picture"),
        ("dataWindow", struct.pack("<4i", 0, 0, -1, -1), "damaged .*data window"),
        ("dataWindow", struct.pack("<4i", -(2**31), 0, 2**31 - 1, 9), "damaged .*data window"),
        ("dataWindow", struct.pack("<4i", 0, 0, 9, 2**29), "damaged|cut off"),
        ("tiles", struct.pack("<IIB", 0, 8, 0), "damaged .*tiles of 0 x 8"),
        ("tiles", struct.pack("<IIB", 8, 2**31, 0), "damaged .*tiles of 8 x 2147483648"),
        ("tiles", struct.pack("<IIB", 8, 8, 7), "damaged .*mode 7"),
        ("tiles", struct.pack("<IIB", 2**20, 2**20, 0), "1 make the picture"),
        ("tiles", struct.pack("<IIB", 4, 8, 0), "[0-9]+ chunks; [0-9]+ make the picture"),
        ("compression", b"\xc8", "compression number 200"),
        ("type", b"hologram!!", "a part of type 'hologram!!'"),
        ("chunkCount", struct.pack("<i", 2**31 - 1), "2147483647 chunks; 9 make the picture"),
        ("chunkCount", struct.pack("<i", -1), "-1 chunks"),
    ],
)
def test_numbers_of_a_header_that_do_not_hold_together_are_refused(put, name, value, message):
    raw = exr_files.write([part(tile=(8, 8)), part(1, name="b", tile=(8, 8))])
    path = put(with_attribute(raw, name, value))
    refused(path, message)
    with pytest.raises(SvgfError):
        exr.read_header(path)


def test_tiles_far_larger_than_their_picture_are_refused(put):
    refused(claim(put, 21, 17, 900, tile=(2**20, 2**12)), "tiles of 1048576 x 4096 in a picture of 21 x 17")
    assert exr.read_header(claim(put, 21, 17, 900, tile=(2**12, 2**12))).channels


@pytest.mark.parametrize("size", [-1, 2**31 - 1, 3])
def test_an_attribute_of_another_size_is_refused(put, size):
    raw = exr_files.write([part()])
    at, _ = exr_files.dissect(raw).attributes[0]["dataWindow"]
    refused(put(put_at(raw, at - 4, "<i", size)), "header is damaged")


def claim(put, width, height, size, compression=9, tile=None) -> Path:
    """A file of one tile that is as large as the picture that it claims, or as it is said to be."""
    raw = exr_files.write([part(pixels={"Z": np.zeros(SHAPE, "<f4")}, tile=(32, 32))])
    for name, value in {
        "dataWindow": struct.pack("<4i", 0, 0, width - 1, height - 1),
        "tiles": struct.pack("<IIB", *(tile or (width, height)), 0),
        "compression": bytes([compression]),
    }.items():
        raw = with_attribute(raw, name, value)
    (chunk, head, _), *_ = exr_files.dissect(raw).chunks[0]
    raw = raw[: chunk + head - 4] + struct.pack("<i", size - chunk - head)
    return put(raw + bytes(size - len(raw)))


def test_a_small_file_that_claims_a_large_picture_is_refused_before_it_is_allocated(put):
    refused(claim(put, 30_000, 8_000, 2048), "0.96 GB of pixels in a file of 2048 bytes.*--max-ratio 468750")
    refused(claim(put, 30_000, 30_000, 2048), "30000 x 30000 pixels; wanted at most 268435456.*--max-pixels")
    refused(claim(put, 1 << 14, 1 << 14, 500_000), "1.1 GB of pixels in a file of 500000 bytes")
    refused(claim(put, 1 << 12, 1 << 12, 2048), "corrupt")  # 64 MB are believed; the library then finds nothing in it


def test_who_says_how_large_pictures_are_is_believed_but_their_files_are_not(put):
    path = claim(put, 1 << 14, 1 << 13, 2048)
    for most in None, Limits(2**27), Limits(2**40), Limits(2**27, 2**18 - 1):
        with pytest.raises(SvgfError, match=r"0\.54 GB of pixels .* \(--max-ratio 262144\)"):
            exr.read_header(path, most=most)
    assert exr.read_header(path, most=Limits(2**27, 2**18)).data_window == (0, 0, (1 << 14) - 1, (1 << 13) - 1)
    limits.set_limits(2**27, 2**18)
    try:
        assert exr.read_header(path).channels
        limits.set_limits(2**27 - 1, 2**18)
        with pytest.raises(SvgfError, match="wanted at most 134217727"):
            exr.read_header(path)
    finally:
        limits.set_limits()
    for wrong, said in ({"pixels": 0}, "--max-pixels 0"), ({"ratio": -1}, "--max-ratio -1"):
        with pytest.raises(SvgfError, match=f"Got {said}; wanted"):
            limits.set_limits(**wrong)


def test_channels_beyond_number_are_refused(put):
    for count in (10_000, 10_001):
        pixels = {f"{i:05d}": np.zeros((1, 1), "<f2") for i in range(count)}
        path = put(exr_files.write([part(pixels=pixels, window=(0, 0, 0, 0))]), f"{count}.exr")
        if count > 10_000:
            refused(path, "10001 channels; wanted at most 10000")
        else:
            assert len(exr.read_header(path).channels) == count


@pytest.mark.parametrize("bad", ["R\x1b[31m", "a\nb", "\x9b31m", "a\x7f"])
def test_names_that_could_steer_a_terminal_are_refused(put, bad):
    channel = exr_files.write([part(pixels={bad: np.zeros(SHAPE, "<f4")})])
    name = exr_files.write([part(name=bad), part(name="b")])
    attribute = exr_files.write([part(attributes=((bad, "string", b"x"),))])
    for raw in channel, name, attribute:
        with pytest.raises(SvgfError, match="a name with control characters") as raised:
            exr.read(put(raw))
        assert not set(str(raised.value)) & set("\x1b\n\x9b\x7f")


def test_names_with_markup_come_as_they_are(put):
    names = ["<script>alert(1)</script>", "%s%n", "{0}", "[red]", "../../x", "é", "$(touch x)"]
    image = exr.read(put(exr_files.write([part(pixels=dict.fromkeys(names, np.ones(SHAPE, "<f4")))])))
    assert set(image.channels) == set(names)


def test_channels_out_of_order_or_twice_there_are_refused(put):
    """The library gives one the pixels of the other."""
    raw = exr_files.write([part(pixels={"Rb": np.zeros(SHAPE, "<f4"), "Rc": np.ones(SHAPE, "<f4")})])
    for other in b"Rb\0", b"Ra\0":
        refused(put(raw.replace(b"Rc\0", other, 1)), "'R[ab]' out of alphabetical order or twice there")


def corrupt(raw) -> bytes:
    offset, head, size = exr_files.dissect(raw).chunks[0][0]
    return (
        raw[: offset + head]
        + bytes(b ^ 0x5A for b in raw[offset + head : offset + head + size])
        + raw[offset + head + size :]
    )


def test_what_the_library_prints_does_not_reach_the_standard_output(put, capfd):
    path = put(corrupt(exr_files.write([part(compression="zip")])))
    refused(path, "corrupt .*[Uu]nable|corrupt .*decode|corrupt .*rror")
    captured = capfd.readouterr()
    assert captured.out == ""
    assert "Warning" not in captured.err


def test_what_others_print_meanwhile_does(capsys):
    with prints.kept() as inner, prints.kept() as own:
        thread = threading.Thread(target=print, args=("theirs",))
        thread.start()
        thread.join()
        print("ours")
    print("after")
    assert "".join([*inner, *own]) == "ours\n"
    assert capsys.readouterr().out == "theirs\nafter\n"
    assert not isinstance(sys.stdout, prints._Watched)


def test_c_code_prints_beside_the_results():
    script = "import os; from svgf_jax import prints; prints.set_results_apart(); os.write(1, b'C'); print('result é')"
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    assert (ran.stdout.decode(), ran.stderr) == ("result é\n", b"C")


def test_a_crash_of_a_library_is_told():
    script = (
        "import ctypes, contextlib, sys; sys.argv = ['svgf-jax', '--version']; from svgf_jax.__main__ import main\n"
        "with contextlib.suppress(SystemExit): main()\n"
        "ctypes.string_at(0)"
    )
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert ran.returncode < 0
    assert "Segmentation fault" in ran.stderr


def test_limits_on_the_command_line(put, capsys):
    path = str(put(exr_files.write([part()])))
    tune = ["--reference", path, "-o", f"{path}.toml"]
    for program, command in (cli, ["inspect", path]), (cli, ["compare", path, path]), (tuner, [path, *tune]):
        with pytest.raises(SystemExit):
            program.main([*command, "--max-pixels", "356"])
        assert "21 x 17 pixels; wanted at most 356" in capsys.readouterr().err
    assert exr.read(path).channels
    claim(put, 1 << 14, 1 << 13, 2048)
    with pytest.raises(SystemExit):
        cli.main(["inspect", path, "--max-pixels", "1000000000"])
    assert "--max-ratio 262144" in capsys.readouterr().err
    assert limits.limits() == Limits()


def test_a_short_campaign_finds_nothing(tmp_path):
    script = Path(__file__).parent / "bench" / "fuzz_exr.py"
    command = [
        sys.executable,
        str(script),
        "--files",
        "400",
        "--structures",
        "10",
        "--seed",
        "3",
        "--keep",
        str(tmp_path),
    ]
    ran = subprocess.run(command, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
