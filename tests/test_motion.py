"""Motion conventions: brought to the library's own, and found back by what they do to the guides."""

import numpy as np
import pytest

from svgf_jax import SvgfError, sample
from svgf_jax.cameras import reproject
from svgf_jax.frames import load_sequence, open_source, read_frame
from svgf_jax.motion import CONVENTIONS, Convention, convert, parse_convention
from svgf_jax.types import Frame
from svgf_jax.warping import FARTHEST, Step, find_convention, warp_residual

H, W = 30, 40


def scale(convention, width=W, height=H):
    """What pixels (x right, y down, previous - this) are multiplied by to become numbers of a convention."""
    unit = {"pixel": (1, 1), "fraction": (1 / width, 1 / height), "ndc": (2 / width, 2 / height)}[convention.unit]
    sign = {"to-previous": 1, "from-previous": -1, "to-next": -1, "from-next": 1}[convention.direction]
    return np.array([sign * unit[0], sign * unit[1] * (-1 if convention.y == "y-up" else 1)], np.float32)


@pytest.mark.parametrize(
    ("words", "stored", "pixels"),
    [
        ("pixel y-down to-previous", (3, -2), (3, -2)),
        ("pixel y-up to-previous", (3, -2), (3, 2)),
        ("pixel y-down from-previous", (3, -2), (-3, 2)),
        ("fraction y-down to-previous", (0.5, 0.1), (20, 3)),
        ("ndc y-up from-previous", (0.5, 0.2), (-10, 3)),
        ("pixel y-down from-next", (3, -2), (3, -2)),
        ("pixel y-up to-next", (3, -2), (-3, -2)),
    ],
)
def test_each_convention_by_hand(words, stored, pixels):
    field = np.broadcast_to(np.array(stored, np.float32), (H, W, 2))
    later = np.full_like(field, 7)
    convention = parse_convention(words)
    both = (later, field) if convention.from_frame_before else (field, later)
    found = convert(both[0], convention, motion_before=both[1])
    np.testing.assert_allclose(found, np.broadcast_to(pixels, found.shape), rtol=1e-6)
    assert found.dtype == np.float32


def test_a_crop_has_fractions_of_the_whole_picture():
    field = np.full((H, W, 2), 0.5, np.float32)
    assert convert(field, Convention("fraction"), size=(100, 60))[0, 0].tolist() == [50, 30]


def test_words_in_any_order_and_what_is_not_said_is_our_own():
    assert parse_convention("y-up, fraction") == Convention("fraction", "y-up", "to-previous")
    assert parse_convention("") == CONVENTIONS[0] == Convention()
    assert all(parse_convention(str(one)) == one for one in CONVENTIONS)
    assert len(set(CONVENTIONS)) == 24


@pytest.mark.parametrize(
    ("words", "message"),
    [("fraction up", "'up' is not known; wanted one each of pixel|fraction"), ("pixel ndc", "'ndc' comes after pixel")],
)
def test_words_that_mean_nothing(words, message):
    with pytest.raises(SvgfError, match=message):
        parse_convention(words)


def test_what_convert_cannot_do():
    field = np.zeros((H, W, 2), np.float32)
    with pytest.raises(SvgfError, match="cameras and positions"):
        convert(field, Convention("world"))
    with pytest.raises(SvgfError, match="pixel y-down to-next: wanted the motion vectors of the frame before"):
        convert(field, Convention(direction="to-next"))


def crop(x, y, *, texture=True, position=True):
    """A frame of a flat picture on a wall, seen through a window at (x, y) of it."""
    rng = np.random.default_rng(5)
    smooth = np.kron(rng.uniform(0.1, 0.9, (20, 24, 3)), np.ones((5, 5, 1))) if texture else np.full((100, 120, 3), 0.5)
    rows, columns = np.mgrid[y : y + H, x : x + W]
    place = np.stack([columns, rows, np.zeros_like(rows)], -1) * 0.01
    flat = np.zeros((H, W, 3), np.float32)
    return Frame(
        radiance=flat[None],
        albedo=smooth[None, y : y + H, x : x + W].astype(np.float32),
        emission=flat,
        normal=flat + np.array([0, 0, 1], np.float32),
        depth=np.full((H, W), 4, np.float32),
        prev_depth=np.full((H, W), 4, np.float32),
        motion=flat[..., :2],
        object_id=np.ones((H, W), np.int32),
        position=place.astype(np.float32) if position else None,
    )


def moved(dx, dy):
    """Motion of the wall when the window went by (dx, dy)."""
    return np.broadcast_to(np.array([dx, dy], np.float32), (H, W, 2))


def test_the_residual_is_the_distance_in_pixels():
    pair = crop(27, 31), crop(30, 30)
    for off in (0.0, 0.25, 1.5):
        found = warp_residual(*pair, moved(3 + off, -1))
        assert found.pixels == pytest.approx(off, abs=1e-3)
        assert found.guides == ("position",)
    assert found.judged == H * W
    far = warp_residual(*pair, moved(100, 0))
    assert (far.pixels, far.share) == (FARTHEST, 0)
    assert np.isnan(warp_residual(*pair, moved(0, 0)).pixels)  # nothing moves


def test_without_positions_the_other_guides_tell():
    pair = crop(27, 31, position=False), crop(30, 30, position=False)
    right, wrong = (warp_residual(*pair, moved(dx, -1)).pixels for dx in (3, -3))
    assert warp_residual(*pair, moved(3, -1)).guides == ("albedo",)  # normals, depths and ids are the same everywhere
    assert 4 * right < wrong


@pytest.mark.parametrize("position", [True, False])
@pytest.mark.parametrize("truth", CONVENTIONS, ids=str)
def test_every_convention_is_found_back(truth, position):
    """The window goes by (3, -1), then (2, 1), then (3, 0), so that no direction in time is like another."""
    frames = [crop(x, y, position=position) for x, y in ((25, 30), (28, 29), (30, 30))]
    to_previous = [moved(0, 2), moved(3, -1), moved(2, 1), moved(3, 0)]  # by frame; the last one's is not looked at
    later = truth.from_frame_before
    stored = [to_previous[number + later] * scale(truth) for number in range(3)]
    steps = [Step(frames[i], frames[i + 1], stored[i + 1], stored[i]) for i in (0, 1)]
    assert find_convention(steps).fits == (truth,)


def test_a_pan_does_not_tell_where_y_points():
    step = Step(crop(27, 30), crop(30, 30), moved(3, 0))
    assert find_convention([step]).fits == (Convention(), Convention(y="y-up"))


def test_nothing_fits():
    still = Step(crop(30, 30), crop(30, 30), moved(1, 2))
    assert find_convention([still]).fits == ()  # no motion at all is better
    blank = Step(crop(27, 30, texture=False, position=False), crop(30, 30, texture=False, position=False), moved(3, 1))
    assert find_convention([blank]).fits == ()
    assert find_convention([Step(crop(30, 30), crop(30, 30), moved(np.nan, np.nan))]).fits == ()


@pytest.mark.parametrize("truth", [CONVENTIONS[i] for i in (0, 3, 9, 10, 17)], ids=str)
def test_on_the_bundled_sample_without_positions(truth, two_frames):
    before, now = (frame._replace(position=None) for frame in two_frames[1:])
    factor = scale(truth, *now.depth.shape[::-1])
    step = Step(before, now, now.motion * factor, before.motion * factor)
    assert find_convention([step]).fits == (truth,)


@pytest.fixture(scope="module")
def two_frames():
    source = open_source(sample(), position=True)
    return source, read_frame(source, 4).frame, read_frame(source, 5).frame


def test_vectors_to_the_next_frame_on_the_bundled_sample(two_frames):
    source, before, now = two_frames
    forward = reproject(source.cameras, before.depth, before.object_id, number=4, previous=5)[1]  # where frame 4 goes
    found = convert(now.motion, Convention(direction="to-next"), motion_before=forward)
    near = np.abs(found - now.motion).max(-1)[now.object_id != -1]
    assert np.median(near) < 0.02
    step = Step(before, now, forward, forward)
    assert find_convention([step]).fits == (Convention(direction="to-next"),)


def test_on_a_real_sequence_with_positions(data):
    frames = load_sequence(data / "cornell-dolly", frames="7-8", position=True)
    before, now = (Frame(*(None if leaf is None else leaf[i] for leaf in frames)) for i in (0, 1))
    right = warp_residual(before, now, now.motion)
    assert right.pixels < 0.01
    assert right.share > 0.95
    verdict = find_convention([Step(before, now, now.motion, before.motion)])
    assert verdict.fits == (Convention(),)
    assert verdict.residuals[None].pixels > 1
