"""Patterns, folders, ranges and gaps."""

import os

import pytest

from svgf_jax import SvgfError
from svgf_jax.sequences import companion, find_sequence, format_range, parse_range


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder of frame_0000 to frame_0005 (0003 missing), where the tests also are."""
    for number in (0, 1, 2, 4, 5):
        (tmp_path / f"frame_{number:04d}.exr").touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def numbers(sequence):
    return [number for number, _ in sequence.files]


@pytest.mark.parametrize(
    "pattern", ["frame_####.exr", "frame_%04d.exr", "frame_$F4.exr", "frame_@@@@.exr", "frame_????.exr"]
)
@pytest.mark.parametrize("place", ["", "./", "absolute"])
def test_every_spelling_of_a_pattern(folder, pattern, place):
    root = f"{folder}/" if place == "absolute" else place
    got = find_sequence(root + pattern, frames="0-2")
    assert got.files == tuple((i, f"{root}frame_{i:04d}.exr") for i in range(3))
    assert (got.name, got.padding, got.missing) == (root + pattern, 4, "error")


def test_a_path_is_as_good_as_a_string(folder):
    assert numbers(find_sequence(folder / "frame_####.exr", frames="1-2")) == [1, 2]


@pytest.mark.parametrize("pattern", ["f#.exr", "f%d.exr", "f$F.exr", "f@.exr"])
def test_numbers_without_padding(tmp_path, pattern):
    for number in range(8, 12):
        (tmp_path / f"f{number}.exr").touch()
    (tmp_path / "f0009.exr").touch()
    got = find_sequence(tmp_path / pattern)
    assert got.files == tuple((i, str(tmp_path / f"f{i}.exr")) for i in range(8, 12))


def test_numbers_that_outgrow_their_padding(tmp_path):
    for number in (99, 100):
        (tmp_path / f"f{number:02d}.exr").touch()
    assert numbers(find_sequence(tmp_path / "f##.exr")) == [99, 100]
    assert numbers(find_sequence(tmp_path)) == [99, 100]


def test_names_with_spaces_dots_dashes_brackets_and_other_digits(tmp_path):
    for name in ("my shot (2) v02.{}.denoised.exr", "shot-{}.exr", "a[1]+{}.exr"):
        for number in (1, 2):
            (tmp_path / name.format(f"{number:04d}")).touch()
        got = find_sequence(tmp_path / name.format("####"))
        assert numbers(got) == [1, 2]
        assert all(path and os.path.exists(path) for _, path in got.files)


def test_folders_may_have_any_name(tmp_path):
    (tmp_path / "me@work #2").mkdir()
    (tmp_path / "me@work #2" / "f.0001.exr").touch()
    assert numbers(find_sequence(tmp_path / "me@work #2" / "f.####.exr")) == [1]


def test_negative_numbers(tmp_path):
    for number in (-1, 0, 1):
        (tmp_path / f"f.{str(number).zfill(4)}.exr").touch()
    assert numbers(find_sequence(tmp_path / "f.####.exr")) == [-1, 0, 1]


def test_ranges():
    assert parse_range("1-5") == [1, 2, 3, 4, 5]
    assert parse_range("1-9x3") == [1, 4, 7]
    assert parse_range("1,3,5-7") == [1, 3, 5, 6, 7]
    assert parse_range("7-5,6") == [5, 6, 7]
    assert parse_range("-2-1") == [-2, -1, 0, 1]
    assert format_range([1, 2, 3, 5, 9]) == "1-3,5,9"


@pytest.mark.parametrize("text", ["", "abc", "1-", "1..5", "1-5x0", "1-999999999", "1.5-3"])
def test_ranges_that_cannot_be_read(text):
    with pytest.raises(SvgfError, match="cannot be read; wanted something like 1-100, 1-100x2 or 1,3,5-9"):
        parse_range(text)


def test_a_range_asks_only_for_its_own_frames(folder):
    assert numbers(find_sequence("frame_####.exr", frames="0-4x2")) == [0, 2, 4]
    assert numbers(find_sequence(folder, frames="1,4-5")) == [1, 4, 5]


def test_missing_frames_are_an_error_that_says_which(folder):
    with pytest.raises(
        SvgfError, match=r"1 of 6 frames are missing: 3; on the disk are 0-2,4-5\. .*--missing hold\|reset"
    ):
        find_sequence(folder)
    with pytest.raises(SvgfError, match=r"3 of 5 frames are missing: 3,6-7"):
        find_sequence("frame_####.exr", frames="3-7")


@pytest.mark.parametrize("missing", ["hold", "reset"])
def test_missing_frames_have_no_path_when_they_are_allowed(folder, missing):
    got = find_sequence(folder, missing=missing)
    assert [number for number, path in got.files if path is None] == [3]
    assert numbers(got) == [0, 1, 2, 3, 4, 5]
    assert got.missing == missing


def test_no_frame_at_all_is_an_error_under_every_policy(folder):
    with pytest.raises(SvgfError, match="11 of 11 frames are missing: 90-100"):
        find_sequence(folder, frames="90-100", missing="hold")


def test_unknown_policy(folder):
    with pytest.raises(SvgfError, match="'skip' is not known; choose one of error, hold, reset"):
        find_sequence(folder, missing="skip")  # pyright: ignore[reportArgumentType]


def test_one_file_is_a_sequence_of_one(folder):
    assert find_sequence("frame_0002.exr").files == ((2, "frame_0002.exr"),)
    (folder / "beauty.exr").touch()
    assert find_sequence(folder / "beauty.exr").files == ((0, str(folder / "beauty.exr")),)
    with pytest.raises(SvgfError, match="one file without a frame number"):
        find_sequence("beauty.exr", frames="1-3")


def test_one_file_and_a_range_mean_its_sequence(folder):
    assert numbers(find_sequence(folder / "frame_0000.exr", frames="0-2")) == [0, 1, 2]


def test_a_folder_of_several_sequences(folder):
    (folder / "frame_0003.exr").touch()
    for name in ("ref_0001.exr", "alt_0001.exr", "notes.txt", "single.exr", ".frame_0006.exr.ab.tmp"):
        (folder / name).touch()
    assert numbers(find_sequence(folder)) == [0, 1, 2, 3, 4, 5]
    assert find_sequence(folder, prefer=("ref", "frame")).files == ((1, str(folder / "ref_0001.exr")),)
    with pytest.raises(
        SvgfError, match=r"several sequences are here: alt_####\.exr, frame_####\.exr, ref_####\.exr, single"
    ):
        find_sequence(folder, prefer=())


def test_a_folder_of_one_sequence_of_any_name(tmp_path):
    (tmp_path / "beauty.7.EXR").touch()
    (tmp_path / "readme.txt").touch()
    assert find_sequence(tmp_path).files == ((7, str(tmp_path / "beauty.7.EXR")),)


def test_nothing_found_says_what_is_near(folder):
    with pytest.raises(SvgfError, match=r"frames_####\.exr: no such frames\. In \. there is frame_####\.exr"):
        find_sequence("frames_####.exr")
    with pytest.raises(SvgfError, match=r"frame_#\.exr: no such frames\. .*there is frame_####\.exr"):
        find_sequence("frame_#.exr")
    with pytest.raises(SvgfError, match=r"fram\.exr: no such file or folder"):
        find_sequence("fram.exr")
    with pytest.raises(SvgfError, match=r"There is no folder .*; did you mean " + folder.name):
        find_sequence(f"{folder}x/frame_####.exr")
    empty = folder / "empty"
    empty.mkdir()
    with pytest.raises(SvgfError, match=r"wanted a folder of EXR files; this one holds nothing"):
        find_sequence(empty)
    (empty / "a.png").touch()
    with pytest.raises(SvgfError, match=r"holds no EXR files, but a\.png"):
        find_sequence(empty)


@pytest.mark.parametrize("pattern", ["f##_##.exr", "v##/frame.exr"])
def test_a_number_in_two_places_or_in_a_folder(tmp_path, pattern):
    with pytest.raises(SvgfError, match="wanted one place for the frame number, in the file's name"):
        find_sequence(tmp_path / pattern)


def test_companion_has_the_same_frames(folder):
    for number in (0, 1, 2, 3, 4):
        (folder / f"normal.{number}.exr").touch()
    main = find_sequence(folder, frames="0-2")
    assert companion(main, "normal.#.exr").files == tuple((i, f"normal.{i}.exr") for i in range(3))
    whole = find_sequence(folder, missing="hold")
    with pytest.raises(SvgfError, match=r"normal\.#\.exr: frames 5 of .* are missing here; on the disk are 0-4"):
        companion(whole, "normal.#.exr")
    assert companion(whole, "normal.#.exr", partial=True).files[5] == (5, None)


def test_companion_is_looked_for_beside_the_sequence_too(folder, monkeypatch):
    (folder / "n_0001.exr").touch()
    monkeypatch.chdir("/")
    main = find_sequence(folder / "frame_####.exr", frames="1")
    assert companion(main, "n_####.exr").files == ((1, str(folder / "n_0001.exr")),)


def test_companion_of_one_file_serves_all_frames(folder):
    (folder / "albedo.exr").touch()
    main = find_sequence(folder, frames="0-1")
    assert companion(main, "albedo.exr").files == ((0, "albedo.exr"), (1, "albedo.exr"))


def test_companion_that_is_not_there(folder):
    with pytest.raises(SvgfError, match=r"mormal_####\.exr: no such frames\. In .* there is frame_####"):
        companion(find_sequence(folder, frames="0-1"), "mormal_####.exr")


def test_the_real_folders(data):
    got = find_sequence(data / "cornell-dolly")
    assert numbers(got) == list(range(16))
    assert got.files[3][1] == str(data / "cornell-dolly" / "frame_0003.exr")
    assert len(find_sequence(data / "cornell-dolly", prefer=("ref",)).files) == 16
    assert len(find_sequence(data / "cornell-dolly" / "alt_####.exr").files) == 8
    for folder in (data / "games202-box", data / "games202-box" / "input"):
        assert find_sequence(folder).name == str(data / "games202-box" / "input" / "beauty_#.exr")
    with pytest.raises(SvgfError, match=r"several sequences are here: ID_#\.exr, beauty_#\.exr"):
        find_sequence(data / "games202-box", prefer=("ref",))
