"""What must not mislead a fit: targets of something else, and checkpoints of another fit. NumPy only."""

import json
import re

import numpy as np
import pytest

from svgf_jax import SvgfError
from svgf_jax.demo import sample
from tune import checkpoint, fitting, solver
from tune.shots import Example, Shot, shot_of_files
from tune.targets import doubts, likeness, with_doubts


@pytest.fixture(scope="module")
def shot():
    """Five frames of the bundled sample, read once."""
    shot = shot_of_files(str(sample()), str(sample()), frames="0-4")
    examples = [shot.read(i) for i in range(shot.length)]
    return shot._replace(read=lambda i: examples[i])


def changed(shot, change):
    """The shot with `change(target, index)` for its targets."""
    return shot._replace(read=lambda i: Example(shot.read(i).frame, change(shot.read(i).target, i)))


def test_references_are_like_their_frames_whatever_the_noise(shot):
    found = likeness(shot)
    assert found.correlation > 0.99
    assert found.slope == pytest.approx(1, abs=0.02)
    assert found.ratio == pytest.approx(1, abs=0.01)
    assert found[3:] == ((0, 0), 0, 0, "")
    assert doubts("shot", found) == ()


def test_fireflies_in_the_frames_say_nothing_about_their_targets(shot):
    def struck(index):
        frame, target = shot.read(index)
        radiance = np.array(frame.radiance)
        radiance[0, 20 * index + 3, 5:105:20] = 10.0 ** (2 + 8 * index)
        return Example(frame._replace(radiance=radiance), target)

    found = likeness(shot._replace(read=struck))
    assert found.ratio == pytest.approx(1, abs=0.01)
    assert doubts("s", found) == ()
    brighter = likeness(changed(shot._replace(read=struck), lambda t, _: 2 * t))
    assert brighter.ratio == pytest.approx(2, abs=0.02)  # nor do they hide it


def test_of_fireflies_everywhere_no_brightness_is_told(shot):
    def struck(index):
        frame, target = shot.read(index)
        radiance = np.array(frame.radiance)
        radiance[0, 8::32, 8::16] = 1e6
        return Example(frame._replace(radiance=radiance), target)

    found = likeness(shot._replace(read=struck))
    assert np.isnan(found.ratio)
    assert doubts("s", found) == ()


def test_noise_that_is_mostly_fireflies_does_not_make_its_targets_look_brighter(shot):
    def struck(index):
        frame, target = shot.read(index)
        light = target * np.random.default_rng(index).lognormal(-3.125, 2.5, (*target.shape[:2], 1))
        return Example(frame._replace(radiance=light[None], emission=0 * frame.emission), target)

    found = likeness(shot._replace(read=struck))
    assert found.ratio == pytest.approx(1, abs=0.1)
    assert doubts("s", found) == ()


def noisy_again(shot):
    """The targets with independent noise as large as that of one sample a pixel."""
    rng = np.random.default_rng(0)
    return changed(shot, lambda t, _: t * rng.gamma(0.5, 2.0, (*t.shape[:2], 1)))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t, i, ts: np.roll(t, (-3, 2), (0, 1)), "fit best moved by -2 pixels in x and 3 in y"),
        (lambda t, i, ts: np.roll(t, 1, 1), "fit best moved by -1 pixels in x and 0 in y"),
        (lambda t, i, ts: ts(i + 1), "fit best moved by"),
        (lambda t, i, ts: t[::-1, ::-1], "do not look like the frames"),
        (lambda t, i, ts: np.maximum(t, 0) ** (1 / 2.2), "to the power of 0.4"),
        (lambda t, i, ts: np.round(255 * np.clip(t, 0, 1) ** (1 / 2.2)) / 255, "to the power of 0.4"),
        (lambda t, i, ts: 2 * t, "2.00 times as bright"),
    ],
    ids=["shifted", "by one pixel", "of the next frame", "of another shot", "gamma", "8 bits", "exposure"],
)
def test_targets_of_something_else_are_told(shot, change, said):
    later = shot_of_files(str(sample()), str(sample()), frames="1-5")
    (told,) = doubts("s", likeness(changed(shot, lambda t, i: change(t, i, lambda n: later.read(n - 1).target))))
    assert said in told


def test_a_second_noisy_render_is_as_good_as_a_reference(shot):
    assert doubts("s", likeness(noisy_again(shot))) == ()
    (told,) = doubts("s", likeness(noisy_again(changed(shot, lambda t, i: np.roll(t, 3, 0)))))
    assert "in x and -3 in y" in told


def test_of_a_wall_and_its_noise_nothing_can_be_told():
    """Block means hold nothing by which two pictures could be alike."""
    rng = np.random.default_rng(1)
    like = shot_of_files(str(sample()), str(sample()), frames="0").read(0).frame
    frame = like._replace(radiance=rng.gamma(0.5, 2.0, like.radiance.shape), emission=0 * like.emission)
    found = likeness(Shot("wall", 1, lambda i: Example(frame, 2 + rng.normal(0, 0.01, frame.emission.shape))))
    assert np.isnan(found.correlation)
    assert found.displacement == (0, 0)
    (told,) = doubts("wall", found)
    assert told == "wall: whether the targets belong to the frames cannot be told: the frames are mostly noise"
    nothing = likeness(Shot("none", 1, lambda i: Example(frame, None)))
    assert doubts("none", nothing) == ()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: 0 * t, "all pixels of the targets are 0"),
        (lambda t: 0 * t + 0.5, "all pixels of the targets are 0.5"),
        (lambda t: 0.5 + 1e-3 * t, "the targets have no contrast"),
        (
            lambda t: np.where(np.arange(len(t))[:, None, None] < 80, 0, t),
            r"light is in \d\d blocks of 16 x 16 pixels of both",
        ),
    ],
    ids=["black", "grey", "pale", "mostly black"],
)
def test_where_targets_say_nothing_that_is_told(shot, change, said):
    found = likeness(changed(shot, lambda t, i: change(t))._replace(length=1))
    assert np.isnan(found.correlation)
    first, *others = doubts("s", found)
    assert re.match(f"s: whether the targets belong to the frames cannot be told: {said}", first)
    assert all("times as bright" in other or "move" in other for other in others)


def test_pixels_that_are_not_finite_are_counted(shot):
    def holed(index):
        frame, target = shot.read(index)
        radiance, target = np.array(frame.radiance), np.array(target)
        radiance[0, 3, 4:6, 0] = np.nan
        target[5, 7:10] = np.inf
        return Example(frame._replace(radiance=radiance), target if index else np.full_like(target, np.nan))

    height, width = shot.read(0).frame.depth.shape
    notes = with_doubts(shot._replace(read=holed, notes=("a",))).notes
    assert notes[0] == "a"
    assert "10 pixels of the frames are not finite" in notes[1]
    assert f"{12 + height * width} pixels of the targets are not finite" in notes[2]
    assert len(notes) == 3


IDENTITY = {
    "files": [["a.exr", 100, 1], ["b.exr", 100, 2]],
    "numbers": ["0.2", "4.0"],
    "tune": ["alpha"],
    "versions": {"jax": "0.10", "svgf_jax": "1"},
}


def stored(path, **header):
    header = {"format": checkpoint.FORMAT, "identity": IDENTITY} | header
    np.savez(path, header=np.array(json.dumps(header)), trials=np.zeros((0, 5)), values=np.zeros((0, 1)))


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ({"format": 1}, "another version of svgf-tune"),
        (
            {"identity": IDENTITY | {"files": [["a.exr", 100, 1], ["b.exr", 100, 3]]}},
            r"its files was \['b.exr', 100, 3\]",
        ),
        ({"identity": IDENTITY | {"files": [["a.exr", 100, 1]]}}, "its files was"),
        ({"identity": IDENTITY | {"numbers": ["0.2", "5.0"]}}, "its numbers was '5.0', now it is '4.0'"),
        ({"identity": IDENTITY | {"tune": ["alpha", "sigma_normal"]}}, "its tune was"),
        ({"identity": IDENTITY | {"versions": {"jax": "0.9", "svgf_jax": "1"}}}, "its versions was"),
        ({"identity": {}}, "its files was None"),
        ({"identity": None}, "damaged"),
        ({"identity": [1]}, "damaged"),
        ({"start": 0}, "damaged"),
    ],
    ids=str,
)
def test_a_checkpoint_of_another_fit_is_refused(header, said, tmp_path):
    path = tmp_path / "c.npz"
    stored(path, **header)
    with pytest.raises(SvgfError, match=said):
        checkpoint.load(path, None, IDENTITY)


def test_a_checkpoint_that_is_something_else_is_refused(tmp_path):
    path = tmp_path / "c.npz"
    for content in (b"", b"PK\x03\x04", b"\x93NUMPY\x01\x00v\x00", b"{}"):
        path.write_bytes(content)
        with pytest.raises(SvgfError, match="damaged"):
            checkpoint.load(path, None, IDENTITY)
    np.savez(path, header=np.array({"format": checkpoint.FORMAT}, dtype=object))  # would be unpickled
    with pytest.raises(SvgfError, match="damaged"):
        checkpoint.load(path, None, IDENTITY)


def a_fit(n=2):
    """A descent just begun and its progress after one trial point."""
    fresh = solver.begin(solver.make_solver("lm"), np.zeros(n))
    trial = fitting.Iteration(0, 0, 1.0, True, np.ones(n), 1.0)
    found = (np.eye(n + 1), np.eye(n), 7)
    return fresh, fitting.Progress(0, fresh, (trial,), 1.0, np.zeros(n), 1.0, found, None, np.ones(1))


def test_numbers_of_a_checkpoint_that_are_wrong_are_refused(tmp_path):
    path, bad = tmp_path / "c.npz", tmp_path / "bad.npz"
    fresh, progress = a_fit()
    checkpoint.save(path, progress, IDENTITY)
    assert checkpoint.load(path, fresh, IDENTITY).best_loss == 1.0
    with np.load(path) as file:
        good = dict(file)
    header = json.loads(str(good["header"]))
    wrong = [
        ({"best_y": np.array([0.0, np.nan])}, "best_y is not finite"),
        ({"losses": np.array([np.nan, 1.0])}, "losses has numbers below 0, or that are none"),
        ({"losses": np.array([1.0, np.inf])}, "a best loss of inf"),
        ({"losses": np.array([1.0, -1.0])}, "losses has numbers below 0"),
        ({"state0": np.full(2, np.inf)}, "state0 is not finite"),
        ({"state2": np.zeros(3)}, "state2 is float64"),
        ({"state1": np.zeros(())}, "state1 is float64"),
        ({"triangle": np.eye(2)}, "triangle is"),
        ({"rows": np.array(0)}, "rows has numbers below 1"),
        ({"more": np.zeros(1)}, "it holds best_y"),
        ({"header": np.array(json.dumps(header | {"start": -1}))}, "start -1"),
        ({"header": np.array(json.dumps(header | {"endings": [1], "start": 1}))}, "endings"),
        ({"header": np.array("[" * 100_000)}, "recursion"),
    ]
    for change, said in wrong:
        np.savez(bad, **(good | change))
        with pytest.raises(SvgfError, match=f"damaged.*{said}"):
            checkpoint.load(bad, fresh, IDENTITY)
    for at, value in ((6, 1), (8, 99)):  # encrypted; a method of compression that nobody knows
        data = bytearray(path.read_bytes())
        data[at], data[data.index(b"PK\x01\x02") + at + 2] = value, value
        bad.write_bytes(data)
        with pytest.raises(SvgfError, match="damaged"):
            checkpoint.load(bad, fresh, IDENTITY)
    checkpoint.save(path, a_fit(3)[1], IDENTITY)
    with pytest.raises(SvgfError, match="damaged"):
        checkpoint.load(path, fresh, IDENTITY)
