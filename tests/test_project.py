"""`svgf-jax.toml`, the project's own flags, and shell completion."""

from pathlib import Path

import pytest
from shots import write_shot
from test_dry_run import run

from svgf_jax import cli
from svgf_jax.commands import denoise
from svgf_jax.commands.project import _PLACES, _options, nearest
from tune.__main__ import app as tuner
from tune.__main__ import main as tune

ROOT = Path(__file__).parents[1]


@pytest.fixture
def chosen(tmp_path, monkeypatch):
    """A function: (project file, arguments of denoise) -> what the command would have done them with."""
    monkeypatch.chdir(tmp_path)
    told = {}

    def choose_method(method, preset, params, changes):
        told.update(method=method, preset=preset, params=params, set=changes)
        return "", None, None

    def options(reading):
        told["reading"] = reading
        raise KeyboardInterrupt  # before any work

    monkeypatch.setattr(denoise.settings, "choose_method", choose_method)
    monkeypatch.setattr(denoise.Reading, "options", options)

    def run(text, *arguments, command=("denoise", "shot", "-o", "out")):
        (tmp_path / "svgf-jax.toml").write_text(text)
        with pytest.raises(SystemExit) as stopped:
            cli.main([*command, *arguments])
        assert stopped.value.code in (2, 130)
        return told

    return run


def test_an_interruption_is_told(chosen, capsys):
    chosen("")
    assert capsys.readouterr().err.endswith("svgf-jax: interrupted; files with their final name are complete\n")


def test_the_file_stands_behind_the_command_line(chosen, capsys):
    text = '[denoise]\npreset = "falcor"\nset = { alpha = 0.3, sigma_normal = [1, 2], taa = true }\npng = true\n'
    told = chosen(text + 'channel = ["albedo=a,b,c"]\n')
    assert (told["method"], told["preset"], told["set"]) == (
        "svgf",
        "falcor",
        ("alpha=0.3", "sigma_normal=1,2", "taa=true"),
    )
    assert told["reading"].channel == ("albedo=a,b,c",)
    assert "svgf-jax.toml: preset, set, png, channel" in capsys.readouterr().err
    told = chosen(text, "--preset", "paper", "--set", "alpha=0.9")
    assert (told["preset"], told["set"]) == ("paper", ("alpha=0.9",))
    assert "svgf-jax.toml: png\n" in capsys.readouterr().err
    assert chosen(text, "--params", "mine.toml")["preset"] is None  # would exclude each other
    assert chosen(text, "--config", "none")["preset"] is None
    (Path.cwd() / "other.toml").write_text('[denoise]\npreset = "tuned"\n')
    assert chosen(text, "--config", "other.toml")["preset"] == "tuned"


def test_a_flag_of_the_file_is_taken_back(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_shot("in", [1])
    Path("svgf-jax.toml").write_text("[denoise]\npng = true\n")
    for given, files in (((), 2), (("--png=false",), 1)):
        assert f"write {files} file" in run(capsys, "denoise", "in", "-o", "out", "--dry-run", *given)[2]


def test_the_nearest_file_above_is_taken(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    assert nearest(tmp_path / "a" / "b") is None
    (tmp_path / "svgf-jax.toml").touch()
    assert nearest(tmp_path / "a" / "b") == tmp_path / "svgf-jax.toml"
    (tmp_path / "a" / "svgf-jax.toml").touch()
    assert nearest(tmp_path / "a" / "b") == tmp_path / "a" / "svgf-jax.toml"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[denoise]\n\npgn = true", "svgf-jax.toml:3: denoise has no option 'pgn'. Did you mean png? There are cam"),
        ("[denoise]\npng = 1", "svgf-jax.toml:2: png = 1; wanted true or false"),
        ("[denoise]\npreset = true", "svgf-jax.toml:2: preset = true; wanted a text."),
        ("[denoise]\npreset = ['a', 'b']", "svgf-jax.toml:2: preset = a,b; wanted a text"),
        ("[denoise]\nset = false", "svgf-jax.toml:2: set = false; wanted a list of texts, or a table"),
        ("[denoise]\nfps = 'fast'", "svgf-jax.toml:2: fps = fast; wanted a number."),
        ("[denoise]\nframes = 5", 'svgf-jax.toml:2: frames = 5; wanted a text: frames = "5".'),
        ('[denoise]\nout = "a\\u0000b"', "svgf-jax.toml:2: out = 'a\\x00b'; wanted a text, not empty, without control"),
        ("[denoise]\nchannel = ['']", "svgf-jax.toml:2: channel = ['']; wanted a text, not empty"),
        ("[denoise]\ndevices = 1.5", "svgf-jax.toml:2: devices = 1.5; wanted a whole number."),
        ("[denoise]\nchannel = [1]", "svgf-jax.toml:2: channel = 1; wanted a list of texts, or a table."),
        ("[denoise]\nset = { alpha = { x = 1 } }", "svgf-jax.toml:2: set = "),
        (
            "[all]\nrendrer = 'a'",
            "svgf-jax.toml:2: no command has an option 'rendrer'. Did you mean renderer? There are",
        ),
        ("[all]\nlayer = 3", "svgf-jax.toml:2: layer = 3; wanted a text"),
        ("[denoise]\nmissing = 'skip'", 'svgf-jax.toml:2. Choose from: "error"'),
        ("[denois]\n", "svgf-jax.toml:1: got 'denois'"),
        ("png = true", "svgf-jax.toml:1: got 'png'; wanted a table for each command"),
        ("[denoise]\npng = yes", "svgf-jax.toml:2: not TOML"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(text, complaint, chosen, capsys):
    chosen(text)
    assert complaint in capsys.readouterr().err


def test_a_table_for_all_stands_behind_those_of_the_commands(chosen, tmp_path, capsys):
    text = "[all]\nrenderer = 'cycles'\nlayer = 'a'\npreset = 'tuned'\nflip = true\n[denoise]\nlayer = 'b'\nparams = 'p.toml'\n"
    told = chosen(text, "--motion", "y-up")
    assert (told["preset"], str(told["params"])) == (None, "p.toml")
    assert (told["reading"].renderer, told["reading"].layer, told["reading"].motion) == ("cycles", "b", "y-up")
    assert "svgf-jax.toml: layer, params, renderer\n" in capsys.readouterr().err
    assert chosen(text, command=("inspect", "shot"))["reading"].layer == "a"
    assert chosen(text, "--layer", "c")["reading"].layer == "c"
    (tmp_path / "svgf-jax.toml").write_text(text)
    with pytest.raises(SystemExit):
        tune(["noisy", "--reference", "refs", "-o", "p.toml", "--max-steps", "1"])
    assert told["reading"].layer == "a"


def test_relative_paths_count_from_the_files_folder(chosen, tmp_path, monkeypatch):
    text = (
        "[denoise]\nparams = 'p.toml'\ncameras = 'c.json'\nrenderer = 'r.toml'\n"
        "file = { normal = 'n/a_#.exr', albedo = 'b_#.exr' }"
    )
    told = chosen(text)
    assert (str(told["params"]), told["reading"].cameras) == ("p.toml", "c.json")  # as it stands there
    (tmp_path / "deep").mkdir()
    monkeypatch.chdir(tmp_path / "deep")
    for more in ((), ("--config", "../svgf-jax.toml")):
        told = chosen(text, *more)
        reading = told["reading"]
        found = (told["params"], reading.cameras, reading.renderer, reading.file[0].removeprefix("normal="))
        assert [Path(one).resolve() for one in found] == [
            tmp_path / one for one in ("p.toml", "c.json", "r.toml", "n/a_#.exr")
        ]
        assert reading.file[1] == "albedo=b_#.exr"  # beside the frames
    told = chosen("[denoise]\ncameras = 'none'\nrenderer = 'cycles'")["reading"]
    assert (told.cameras, told.renderer) == ("none", "cycles")


def test_every_option_that_names_files_is_there():
    commands = [cli.app[name] for name in ("denoise", "compare", "inspect", "ablate")]
    known = {name for app in (*commands, tuner) for name in _options(app.assemble_argument_collection())}
    assert known >= set(_PLACES)


def test_a_file_that_was_asked_for_must_be_there(chosen, capsys):
    chosen("", "--config", "no.toml")
    assert "no.toml: no such project file" in capsys.readouterr().err


def test_the_table_of_the_tuner_is_the_tuners(tmp_path, monkeypatch, capsys):
    def said(text, *arguments):
        (tmp_path / "svgf-jax.toml").write_text(text)
        with pytest.raises(SystemExit):
            tune(["noisy", "-o", "p.toml", *arguments])
        return capsys.readouterr().err

    monkeypatch.chdir(tmp_path)
    text = '[tune]\nreference = ["refs"]\nmax-steps = 0\n[denoise]\npng = true\n'
    assert "--max-steps 0" in said(text)
    assert "--prior -1" in said(text, "--max-steps", "3", "--prior", "-1")
    assert "svgf-jax.toml:2: tune has no option 'max_steps'. Did you mean max-steps?" in said("[tune]\nmax_steps = 3\n")


def test_the_table_of_the_tuner_is_no_error_elsewhere(chosen):
    assert chosen("[tune]\nmax-steps = 3\n")["method"] == "svgf"


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["denoise", "x", "--preset"], {"paper", "adaptive"}),
        (["inspect", "x", "--renderer"], {"auto", "native", "cycles"}),
        (["ablate", str(ROOT / "tests" / "data" / "cycles" / "layers"), "--layer"], {"Other", "ViewLayer"}),
        (["denoise", "nowhere", "--layer"], set()),
        (["params", "show"], {"paper", "gaussian"}),
    ],
)
def test_values_are_completed(words, wanted, capsys):
    with pytest.raises(SystemExit):
        cli.main(["__complete", *words, ""])
    told = set(capsys.readouterr().out.split())
    assert told >= wanted
    assert wanted or told == {"begin"}


def test_the_tuner_is_completed_too(capsys):
    with pytest.raises(SystemExit):
        tune(["--completion", "bash"])
    assert "--tangent-batch" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        tune(["__complete", "noisy", "--preset", "pa"])
    assert "paper" in capsys.readouterr().out.split()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_gets_its_completion(shell, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["completion", shell, "--config", "none"])
    script = capsys.readouterr().out
    assert end.value.code == 0
    assert all(
        word in script
        for word in ("svgf-jax", "denoise", "--checkpoint-every" if shell != "fish" else "checkpoint-every")
    )


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ('[denoise]\npreset = "papr"\n', 2, "no preset 'papr'"),
        ("[all]\n\nset = { alhpa = 0.3 }\n", 3, "no parameter 'alhpa'"),
        ('[all.set]\nalpha = 0.3\nsigma_normal = "x"\n', 3, "sigma_normal=x; wanted a number"),
        ('[all]\npreset = "paper"\nset = ["alpha=-3"]\n', 3, "alpha = -3.0; wanted"),
    ],
)
def test_a_wrong_value_is_told_with_its_line(tmp_path, monkeypatch, capsys, text, line, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "svgf-jax.toml").write_text(text)
    error = run(capsys, "denoise", "shot", "-o", "out")[2].splitlines()[-1]
    assert error.startswith(f"svgf-jax: {tmp_path / 'svgf-jax.toml'}:{line}: ")
    assert said in error
    error = run(capsys, "denoise", "shot", "-o", "out", "--config", "none")[2]
    assert "svgf-jax.toml:" not in error


def test_a_pattern_without_a_folder_is_looked_for_beside_the_frames(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_shot(tmp_path / "shot", [1])
    (tmp_path / "svgf-jax.toml").write_text('[all]\nfile = { normal = "nrm_####.exr" }\n')
    error = run(capsys, "inspect", "shot")[2]
    assert f"{Path('shot') / 'nrm_####.exr'}: no such frames. In shot there is" in error
