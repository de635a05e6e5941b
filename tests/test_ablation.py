"""The table of what each part is worth: its rows change what they say, its numbers are those of the metrics."""

import csv
import json

import jax
import numpy as np
import pytest
import shots
from bridge import jitted_denoise
from calling import command, observed
from test_api import frame_of_zeros

from svgf_jax import SvgfError, ablation, load_sequence, metrics, open_source, preset, read_radiance
from svgf_jax.commands import ablate as ablate_command
from svgf_jax.comparison import compare_sequences
from svgf_jax.metrics import Scores
from svgf_jax.parameters import PRESETS
from svgf_jax.references import pair_references

ROWS = {row.name: row for row in ablation.ROWS}
NUMBERS = [1, 2, 3]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three noisy frames in `in`, and in `ref` something else of the same size."""
    folder = tmp_path_factory.mktemp("ablation")
    shots.write_shot(folder / "in", NUMBERS, layers=False)
    (folder / "ref").mkdir()
    for number in NUMBERS:
        shots.write_frame(folder / "ref" / f"ref_{number:04d}.exr", number + 10, layers=False)
    return folder


def targets(folder):
    return [read_radiance(folder / "ref" / f"ref_{number:04d}.exr") for number in NUMBERS]


# The rows


@pytest.mark.parametrize("name", PRESETS)
def test_the_rows_differ_from_any_base_in_what_they_say(name):
    params, config = preset(name)
    base = params._asdict() | config._asdict()
    for row in ablation.grid(params, config):
        changed_params, changed_config = ablation.settings_of(row, params, config)
        changed = changed_params._asdict() | changed_config._asdict()
        differs = {
            key
            for key, value in changed.items()
            if not np.array_equal(value, base[key]) and not (key not in row.changes and "levels" in row.changes)
        }
        assert differs <= row.changes.keys()
        assert differs or row.alter, row.name
        assert all(np.array_equal(changed[key], value) for key, value in row.changes.items())
    missing = ROWS.keys() - {row.name for row in ablation.grid(params, config)}
    assert f"levels-{config.levels}" in missing
    assert ("no-light" in missing) == (name != "adaptive")


def test_levels_cut_or_repeat_what_is_per_level():
    params, config = preset("tuned")
    fewer, _ = ablation.settings_of(ROWS["levels-2"], params, config)
    np.testing.assert_array_equal(fewer.sigma_normal, params.sigma_normal[:2])
    more, _ = ablation.settings_of(ROWS["levels-5"], fewer, config._replace(levels=2))
    np.testing.assert_array_equal(more.sigma_normal, params.sigma_normal[[0, 1, 1, 1, 1]])
    none, _ = ablation.settings_of(ROWS["levels-0"], params, config)
    assert float(none.sigma_normal) == params.sigma_normal[0]


def test_what_frames_do_not_have_cannot_be_left_out():
    names = {row.name for row in ablation.grid(*preset("paper"), signals=1, albedo=False)}
    assert not names & {"one-signal", "no-demodulation"}
    assert "no-history" in names


def test_altered_frames():
    rng = np.random.default_rng(0)
    frame = frame_of_zeros(signals=2)
    frame = frame._replace(radiance=rng.random(frame.radiance.shape, np.float32), variance=rng.random((2, 3, 4)))
    frame.variance[1, 0, 0] = -1
    one = ROWS["one-signal"].alter(frame)
    np.testing.assert_array_equal(one.radiance, frame.radiance[:1] + frame.radiance[1:])
    wanted = frame.variance.sum(0)
    wanted[0, 0] = -1
    np.testing.assert_array_equal(one.variance, wanted[None])
    np.testing.assert_array_equal(one.albedo, frame.albedo)
    plain = ROWS["no-demodulation"].alter(frame)
    assert (plain.albedo == 1).all()
    assert plain.radiance is frame.radiance
    alone = ROWS["no-history"].alter(frame)
    assert (np.abs(alone.motion) > 1e5).all()
    on_surface = frame._replace(reflected_motion=None, reflected_prev_depth=None, longest_history=None)
    assert alone._replace(motion=frame.motion) == on_surface


def test_rows_are_chosen_by_name_or_pattern():
    there = ablation.grid(*preset("paper"))
    assert ablation.choose_rows([], there) == there
    assert [row.name for row in ablation.choose_rows(["levels-[12]", "nearest"], there)] == [
        "nearest",
        "levels-1",
        "levels-2",
    ]
    with pytest.raises(SvgfError, match="no row 'no-histroy'; there are unfiltered, .* Did you mean no-history?"):
        ablation.choose_rows(["no-histroy"], there)
    with pytest.raises(SvgfError, match="row levels-5 changes nothing here"):
        ablation.choose_rows(["levels-5"], there)


# The measuring


def test_frames_without_a_reference_count_for_nothing(folder):
    """A filter simple enough to predict; its first frame is filtered a second time, for the clock alone."""
    source = open_source(folder / "in")
    references, told = pair_references(source.sequence, folder / "ref" / "ref_0003.exr")
    assert "lacks frames 1-2" in told[0]
    seen = []
    base, unfiltered = ablation.ablate(
        source,
        references,
        rows=[ROWS["unfiltered"]],
        pipeline=(shots.init, shots.step),
        on_frame=lambda row, number: seen.append((row.name, number)),
    )
    assert seen == [(name, number) for name in ("base", "unfiltered") for number in NUMBERS]
    frames = load_sequence(folder / "in")
    light = frames.radiance.sum(1)
    mean = light[0]
    for frame in light[1:]:
        mean = 0.8 * mean + 0.2 * frame
    wanted = targets(folder)[2]
    assert base.scores.psnr == pytest.approx(metrics.psnr(mean + frames.emission[2], wanted), rel=1e-5)
    assert unfiltered.scores.psnr == pytest.approx(metrics.psnr(light[2] + frames.emission[2], wanted), rel=1e-5)
    assert np.isnan(base.scores.temporal)
    assert base.seconds > 0


def test_the_command_prints_and_saves_the_table(folder, tmp_path):
    """Rows that the filter, and the noisy frames, give by other ways too."""
    files = {kind: tmp_path / f"table.{kind}" for kind in ("json", "csv", "markdown")}
    saves = [text for kind, path in files.items() for text in (f"--{kind}", path)]
    base = ("--set", "levels=0", "--set", "luminance_epsilon=0.1")
    only = ("--only", "levels-1,unfiltered")
    done = command("ablate", "in", "--reference", "ref", *base, *only, *saves, cwd=folder)
    assert done.returncode == 0, done.stderr
    report = json.loads(files["json"].read_text())
    assert (report["frames"], report["config"]["levels"]) == (3, 0)
    rows = {row["name"]: row for row in report["rows"]}
    assert list(rows) == ["base", "unfiltered", "levels-1"]

    params, config = preset("paper")
    params = jax.tree.map(np.float32, params._replace(luminance_epsilon=0.1))
    frames = load_sequence(folder / "in")
    _, output = jitted_denoise(config._replace(levels=1))(frames, params=params)
    images = zip(np.asarray(output.image), targets(folder), strict=True)
    noisy = [score for _, score in compare_sequences(folder / "in", folder / "ref")]
    for name, scores in (("levels-1", metrics.score_frames(images)), ("unfiltered", noisy)):
        wanted = metrics.mean_scores(scores)
        for field in ("psnr", "relmse", "temporal"):
            assert rows[name][field] == pytest.approx(getattr(wanted, field), rel=1e-4), (name, field)
    assert len({row["psnr"] for row in rows.values()}) == 3

    lines = {line.split()[0]: line.split() for line in done.stdout.splitlines() if line.strip()}
    assert lines["base"][1] == f"{rows['base']['psnr']:.2f}"
    change = rows["levels-1"]["psnr"] - rows["base"]["psnr"]
    assert lines["levels-1"][1:3] == [f"{rows['levels-1']['psnr']:.2f}", f"{change:+.2f}"]
    assert rows["levels-1"]["against_base"]["psnr"] == pytest.approx(change)
    percent = 100 * (rows["unfiltered"]["temporal"] / rows["base"]["temporal"] - 1)
    assert lines["unfiltered"][7:9] == [f"{percent:+.0f}", "%"]
    with files["csv"].open() as file:
        assert [float(row["psnr"]) for row in csv.DictReader(file)] == [row["psnr"] for row in rows.values()]
    assert f"| levels-1 | {rows['levels-1']['psnr']:.2f} ({change:+.2f}) |" in files["markdown"].read_text()
    assert "3 of 3: levels-1: PSNR" in done.stderr


def test_an_interruption_shows_the_rows_that_are_done(folder, tmp_path, monkeypatch, capsys):
    def interrupted(source, references, *, rows, **_):
        yield ablation.Measured(ablation.BASE, Scores(30.0, 0.1, 0.9, 0.02, np.nan), 0.5)
        yield ablation.Measured(rows[0], Scores(np.inf, 0.0, 0.9, np.nan, np.nan), 0.25)
        raise KeyboardInterrupt

    monkeypatch.setattr(ablation, "ablate", interrupted)
    report = tmp_path / "a.json"
    code = ablate_command.ablate(str(folder / "in"), reference=str(folder / "ref"), json_file=report)
    assert code == 130
    told = capsys.readouterr()
    assert "interrupted: 2 of " in told.err
    table = [line.split() for line in told.out.splitlines()]
    assert ["base", "30.00", "0.1", "0.0200", "500"] in table
    assert ["unfiltered", "inf", "+inf", "0", "-100", "%", "250", "-50", "%"] in table
    assert [row["name"] for row in json.loads(report.read_text())["rows"]] == ["base", "unfiltered"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["in"], "--reference"),
        (["in", "--reference", "none"], "none: no such file or folder"),
        (["in", "--reference", "in"], "as its own reference"),
        (["in", "--reference", "ref", "--only", "level-1"], "Did you mean levels-1?"),
        (["in", "--reference", "ref", "--set", "levls=1"], "Did you mean levels?"),
        (["in", "--reference", "ref", "--json", "in/shot.0001.exr"], "--overwrite"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_errors_before_the_work(folder, arguments, complaint):
    code, error, _, modules = observed("ablate", *arguments, cwd=folder)
    assert code == 2
    assert complaint in error
    assert "jax" not in modules
