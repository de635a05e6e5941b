"""Nothing out of a file, and no name of one, steers the terminal or leads a write out of the output folder."""

import json
import os
import re

import browser
import numpy as np
import pytest
from shots import write_frame, write_shot

from svgf_jax import SvgfError, atomic, checkpoint, exr, page, plan
from svgf_jax.cli import main
from svgf_jax.commands import terminal
from svgf_jax.parameters import load_params
from svgf_jax.sequences import find_sequence
from tune.__main__ import main as tune_main

NASTY = {
    "<script>alert(1)</script>.R",
    "[red]bold[/red]",
    "%s%n",
    "{0.__class__}",
    "../../../etc/passwd.R",
    "$(touch x) `touch y`",
    "\u202egnp.exe",
    "z" * 250,
}
ESCAPES = "\x1b[31mred\x07\x9b2J\u202e<script>%s{0}[bold]"


@pytest.fixture
def hostile(tmp_path):
    """Three frames in a folder with a nasty name, with nasty channels and header attributes."""
    folder = tmp_path / "<img src=x onerror=alert(1)>[red]%s{0}"
    folder.mkdir()
    for number in (1, 2, 3):
        path = folder / f"a<b>[red].{number:04d}.exr"
        write_frame(path, number)
        image = exr.read(path)
        channels = image.channels | dict.fromkeys(NASTY, np.zeros((14, 19), np.float16))
        attributes = image.attributes | {"comments": ESCAPES, "renderer": ESCAPES, "owner": "y" * 1_000_000, "<b>": "x"}
        exr.write(path, image._replace(channels=channels, attributes=attributes))
    return folder


def controls(text):
    return {c for c in text if c != "\n" and (ord(c) < 32 or 127 <= ord(c) < 160 or c == "\u202e")}


def test_inspect_says_nasty_names_as_they_are_and_nothing_raw(hostile, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "400")
    with pytest.raises(SystemExit) as left:
        main(["inspect", str(hostile)])
    assert left.value.code == 0
    shown = capsys.readouterr()
    assert not controls(shown.out + shown.err)
    for name in NASTY:
        assert terminal.visible(name) in shown.out
    assert len(shown.out) < 20_000
    with pytest.raises(SystemExit):
        main(["inspect", str(hostile), "--json"])
    shown = capsys.readouterr()
    assert not controls(shown.out)
    assert json.loads(shown.out)


def test_a_dry_run_says_nothing_raw(hostile, tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["denoise", str(hostile), "-o", str(tmp_path / "out"), "--dry-run", "--verbose"])
    shown = capsys.readouterr()
    assert not controls(shown.out + shown.err)
    assert "a<b>[red].0001.exr" in shown.err


@pytest.mark.parametrize("text", ["a\x1b[31mb", "\x9b2J", "\u202eabc", "a\u2028b", "\udcff.exr", "\ufeff"])
def test_what_steers_a_terminal_is_spelt_out(text, capsys):
    terminal.tell(text)
    shown = capsys.readouterr().err
    assert shown.isascii()
    assert "\\" in shown
    assert not controls(shown)
    assert page.escape(text).isascii()
    assert not controls(page.escape(text))


def test_a_script_that_slipped_into_a_page_does_not_run(tmp_path):
    file = tmp_path / "page.html"
    evil = page.Raw("<script>document.title = 'evil'</script><img src=x onerror=\"document.title = 'evil'\">")
    file.write_text(page.document("good", [page.table(("name",), [(evil,)])]))
    with pytest.raises(AssertionError, match="Content Security Policy"):  # the browser says so, and `opened` tells
        browser.opened(file, tmp_path, script="")
    file.write_text(page.document("good", ["<p>nothing</p>"]))
    assert "<title>good</title>" in browser.opened(file, tmp_path, script="document.body.dataset.ran = 1")


def test_ordinary_names_stay_as_they_are():
    assert terminal.visible("größe 光 [red] %s {0}\n\tx") == "größe 光 [red] %s {0}\n\tx"


def test_a_file_name_with_control_characters_is_refused(tmp_path):
    (tmp_path / "a\nwarning: all good.0001.exr").touch()
    with pytest.raises(SvgfError, match=r"control characters in the name 'a\\nwarning: all good.0001.exr'; rename it"):
        find_sequence(tmp_path)


@pytest.mark.parametrize(
    "arguments", [["inspect", "{}"], ["inspect", "{}/none"], ["video", "a", "-o={}"], ["{}"]], ids=str
)
def test_a_folder_name_forges_no_line(arguments, tmp_path, capsys):
    folder = tmp_path / "fk\nsvgf-jax: 100 frames complete"
    write_shot(folder, (1,))
    with pytest.raises(SystemExit) as left:
        main([argument.format(folder) for argument in arguments])
    assert left.value.code == 2
    shown = capsys.readouterr()
    assert not shown.out
    assert len(shown.err.splitlines()) == 1
    assert r"fk\nsvgf-jax: 100 frames complete" in shown.err
    assert "rename the file or folder" in shown.err


def test_pictures_with_names_that_turn_words_round_are_found_in_a_page():
    name = "\u202egnp\x1b<b>"
    shown = page.viewer([page.Shown(1, {name: "data:,"}, {}, {name: 30.0})], left=name, right=name, legends={})
    assert not controls(shown)
    stored = json.loads(shown.split('id="frames">')[1].split("</script>")[0])["frames"][0]
    assert [*stored["pictures"]] == [*stored["notes"]] == [r"\u202egnp\x1b<b>"]
    assert shown.count(r'<option value="\u202egnp\x1b&lt;b&gt;" selected>') == 2


def test_the_tuner_says_nothing_raw_either(capsys):
    for name in ("a\nsvgf-tune: all good", "none\x1b[31m"):
        with pytest.raises(SystemExit):
            tune_main([name, "-o", "x.toml", "--reference", "x"])
        shown = capsys.readouterr().err
        assert not controls(shown)
        assert len(shown.splitlines()) == 1


def test_values_of_toml_and_cameras_are_told_as_text(tmp_path, capsys):
    file = tmp_path / "p.toml"
    file.write_text('[params]\n"alpha\\u001b[31m" = 1\n')
    with pytest.raises(SystemExit):
        main(["params", "show", "--params", str(file)])
    assert not controls(capsys.readouterr().err)
    with pytest.raises(SvgfError, match="alpha"):
        load_params(file)


def test_a_link_in_the_place_of_an_output_is_replaced_and_not_followed(tmp_path):
    outside, link = tmp_path / "outside", tmp_path / "out.exr"
    outside.write_text("mine")
    link.symlink_to(outside)
    exr.write(link, exr.new_image({"R": np.ones((2, 2), np.float32)}))
    assert not link.is_symlink()
    assert outside.read_text() == "mine"


def test_a_planted_temporary_link_is_not_written_through(tmp_path):
    outside = tmp_path / "outside"
    outside.write_text("mine")
    (tmp_path / ".x.npz.tmp").symlink_to(outside)
    with atomic.replacing(tmp_path / "x.npz", unique=False) as temporary:
        temporary.write_text("new")
    assert (tmp_path / "x.npz").read_text() == "new"
    assert outside.read_text() == "mine"


@pytest.mark.parametrize("name", ["", "lock", "frames.jsonl"])
def test_a_state_that_leads_elsewhere_is_refused(tmp_path, name):
    outside = tmp_path / "outside"
    state = checkpoint.state_folder(tmp_path / "out")
    if name:
        outside.write_text("mine")
        state.mkdir(parents=True)
        (state / name).symlink_to(outside)
    else:
        outside.mkdir()
        state.parent.mkdir()
        state.symlink_to(outside)
    with pytest.raises(SvgfError, match="is a symbolic link; nothing is written through it"), checkpoint.lock(state):
        pass
    assert outside.read_text() == "mine" if name else not list(outside.iterdir())


def test_dots_in_a_pattern_lead_no_output_out_of_its_folder(tmp_path):
    write_shot(tmp_path / "in", (1, 2))
    pattern = os.path.join(tmp_path, "in", "..", "in", ".", "shot.####.exr")
    for path in plan.output_paths(find_sequence(pattern).files, tmp_path / "out", hold=False):
        assert path.parent == tmp_path / "out"
        assert path.name.startswith("shot.")


def test_a_checkpoint_is_data_only(tmp_path):
    state = checkpoint.state_folder(tmp_path)
    state.mkdir(parents=True)

    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "made"),)

    np.savez(
        state / "checkpoint.npz", format=np.asarray(1), identity=np.array([Evil()], object), next_index=np.asarray(0)
    )
    with pytest.raises(SvgfError, match="checkpoint"):
        checkpoint.load_checkpoint(state, {"frames": []})
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("run", [main, tune_main])
@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("", "Got '' as argument 3; wanted something there"),
        ("--out=", "argument 3"),
        ("a\udcff", r"'a\\udcff': not UTF-8"),
    ],
)
def test_arguments_that_no_name_can_be_are_refused(run, argument, said, capsys):
    with pytest.raises(SystemExit):
        run(["denoise", "in", argument])
    assert re.search(said, capsys.readouterr().err)


def test_a_name_that_is_not_utf8_is_refused_before_the_work(tmp_path):
    write_shot(tmp_path, (1,))
    (tmp_path / "shot.0001.exr").rename(tmp_path / "a\udcff.0001.exr")
    with pytest.raises(SvgfError, match=r"bytes that are not UTF-8 in the name 'a\\udcff.0001.exr'; rename it"):
        find_sequence(tmp_path)
