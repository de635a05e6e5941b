import sys

import numpy as np
import pytest
from PIL import Image

from svgf_jax import preview, tonemapping
from svgf_jax.types import SvgfError


def test_tonemap_goes_from_black_to_white_monotonically():
    ramp = np.repeat(np.linspace(-1, 6, 400, dtype=np.float32)[None, :, None], 3, 2)
    shown = preview.to_8bit(ramp)
    assert shown.dtype == np.uint8
    assert shown.shape == (1, 400, 3)
    assert (np.diff(shown[0, :, 0].astype(int)) >= 0).all()
    assert (shown[ramp <= 0] == 0).all()
    assert (shown[ramp >= tonemapping.WHITE] == 255).all()


def test_tonemap_of_a_hand_computed_value():
    curve = 0.5 * (1 + 0.5 / 16) / 1.5
    assert preview.to_8bit(np.full((1, 1, 3), 0.25), exposure=2.0)[0, 0, 0] == round(
        255 * (1.055 * curve ** (1 / 2.4) - 0.055)
    )


def test_tonemap_survives_anything():
    image = np.array([[[np.nan, np.inf, -np.inf]]])
    assert preview.to_8bit(image, exposure=3.0).tolist() == [[[0, 255, 0]]]


@pytest.mark.parametrize("exposure", [0, -1, np.nan, np.inf])
def test_tonemap_refuses_a_senseless_exposure(exposure):
    with pytest.raises(SvgfError, match="exposure"):
        preview.to_8bit(np.zeros((1, 1, 3)), exposure=exposure)


def test_side_by_side_keeps_the_pictures_and_draws_labels():
    red, blue = np.zeros((40, 60, 3), np.uint8), np.zeros((40, 30, 3), np.uint8)
    red[..., 0], blue[..., 2] = 255, 255
    picture = preview.side_by_side([("before", red), ("after", blue)])
    assert picture.shape[1] == 92
    np.testing.assert_array_equal(picture[-40:, :60], red)
    np.testing.assert_array_equal(picture[-40:, -30:], blue)
    assert (picture[:-40] > 128).any()


def test_side_by_side_wants_one_height():
    with pytest.raises(SvgfError, match="one height"):
        preview.side_by_side([("a", np.zeros((4, 4, 3), np.uint8)), ("b", np.zeros((5, 4, 3), np.uint8))])


def test_png_round_trip_leaves_nothing_else_behind(tmp_path):
    picture = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    preview.write_png(tmp_path / "a.png", picture)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), picture)
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


def test_unwritable_folder_is_a_clear_error(tmp_path):
    with pytest.raises(SvgfError, match=r"Could not write .*nowhere"):
        preview.write_png(tmp_path / "nowhere" / "a.png", np.zeros((2, 2, 3), np.uint8))


def test_video_holds_all_frames_and_pads_odd_sizes(tmp_path):
    av = pytest.importorskip("av")
    pictures = (np.full((31, 45, 3), 20 * i, np.uint8) for i in range(6))
    preview.write_video(tmp_path / "a.mp4", pictures, fps=12)
    with av.open(str(tmp_path / "a.mp4")) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 6
    assert frames[0].shape == (32, 46, 3)
    assert abs(float(frames[5].mean()) - 100) < 4
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


def test_a_video_keeps_its_frame_rate_and_says_what_its_colours_mean(tmp_path):
    av = pytest.importorskip("av")
    picture = np.broadcast_to(np.array([200, 40, 0], np.uint8), (32, 32, 3))
    preview.write_video(tmp_path / "a.mp4", [picture] * 3, fps=23.976)
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert float(container.streams.video[0].average_rate) == pytest.approx(23.976, abs=1e-3)
        frame = next(container.decode(video=0))
    assert (int(frame.colorspace), int(frame.color_range)) == (1, 1)
    shown = frame.reformat(format="rgb24", src_colorspace="ITU709").to_ndarray()
    assert np.abs(shown.astype(int) - picture).max() <= 3


@pytest.mark.parametrize("fps", [0, -1, np.nan, np.inf])
def test_a_senseless_frame_rate_is_refused(tmp_path, fps):
    pytest.importorskip("av")
    with pytest.raises(SvgfError, match="frames per second"):
        preview.write_video(tmp_path / "a.mp4", [np.zeros((8, 8, 3), np.uint8)], fps=fps)


def test_video_of_nothing_or_nowhere_is_a_clear_error(tmp_path):
    pytest.importorskip("av")
    with pytest.raises(SvgfError, match="no picture"):
        preview.write_video(tmp_path / "a.mp4", [])
    with pytest.raises(SvgfError, match="Could not write"):
        preview.write_video(tmp_path / "nowhere" / "a.mp4", [np.zeros((8, 8, 3), np.uint8)])
    assert not list(tmp_path.iterdir())


def test_video_without_its_package_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(SvgfError, match=r"svgf-jax\[video\]"):
        preview.require_video()
