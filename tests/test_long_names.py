"""Names as long as the file system takes them are written; longer ones are refused before any work."""

import os

import pytest

from svgf_jax import SvgfError, atomic, cli
from svgf_jax.plan import begin, locked, make_plan
from tune.__main__ import main as tune


def plan_of(folder, out, name, more=(), **options):
    """The plan of one input of that name, and further frames, in another folder."""
    (folder / "in").mkdir(exist_ok=True)
    (folder / "in" / name).write_text("")
    files = [(7, str(folder / "in" / name)), *more]
    return make_plan(files, out, **{"hold": bool(more), "png": True, "video": False, "identity": {}} | options)


@pytest.mark.parametrize("letter", ["a", "ä", "\udcff"])
@pytest.mark.parametrize("unique", [True, False])
def test_the_longest_name_is_written(tmp_path, letter, unique):
    path = tmp_path / (letter * (255 // len(os.fsencode(letter))))
    atomic.require_writable(path)
    with atomic.replacing(path, unique=unique) as temporary:
        temporary.write_text("new")
        assert len(os.fsencode(temporary.name)) <= 143
    assert path.read_text() == "new"
    assert len(os.listdir(tmp_path)) == 1


def test_a_longer_one_is_refused_before_anything_is_written(tmp_path):
    for do in (atomic.require_writable, lambda path: atomic.write_text(path, "")):
        with pytest.raises(OSError, match="too long"):
            do(tmp_path / ("a" * 256))
    assert not os.listdir(tmp_path)


def test_what_a_killed_run_left_of_a_long_name_is_removed_and_no_other_frames(tmp_path):
    name = "shot_" * 48 + "0007.exr"
    with atomic.replacing(tmp_path / name) as own, atomic.replacing(tmp_path / name.replace("7", "8")) as another:
        plan = plan_of(tmp_path, tmp_path, name)
        with locked(plan):
            begin(plan, resume=False, overwrite=True)
        assert another.exists()
        assert not own.exists()
        own.touch()


def test_outputs_of_too_long_names_are_known_before(tmp_path):
    name = "a" * 246 + "_0007.exr"
    out = tmp_path / "new" / "out"
    assert plan_of(tmp_path, out, name).outputs[0].name == name
    for options in (
        {"more": [(10_000, None)]},
        {"video": True, "warmup": 0, "name": "a" * 249 + "_7.exr"},  # NAME.7-7.mp4
        {"out": tmp_path / ("b" * 256)},
        {"out": tmp_path / "new" / ("b" * 256) / "out"},
        {"out": tmp_path.joinpath(*["b" * 200] * 20, "out")},
    ):
        with pytest.raises(SvgfError, match=r"this output's name has \d+ bytes, \d+ with its folders"):
            plan_of(tmp_path, **{"out": out, "name": name} | options)
    assert os.listdir(tmp_path) == ["in"]


@pytest.mark.parametrize(
    ("main", "arguments"),
    [
        (cli.main, ["video", "IN", "-o", "LONG.gif"]),
        (cli.main, ["compare", "IN", "IN", "--json", "LONG.json"]),
        (cli.main, ["demo", "-o", "LONG"]),
        (cli.main, ["inspect", "LONG"]),
        (cli.main, ["denoise", "LONG", "-o", "out"]),
        (cli.main, ["denoise", "LONG", "IN", "-o", "out"]),
        (cli.main, ["denoise", "IN", "-o", "out", "--params", "LONG.toml"]),
        (tune, ["IN", "--reference", "IN", "-o", "LONG.toml"]),
        (tune, ["IN", "--reference", "IN", "-o", "t.toml", "--maps", "LONG"]),
    ],
)
def test_commands_say_so(main, arguments, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "IN").mkdir()
    (tmp_path / "IN" / "a_1.exr").write_text("")
    with pytest.raises(SystemExit) as stopped:
        main([given.replace("LONG", "c" * 300) for given in arguments])
    assert stopped.value.code == 2
    assert "ccc" in capsys.readouterr().err
    assert os.listdir(tmp_path) == ["IN"]
