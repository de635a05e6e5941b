"""The page about a run: what it says, what it does in a browser, and that nothing out of a file becomes markup."""

import html
import json
import re

import browser
import jax
import numpy as np
import pytest
from shots import init, step, write_shot

from svgf_jax import checkpoint, exr, metrics, page, pieces, report, streaming
from svgf_jax.cli import main
from svgf_jax.commands import terminal
from svgf_jax.frames import open_source
from svgf_jax.outputs import WriteOptions
from svgf_jax.references import pair_references
from svgf_jax.types import Config, Params

EVIL = "</script><script>console.log('evil')</script>"
ACT = """
(async () => {
  const told = {};
  const loaded = () => Promise.all([...document.images].filter((image) => image.src && !image.complete).map(
    (image) => new Promise((done) => image.addEventListener("load", done))));
  const bright = (image) => {  // reading a pixel back decodes the picture
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
    const context = canvas.getContext("2d");
    context.drawImage(image, 0, 0);
    return context.getImageData(0, 0, 1, 1).data[3];
  };
  const look = async () => {
    await loaded();
    const [under, over] = document.querySelectorAll(".stage img");
    return {
      number: number.textContent, left: document.querySelector(".is-left").textContent,
      right: document.querySelector(".is-right").textContent, clip: over.style.clipPath, under: under.src, over: over.src,
      widths: [...document.images].filter((image) => image.src).map((image) => image.naturalWidth),
      decoded: [...document.images].filter((image) => image.src).map(bright),
      maps: [...document.querySelectorAll("#maps figcaption")].map((text) => text.textContent),
      now: document.querySelector("svg .now").getAttribute("x1"),
    };
  };
  told.first = await look();
  scrub.value = 0; scrub.dispatchEvent(new Event("input")); told.scrubbed = await look();
  document.dispatchEvent(new KeyboardEvent("keydown", {key: ".", bubbles: true})); told.key = await look();
  wipe.value = 20; wipe.dispatchEvent(new Event("input")); told.wiped = await look();
  const box = stage.getBoundingClientRect();
  const where = {clientX: box.left + 0.75 * box.width, clientY: box.top + 5, bubbles: true};
  stage.dispatchEvent(new PointerEvent("pointerdown", where)); told.pressed = await look();
  stage.dispatchEvent(new PointerEvent("pointermove", {...where, clientX: box.left + 0.1 * box.width}));
  stage.dispatchEvent(new PointerEvent("pointerup", where)); told.dragged = await look();
  right.value = "reference"; right.dispatchEvent(new Event("change")); told.chosen = await look();
  told.wide = document.documentElement.scrollWidth <= window.innerWidth;
  document.body.dataset.told = JSON.stringify(told);
})();
"""


def in_browser(path, folder):
    """What the viewer of a page shows while it is used."""
    dom = browser.opened(path, folder, script=ACT)
    return json.loads(html.unescape(re.search(r'data-told="(.*?)"', dom).group(1)))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run of 30 frames that was broken off after ten, and the page about it: five shown, references of the first 28."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "MOST", 5)
        yield make(tmp_path_factory)


def make(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    shots, out = folder / "<b>in&", folder / "out"
    write_shot(shots, range(1, 31))
    write_shot(folder / "refs", range(1, 29))
    for path in shots.glob("*.exr"):
        image = exr.read(path)
        exr.write(path, image._replace(channels={k.replace("albedo", EVIL): v for k, v in image.channels.items()}))
    source = open_source(shots, channel={"albedo": [f"{EVIL}.{c}" for c in "RGB"]})
    references, _ = pair_references(source.sequence, folder / "refs")
    options = {"pipeline": (init, step), "params": Params(alpha=0.5)}
    streaming.run(source, out, stop=iter([False] * 9 + [True] * 30).__next__, **options)
    run = report.Run(
        source, out, "svgf", "paper", Params(alpha=0.5), Config(), WriteOptions(exposure=2.0), references, {}
    )
    summary = streaming.run(source, out, resume=True, on_output=report.watch(run), **options)
    text = report.run_page(run, summary, repairs=terminal.repairs)
    (folder / "page.html").write_text(text, encoding="utf-8")
    return run, summary, text, folder


def test_the_page_says_what_was_done_and_what_is_not_known(made):
    run, summary, text, _ = made
    assert summary.resumed_at == 10
    assert "30 of 30, 10 of them by an earlier run" in text
    assert "of 5 of 30 frames, evenly spread: 1-15x7,23,30" in text
    assert "maps of frames 1,8 are unknown" in text
    assert run.maps.keys() == {15, 23, 30}
    assert "There is no record" not in text  # the first part noted its figures
    rows = re.findall(r"<tr><td>(\d+)</td><td>filtered</td><td>([\d.]*)</td>", text)
    assert [int(number) for number, _ in rows] == list(range(1, 31))
    assert [bool(psnr) for _, psnr in rows] == [True] * 28 + [False] * 2
    for wanted in ("alpha</td><td>0.5", "mean history length", "pixels repaired", "temporal error", "svgf_jax</td>"):
        assert wanted in text
    assert "http:" not in text
    assert "https:" not in text


def test_nothing_from_a_file_is_markup(made):
    _, _, text, _ = made
    assert EVIL not in text
    assert html.escape(EVIL) in text
    assert "<b>in&" not in text
    assert "&lt;b&gt;in&amp;" in text


def test_the_viewer_works_in_a_browser(made):
    _, _, _, folder = made
    told = in_browser(folder / "page.html", folder)
    assert told["first"]["number"] == "frame 15"
    assert told["first"]["left"].startswith("noisy: ")
    assert told["first"]["right"].startswith("denoised: ")
    assert min(told["first"]["widths"]) == 19
    assert set(told["first"]["decoded"]) == {255}
    names = [caption.split()[0] for caption in told["first"]["maps"]]
    assert names[0] == "difference"
    assert {"variance", "history"} <= set(names)
    assert told["scrubbed"]["number"] == "frame 1"
    assert told["scrubbed"]["under"] != told["first"]["under"]
    assert float(told["scrubbed"]["now"]) < float(told["first"]["now"])
    assert told["key"]["number"] == "frame 8"
    clips = [
        float(re.search(r"inset\(0(?:px)? ([\d.]+)%", told[what]["clip"]).group(1))
        for what in ("wiped", "pressed", "dragged")
    ]
    assert clips == pytest.approx([80, 25, 90], abs=1)
    assert told["chosen"]["right"] == "reference"
    assert told["chosen"]["under"] != told["dragged"]["under"]
    assert told["wide"]


def test_a_frame_without_a_record_is_unknown(made, tmp_path):
    run, summary, _, _ = made
    checkpoint.remove_figures(checkpoint.state_folder(run.out))
    text = report.run_page(run, summary, repairs=terminal.repairs)
    assert "There is no record of frames 1-30" in text
    assert "<td>?</td><td>?</td><td>?</td>" in text
    assert "mean history length" not in text


def test_a_long_sequence_of_large_noisy_frames_stays_small():
    rng = np.random.default_rng(0)
    most = 12_000_000 // (24 * 12)
    noise = rng.integers(0, 256, (720, 1280, 3), np.uint8)
    assert len(page.picture(noise, most=most)) <= most
    assert page.picture(noise[:8, :8], most=most).startswith("data:image/png")
    assert page.evenly(range(1, 1001), 24)[::23] == (1, 1000)
    assert page.evenly([3, 5], 24) == (3, 5)


def test_plots_leave_out_what_is_not_there():
    line = page.Line("<a>", [1, 2, 3], [1.0, float("nan"), 0.0])
    text = page.plot([line], title="t", frames=[1, 3])
    assert "nan" not in text
    assert "&lt;a&gt;" in text
    assert text.count("<circle") == 2
    assert page.plot([line], title="t", log=True).count("<circle") == 1
    assert page.plot([line._replace(y=[float("nan")] * 3)], title="t") == ""


def test_flip_is_of_the_pictures_as_they_are_shown():
    pytest.importorskip("flip_evaluator")
    image = np.random.default_rng(0).uniform(0, 1, (20, 30, 3))
    assert metrics.flip_map(image, image).max() == 0
    one = image.copy()
    one[5:9, 5:9] = 1 - one[5:9, 5:9]
    found = metrics.flip_map(one, image)
    assert found.shape == (20, 30)
    assert found[5:9, 5:9].max() == found.max()
    assert 0.2 < found.max() <= 1


def test_maps_mean_what_their_legends_say():
    heat = page.heat(np.array([[0.0, 0.5, 1.0, 2.0, np.nan]])).astype(int).sum(-1)[0]
    assert heat[0] < heat[1] < heat[2] == heat[3]
    red, white, blue = page.signed(np.array([[1.0, 0.0, -1.0]]))[0].tolist()
    assert (red, white, blue) == ([255, 0, 0], [255, 255, 255], [0, 0, 255])


def test_a_comparison_has_a_page(made, tmp_path, capsys):
    run, _, _, folder = made
    target = tmp_path / "page.html"
    with pytest.raises(SystemExit) as end:
        main(
            ["compare", str(run.out), str(folder / "refs"), "--before", str(folder / "<b>in&"), "--report", str(target)]
        )
    text = target.read_text()
    assert end.value.code == 0
    assert "frames 29-30 are in only one of the sequences" in text  # what was told stands in the page too
    assert "frames 29-30 are in only one of the sequences" in capsys.readouterr().err
    assert re.search(r"<tr><td>mean</td><td>[\d.]+</td>", text)
    assert "preset</td>" in text
    assert "alpha</td><td>0.5" in text
    told = in_browser(target, tmp_path)
    assert told["first"]["left"].startswith("result: ")
    assert set(told["first"]["decoded"]) == {255}


def test_an_ablation_has_a_page(made, tmp_path, monkeypatch, capsys):
    run, _, _, folder = made
    monkeypatch.setattr("svgf_jax.compiled._jitted", lambda *_: (init, jax.jit(stand_in)))
    target = tmp_path / "page.html"
    call = [
        "ablate",
        str(folder / "refs" / "shot.####.exr"),
        "--reference",
        str(run.out / "shot.####.exr"),
        "--frames",
        "1-6",
    ]
    with pytest.raises(SystemExit) as end:
        main([*call, "--only", "no-history,levels-2", "--report", str(target)])
    text = target.read_text()
    assert (end.value.code, capsys.readouterr().err.count("PSNR")) == (0, 3)
    rows = re.findall(r"<tr><td>(base|no-history|levels-2)</td>", text)
    assert rows == ["base", "no-history", "levels-2"]
    assert "of 4 of 6 frames" in text
    told = in_browser(target, tmp_path)
    assert (told["first"]["left"].partition(":")[0], told["chosen"]["right"]) == ("base", "reference")
    assert [caption.split()[0] for caption in told["first"]["maps"]][:1] == ["difference"]
    lines = re.findall(r'<g data-name="([\w-]+)"', text)
    assert lines == ["base", "no-history", "levels-2"] * 2


def stand_in(history, frame, params):
    return step(history, frame, params=params, config=Config())


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["denoise", "in", "-o", "out", "--reference", "ref"], "--reference ref without --report"),
        (["compare", "out", "ref", "--before", "in"], "--before in without --report"),
        (["denoise", "in", "-o", "out", "--report", "there.html"], "there.html exists already"),
        (["compare", "out", "ref", "--report", "there.html/page.html"], "Could not write there.html/page"),
    ],
)
def test_what_cannot_be_is_said_before_the_work(arguments, complaint, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.html").touch()
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    assert complaint in capsys.readouterr().err


def test_held_frames_are_shown_without_an_input(tmp_path):
    shot, out = write_shot(tmp_path / "in", [1, 3]), tmp_path / "out"
    source = open_source(shot, missing="hold")
    run = report.Run(source, out, "svgf", "paper", Params(), Config(), WriteOptions(), {}, {})
    summary = streaming.run(source, out, pipeline=(init, step), on_output=report.watch(run))
    text = report.run_page(run, summary, repairs=terminal.repairs)
    assert re.search(r"<tr><td>2</td><td>held</td>.*?<td>\?</td></tr>", text)
    frames = json.loads(re.search(r'id="frames">(.*?)</script>', text).group(1))["frames"]
    assert [sorted(frame["pictures"]) for frame in frames] == [
        ["denoised", "noisy"],
        ["denoised"],
        ["denoised", "noisy"],
    ]


def test_curves_have_colours_and_names_by_what_they_are():
    """Grey is what a result is compared with; a result alone has its colour, and its name where that tells something."""
    before, after = (metrics.Scores(psnr, 0.1, 0.9, float("nan"), float("nan")) for psnr in (20.0, 30.0))
    lines = pieces.lines([1], [after], "result", "psnr", {"before": {1: before}})
    both = page.plot(lines, title="t", named=True)
    assert '<span class="key k0">before</span><span class="key k1">result</span>' in both
    alone = page.plot(pieces.lines([1], [after], "result", "temporal", {"before": {1: before}}), title="t", named=True)
    assert alone == ""  # no temporal error of one frame
    alone = page.plot(lines[1:], title="t", named=True)
    assert '<span class="key k1">result</span>' in alone
    assert 'data-name="result" class="k1"' in alone
    assert "key" not in page.plot(lines[1:], title="t")


def test_frames_are_done_one_after_the_other():
    unknown = float("nan")
    assert report._from_start([5.0, 0.5, unknown, 0.25])[::3] == [5.0, 5.75]
    assert report._speed([5.0, 0.5, unknown, 0.25]) == [
        ("seconds, first frame", "5.00, compilation included"),
        ("seconds a frame, the others", "0.375"),
    ]
    assert report._speed([5.0]) == []


def test_a_page_without_flip_says_so():
    for names, lacks in ((("difference",), True), (("difference", "FLIP"), False), (("variance",), False)):
        shown = [page.Shown(1, {"result": ""}, {"result": dict.fromkeys(names, "")})]
        assert ("No FLIP maps" in page.viewer(shown, left="result", right="result", legends={})) == lacks


@pytest.mark.parametrize(
    "text",
    [
        "[" * 5000,
        "7",
        '{"parameters": 7}',
        '{"parameters": {"max_history": "x"}}',
        '{"config": {"a": [[1]]}}',
        '{"parameters": {"a": 1' + "0" * 200 + "}}",
        "{",
    ],
)
def test_what_a_header_says_of_its_parameters_is_believed_only_if_it_can_be(text):
    assert report._recorded({"svgf_jax:parameters": text}) == {}
    assert report._recorded({"svgf_jax:parameters": '{"parameters": {"a": [1, 2.5]}, "config": {"b": true}}'})["config"]
