"""Videos out of sequences: made, and decoded again."""

import numpy as np
import pytest
from PIL import Image, ImageSequence

from svgf_jax import SvgfError, exr, preview
from svgf_jax.cli import main
from svgf_jax.film import make_film

HEIGHT, WIDTH = 35, 61  # odd
GREY, RED = (0.2, 0.2, 0.2), (0.9, 0.05, 0.02)


def put(folder, color, numbers=range(6)):
    folder.mkdir()
    for number in numbers:
        value = np.asarray(color) * (1 + 0.4 * number)
        image = exr.new_image({c: np.full((HEIGHT, WIDTH), v, np.float32) for c, v in zip("RGB", value, strict=True)})
        exr.write(folder / f"frame_{number:04d}.exr", image)
    return str(folder)


@pytest.fixture
def shots(tmp_path):
    return [put(tmp_path / "noisy", GREY), put(tmp_path / "clean", RED, range(1, 9))]


def shown(color, number):
    return preview.to_8bit(np.asarray(color).reshape(1, 1, 3) * (1 + 0.4 * number))[0, 0].astype(int)


def test_an_mp4_decodes_to_what_went_in(shots, tmp_path):
    """Frames 1 to 5, side by side: size, rate, spacing, tags of the colours, and the colours themselves."""
    av = pytest.importorskip("av")
    out = tmp_path / "a.mp4"
    assert make_film(shots, out, labels=["before", "after"], fps=30000 / 1001) == (5, pytest.approx(29.97, abs=1e-3))
    with av.open(str(out)) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        assert float(stream.average_rate) == pytest.approx(30000 / 1001, rel=1e-6)
        assert context.pix_fmt == "yuv420p"
        tags = (context.colorspace, context.color_primaries, context.color_trc, context.color_range)
        assert tuple(map(int, tags)) == (1, 1, 13, 1)  # BT.709 with the sRGB curve, limited range
        frames = list(container.decode(stream))
    times = np.array([float(frame.pts * frame.time_base) for frame in frames])
    np.testing.assert_allclose(np.diff(times), 1001 / 30000, rtol=1e-3)
    assert len(frames) == 5
    for number, frame in enumerate(frames, start=1):
        picture = frame.reformat(format="rgb24", src_colorspace="ITU709").to_ndarray().astype(int)
        assert picture.shape[0] % 2 == picture.shape[1] % 2 == 0
        assert np.abs(picture[-20, 20] - shown(GREY, number)).max() <= 3
        assert np.abs(picture[-20, -20] - shown(RED, number)).max() <= 4


@pytest.mark.parametrize(("kind", "slack"), [("gif", 2), ("webp", 6)])
def test_an_animation_decodes_to_what_went_in(shots, tmp_path, kind, slack):
    out = tmp_path / f"a.{kind}"
    count, rate = make_film(shots, out, layout="split", split=0.25, fps=24)
    assert count == 5
    assert rate == pytest.approx(1000 / (40 if kind == "gif" else 42))
    with Image.open(out) as film:
        assert (film.size, film.n_frames, film.info["loop"]) == ((WIDTH, HEIGHT), 5, 0)
        for number, frame in enumerate(ImageSequence.Iterator(film), start=1):
            picture = np.asarray(frame.convert("RGB")).astype(int)
            assert frame.info["duration"] == round(1000 / rate)
            assert np.abs(picture[-4, 5] - shown(GREY, number)).max() <= slack
            assert np.abs(picture[-4, 40] - shown(RED, number)).max() <= slack


def test_a_split_screen_shows_each_picture_in_its_stripe():
    black, white = np.zeros((40, 90, 3), np.uint8), np.full((40, 90, 3), 255, np.uint8)
    thirds = preview.split_screen([("", black), ("", white), ("", black)])
    assert [int(thirds[-1, x, 0]) for x in (10, 45, 80)] == [0, 255, 0]
    at = preview.split_screen([("", black), ("", white)], position=0.8)
    assert (at[:, :71] == 0).all()
    assert (at[:, 74:] == 255).all()
    labelled = preview.split_screen([("left", black), ("a label without room", white)], position=0.8)
    assert (labelled[:25, :70] > 200).any()
    assert (labelled[:, 74:] == 255).all()
    with pytest.raises(SvgfError, match="two of them"):
        preview.split_screen([("", black)] * 3, position=0.5)


def test_a_moving_split_goes_there_and_back(shots, tmp_path):
    make_film(shots, tmp_path / "a.webp", layout="split", split="moving", labels=["", ""])
    with Image.open(tmp_path / "a.webp") as film:
        frames = [np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(film)]
    left = [int((f[-4, :, 0] - f[-4, :, 2] < 60).sum()) for f in frames]  # grey pixels
    assert left[0] < left[1] < left[2]
    assert left[4] < left[3]


WRONG = {
    "no sequence": ([], {}, "nothing to show"),
    "suffix": (["A"], {"out": "a.avi"}, r"ends in \.mp4, \.gif, \.webp"),
    "labels": (["A", "B"], {"labels": ["one"]}, "one for each"),
    "layout": (["A"], {"layout": "pile"}, "wanted side or split"),
    "split of three": (["A", "B", "A"], {"layout": "split", "split": 0.5}, "with two sequences"),
    "split side by side": (["A", "B"], {"split": 0.5}, "with two sequences"),
    "split outside": (["A", "B"], {"layout": "split", "split": "1.5"}, "from 0 to 1"),
    "split in words": (["A", "B"], {"layout": "split", "split": "middle"}, "from 0 to 1"),
    "scale": (["A"], {"scale": 0}, "from 1 to 16"),
    "rate": (["A"], {"fps": 0}, "frames per second"),
    "exposure": (["A"], {"exposure": -1}, "exposure"),
    "curve": (["A"], {"curve": "filmic"}, "no tone curve"),
    "no common frame": (["A", "C"], {}, "no frame number in common"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_is_told_and_leaves_nothing(shots, tmp_path, case):
    inputs, options, message = WRONG[case]
    places = dict(zip("AB", shots, strict=True)) | {"C": put(tmp_path / "far", GREY, range(90, 92))}
    options = dict(options)
    out = tmp_path / options.pop("out", "a.gif")
    with pytest.raises(SvgfError, match=message):
        make_film([places[name] for name in inputs], out, **options)
    assert not list(tmp_path.glob("*a.*"))


def test_the_command(shots, tmp_path, capsys):
    out = tmp_path / "a.gif"
    with pytest.raises(SystemExit) as code:
        main(["video", *shots, "-o", str(out), "--labels", "before,after", "--scale", "2", "--fps", "10"])
    assert code.value.code == 0
    assert "5 frames at 10 a second" in capsys.readouterr().err
    with Image.open(out) as film:
        assert film.size[0] == 2 * 2 * WIDTH + 2
    with pytest.raises(SystemExit) as code:
        main(["video", shots[0], "-o", str(out)])
    assert code.value.code == 2
    assert "exists already" in capsys.readouterr().err
