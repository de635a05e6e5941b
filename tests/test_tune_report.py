"""The page about a fit, without fitting anything, and the words about it."""

import io
import re

import numpy as np
import pytest
from browser import opened

from svgf_jax import Config, Params
from svgf_jax.metrics import Scores
from tune import report
from tune.evaluate import Measured, worse
from tune.explore import Profile, Sensitivity, write_maps
from tune.fitting import Fit, Iteration
from tune.free import choose, to_free
from tune.knowledge import learn
from tune.report import write_report
from tune.shots import Shot
from tune.telling import Comparison, live


def made_fit():
    coordinates = choose(Params(), Config(), names=["alpha", "sigma_luminance[1]", "max_history"])
    y = to_free(coordinates.start, coordinates) + 0.1
    rng = np.random.default_rng(0)
    rows = np.column_stack([rng.normal(size=(500, 2)), np.zeros(500), 0.1 * rng.normal(size=500)])
    triangle = np.linalg.qr(rows, mode="r")
    knowledge = learn(triangle, np.zeros((3, 3)), 500, y, coordinates)
    trials = tuple(Iteration(0, i, 1.0 / (i + 1), i != 2, np.array([0.2, 4.0, 32.0]), 1.0) for i in range(4))
    return Fit(Params(), Config(), coordinates, y, 0.25, trials, True, "converged: <done>", knowledge, ("a note",))


def test_standard_errors_are_those_of_the_textbook():
    """Independent rows, known noise: the diagonal of sigma^2 (J'J)^-1; a column of zeros is undetermined."""
    coordinates = choose(Params(), Config(), names=["sigma_depth", "sigma_normal", "max_history"])
    y = to_free(coordinates.start, coordinates)
    rng = np.random.default_rng(1)
    jacobian = np.column_stack([rng.normal(size=4000), rng.normal(size=4000), np.zeros(4000)])
    jacobian[:, 1] += 3 * jacobian[:, 0]
    residual = 0.1 * rng.normal(size=4000)
    knowledge = learn(
        np.linalg.qr(np.column_stack([jacobian, residual]), mode="r"), np.zeros((3, 3)), 4000, y, coordinates
    )
    covariance = 0.01 * np.linalg.inv(jacobian[:, :2].T @ jacobian[:, :2])
    np.testing.assert_allclose(knowledge.relative_errors[:2], np.sqrt(np.diag(covariance)), rtol=0.05)
    assert knowledge.undetermined == ("max_history",)
    correlation = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
    assert knowledge.correlations[0, 1] == pytest.approx(correlation, rel=1e-6)
    assert np.isinf(knowledge.standard_errors[2])


def test_numbers_that_make_up_for_each_other_are_named():
    coordinates = choose(Params(), Config(), names=["sigma_depth", "depth_epsilon"])
    column = np.random.default_rng(0).normal(size=(300, 1))
    rows = np.hstack([column, column + 1e-3 * np.random.default_rng(1).normal(size=(300, 1)), 0.1 * column[::-1]])
    y = to_free(coordinates.start, coordinates)
    knowledge = learn(np.linalg.qr(rows, mode="r"), np.zeros((2, 2)), 300, y, coordinates)
    assert knowledge.entangled == (("sigma_depth", "depth_epsilon"),)


def test_the_page_holds_everything_and_escapes_it(tmp_path):
    fit = made_fit()
    maps = Sensitivity(np.ones((4, 6)), np.random.default_rng(0).normal(size=(3, 4, 6)))
    curve = Profile("alpha", np.array([0.1, 0.2, 0.4]), np.array([1.0, 0.5, 0.8]))
    page = tmp_path / "page.html"
    write_report(page, fit, Params(), Config(), [], [curve], maps, ["worse & worse"])
    text = page.read_text()
    told = ("converged: &lt;done&gt;", "worse &amp; worse", "a note", "undetermined")
    for wanted in (*told, "loss over log10 alpha", "data:image/png"):
        assert wanted in text
    assert 'src="http' not in text
    channels = write_maps(tmp_path / "maps", fit, maps)
    assert channels.name == "sensitivity.exr"


def told(shots, tmp_path, monkeypatch, compared=()):
    """What a browser shows of the page with pictures: `filtered` gives alpha of the parameters as grey."""

    def filtered(shot, params, config):
        grey = np.full((6, 9, 3), float(np.asarray(params.alpha).ravel()[0]), np.float32)
        return ((grey, np.full((6, 9, 3), 0.5, np.float32)) for _ in range(shot.length))

    monkeypatch.setattr(report, "filtered", filtered)
    maps = Sensitivity(np.ones((4, 6)), np.zeros((3, 4, 6)))
    page = tmp_path / "page.html"
    fit = made_fit()._replace(params=Params(alpha=0.4))
    write_report(page, fit, Params(alpha=0.1), Config(), compared, [], maps, [], shot=shots)
    look = (
        "[...document.querySelectorAll('.stage span')].map((span) => span.textContent).join('|') + number.textContent"
    )
    return page.read_text(), opened(page, tmp_path, script=f"document.body.dataset.told = {look}")


def test_a_second_render_alone_has_pictures_without_scores(tmp_path, monkeypatch):
    shot = Shot("twice", 3, lambda index: None, numbers=(11, 13, 17))
    text, dom = told(shot, tmp_path, monkeypatch)
    assert 'data-told="before|afterframe 13"' in dom
    assert '<option value="second render">' in text
    assert "No references were given" in text


def test_frames_are_numbered_as_in_the_files_and_errors_are_drawn(tmp_path, monkeypatch):
    shot = Shot("once", 3, lambda index: None, numbers=(11, 13, 17))
    before, after = (
        Measured("once", tuple(Scores(value + i, 0.1, 0.9, 0.1, float("nan")) for i in range(3)), mean, (11, 13, 17))
        for value, mean in ((30, Scores(31, 0.1, 0.9, 0.1, 0)), (32, Scores(33, 0.1, 0.9, 0.1, 0)))
    )
    text, dom = told(shot, tmp_path, monkeypatch, [Comparison("tuned", shot, before, after)])
    assert "<title>before 11: 30</title>" in text
    assert re.search(r'data-told="before: [\d.]+ dB\|after: [\d.]+ dBframe 13"', dom)
    bars = re.findall(r'<svg class="bar".*?</svg>', text)
    assert ["stroke-dasharray" in bar for bar in bars] == [False, False, True]
    for bar in bars[:2]:
        least, most = re.search(r'<line x1="([\d.]+)" x2="([\d.]+)" y1="9"', bar).groups()
        assert float(least) < float(most)
        assert "standard error" in bar
    assert "&plusmn;" not in text


def test_worse_is_worse():
    scores = [Measured("s", (), Scores(psnr, 0.0, 0.0, 0.0, 0.0)) for psnr in (40.0, 39.9, float("nan"))]
    assert worse(scores[1], scores[0]) is None
    assert "39.90" in str(worse(scores[0], scores[1], tolerance=0.05))
    assert worse(scores[0], scores[1], tolerance=0.2) is None
    assert worse(scores[0], scores[2]) is not None


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(("stream", "labels"), [(Terminal, 2), (Terminal, 9), (io.StringIO, 2)])
def test_every_trial_point_is_told_with_its_numbers(stream, labels, monkeypatch):
    """A table on a terminal, a line each elsewhere: which number is whose can be seen."""
    monkeypatch.setenv("COLUMNS", "110")
    monkeypatch.setattr("sys.stderr", told := stream())
    names = [f"number{i}" for i in range(labels)]
    with live(2, 24, names) as on_iteration:
        for i, accepted in enumerate((True, False)):
            on_iteration(Iteration(0, i, 1 - 0.25 * i, accepted, np.arange(labels) + 0.125, 1.0))
    text = told.getvalue()
    assert all(name in text for name in names)
    for wanted in ("2 sequences, 24 frames", "0.1", "0.75000", "accepted", "rejected", "0.125", "1.125"):
        assert wanted in text
