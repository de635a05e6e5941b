"""`svgf-jax inspect`: every thing that can be wrong is found where it was put in, and not where it was not."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rooms import SIZE, camera, write_room
from test_dry_run import run

from svgf_jax import exr, sample
from svgf_jax.commands.inspect import _light
from svgf_jax.findings import judge, verdict
from svgf_jax.frames import open_source
from svgf_jax.inspection import inspect_source
from svgf_jax.motion import Convention
from svgf_jax.warping import Residual, Verdict


def inspected(folder, **options):
    """(facts, findings by topic)."""
    facts = inspect_source(open_source(folder, **options))
    return facts, {one.topic: one for one in judge(facts)}


def blur(_, planes):
    light = planes["radiance"] / planes["albedo"].clip(1e-3)
    for axis in (0, 1):
        light = 0.25 * np.roll(light, 1, axis) + 0.5 * light + 0.25 * np.roll(light, -1, axis)
    planes["radiance"][:] = light * planes["albedo"]


def smooth(_, planes):
    planes["radiance"][:] = planes["albedo"] * (1 + 0.3 * np.sin(planes["position"][..., :1]))


def spoil(_, planes):
    planes["radiance"][20, 20:23, 0] = [np.nan, np.inf, -1]
    planes["motion"][30, 30:34] = np.nan
    planes["motion"][2, 2] = np.nan  # nothing is there


def sparkle(_, planes):
    planes["radiance"][np.random.default_rng(0).random(SIZE) < 0.002] = 5000


def turn(number, planes):
    planes["normal"][:] = planes["normal"] @ camera(number)[0][:3, :3].T


def pack(_, planes):
    planes["normal"] += planes["id"] != -1
    planes["normal"] /= 2


def stretch(number, planes):
    """Depth as the length of the ray."""
    to_camera = camera(number)[0]
    there = planes["position"] @ to_camera[:3, :3].T + to_camera[:3, 3]
    planes["depth"][..., 0] = np.where(planes["id"][..., 0] == -1, 0, np.linalg.norm(there, axis=-1))


def negate_depth(_, planes):
    planes["depth"] *= -1


def flip(_, planes):
    planes["motion"][..., 1] *= -1


def as_fraction(_, planes):
    planes["motion"] /= np.array(SIZE[::-1], np.float32)


def scramble_motion(_, planes):
    planes["motion"][:] = np.random.default_rng(0).normal(0, 5, planes["motion"].shape)


def no_vectors(_, planes):
    planes["motion"][:] = 0


def move_a_box(number, planes):
    """A box of 10 x 10 pixels that goes to the right by 4 a frame, in front of what stands still."""
    box = np.s_[20:30, 10 + 4 * number : 20 + 4 * number]
    planes["id"][box], planes["depth"][box] = 50, 1
    planes["normal"][box] = [0, 0, -1]


def paint(_, planes):
    """Texture, and hardly any noise on it."""
    planes["radiance"][:] = planes["radiance"] / 8 + 0.5 + 0.5 * np.sin(12 * planes["position"].sum(-1, keepdims=True))


def halve_motion(_, planes):
    planes["motion"] /= 2


def jitter_motion(_, planes):
    planes["motion"] += np.random.default_rng(0).normal(0, 3, planes["motion"].shape)


def far_away(_, planes):
    planes["position"] += np.float32(3000)


def renumber(number, planes):
    planes["id"] += 10 * number * (planes["id"] != -1)


def empty(_, planes):
    planes["id"][:] = -1


def overflow(_, planes):
    planes["depth"][40:] = np.inf


def glow(_, planes):
    planes["normal"] = 9 * planes["radiance"]


def many(_, planes):
    planes["id"] += 3000 * (planes["id"] != -1)


# case -> (how to write the frames, how to open them, topic of what must be found, a word of it, a word of its remedy)
CASES = {
    "wide filter": ({"change": blur}, {}, "correlated noise", "correlated", "box"),
    "wide filter of Mitsuba": (
        {"change": blur},
        {"renderer": "mitsuba"},
        "correlated noise",
        "correlated",
        'rfilter type="box"',
    ),
    "texture": (
        {"change": paint, "drop": ["albedo"], "speed": 3},
        {},
        "correlated noise",
        "without an albedo the two are not told apart",
        "box",
    ),
    "one seed": ({"seed": 5}, {}, "seed", "same in every frame", "seed"),
    "one seed of Cycles": (
        {"seed": 5},
        {"renderer": "cycles", "channel": {"radiance": "RGB"}},
        "seed",
        "same in every frame",
        "clock",
    ),
    "one seed, still": ({"seed": 5, "speed": 0}, {}, "seed", "same in every frame", "seed"),
    "denoised already": ({"change": smooth}, {}, "noise", "denoised already", "noisy picture"),
    "broken light": ({"change": spoil}, {}, "broken radiance", "3 NaN and 3 infinite", "set to 0"),
    "negative light": ({"change": spoil}, {}, "negative radiance", "3 negative", "Lanczos"),
    "broken motion": ({"change": spoil}, {}, "broken motion", "12 NaN", "no history"),
    "fireflies": ({"change": sparkle}, {}, "fireflies", "of its pixels", "outlier_radius"),
    "camera-space normals": ({"change": turn}, {}, "normals", "camera space (x right, y down", "--meaning"),
    "packed normals": ({"change": pack}, {}, "normals", "packed", "2 n - 1"),
    "ray distance": ({"change": stretch}, {}, "depth", "length of the ray", "viewing axis"),
    "ray distance, no positions": (
        {"change": stretch, "drop": ["position"]},
        {},
        "depth",
        "length of the ray",
        "view z",
    ),
    "ray distance, no cameras": ({"change": stretch, "cameras": False}, {}, "depth", "length of the ray", "view z"),
    "negative depth": ({"change": negate_depth}, {}, "depth sign", "negative", "positive in front"),
    "y up": ({"change": flip}, {}, "motion", "'pixel y-up to-previous'", "--motion 'pixel y-up to-previous'"),
    "fractions": (
        {"change": as_fraction, "drop": ["position"]},
        {},
        "motion",
        "'fraction y-down to-previous'",
        "--motion 'fraction y-down to-previous'",
    ),
    "any motion": ({"change": scramble_motion}, {}, "motion", "no motion convention fits", "=none"),
    "vectors of 0": ({"change": no_vectors}, {}, "motion", "all 0, though the scene moves", "motion blur"),
    "vectors of 0, no positions": ({"change": no_vectors, "drop": ["position"]}, {}, "motion", "all 0", "motion blur"),
    "vectors of 0 of Cycles": (
        {"change": no_vectors},
        {"renderer": "cycles", "channel": {"radiance": "RGB", "motion": ["motion.X", "motion.Y"]}},
        "motion",
        "all 0",
        "Motion Blur",
    ),
    "vectors of 0, one box moves": (
        {"change": move_a_box, "speed": 0, "drop": ["position"]},
        {},
        "motion",
        "though something moves: ",
        "motion blur",
    ),
    "half the motion": ({"change": halve_motion, "speed": 3}, {}, "motion", "no motion convention fits", "=none"),
    "noisy motion": ({"change": jitter_motion, "speed": 3}, {}, "motion", "no motion convention fits", "=none"),
    "y up read as it is": ({"change": flip}, {"motion": "y-up"}, None, "", ""),
    "still": ({"speed": 0}, {}, "motion", "nothing moves", ""),
    "half positions": (
        {"change": far_away, "half": ["position"]},
        {"cameras": None},
        "half float",
        "steps of",
        "32-bit",
    ),
    "changing ids": ({"change": renumber}, {}, "history", "only 0 %", "ids"),
    "misspelt": (
        {"rename": ("albedo", "albdo [b]")},
        {},
        "no albedo",
        "will blur",
        "'albedo=albdo [b].R,albdo [b].G,albdo [b].B'",
    ),
    "hits too far away": ({"change": overflow, "half": ["depth"]}, {}, "guides", "were hit", "32-bit"),
    "too much emission": (
        {"change": glow, "rename": ("normal", "glow")},
        {"channel": {"emission": ["glow.X", "glow.Y", "glow.Z"]}},
        "emission",
        "more emission than",
        "without emission",
    ),
    "no surface": ({"change": empty}, {}, "background", "no pixel has a surface", "id, alpha"),
    "no motion": ({"drop": ["motion"], "cameras": False}, {}, "no motion", "trails", "--channel motion"),
    "ids in half": ({"change": many, "half": ["id"]}, {}, "reading", "above 2048", ""),
    "one frame": ({"numbers": [3]}, {}, "frames", "one frame only", "pattern"),
}


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("clean"))


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_is_found(tmp_path, case):
    written, opened, topic, text, change = CASES[case]
    found = inspected(write_room(tmp_path / "in", **({"numbers": range(3)} | written)), **opened)[1]
    if topic is None:
        assert found.keys() == {"no emission"}
        return
    assert topic in found, found
    assert text in found[topic].text
    assert change in found[topic].remedy
    assert found[topic].level == ("note" if case in ("still", "texture") else "warning")


def test_of_a_clean_sequence_nothing_is_to_mend(clean):
    facts, found = inspected(clean)
    assert found.keys() == {"no emission"}
    assert verdict(tuple(found.values())) == "ready"
    assert facts.light["radiance"].noise == pytest.approx(1, rel=0.1)
    assert facts.background == pytest.approx(64 / (SIZE[0] * SIZE[1]))
    assert facts.normals.best == ("world space",)
    assert facts.depth.best == ("view z",)
    assert [str(one) for one in facts.motion.fits] == ["pixel y-down to-previous"]
    assert 0.97 < facts.continuity.share < 1
    assert facts.read == (0, 1, 2)
    assert facts.samples is None


def test_motion_that_is_read_wrongly_is_told(clean):
    facts, _ = inspected(clean)
    for motion in (facts.motion, None):  # in screen space, or not
        for pixels, told in ((0.9, False), (2.5, True)):
            found = judge(facts._replace(motion=motion, warped=facts.warped._replace(pixels=pixels)))
            assert any(one.topic == "motion" and "2.5 pixels off" in one.text for one in found) == told


def test_guides_that_are_plain_tell_nothing_of_motion(clean):
    facts, _ = inspected(clean)
    plain = Residual(float("nan"), 1.0, (), 500)
    for others in ({}, {Convention(): plain}):
        found = {one.topic: one for one in judge(facts._replace(motion=Verdict({None: plain, **others}, ())))}
        assert found["motion"].level == "note"
        assert "too plain" in found["motion"].text


def test_without_cameras_and_positions_it_says_what_it_cannot_tell(tmp_path, capsys):
    folder = write_room(tmp_path, numbers=range(2), cameras=False, drop=["position", "depth"])
    code, out, _ = run(capsys, "inspect", folder)
    assert code == 0
    assert "cannot tell: no positions" in " ".join(out.split())
    assert "no depth: " not in out
    assert "can run, 1 thing to mend" in out


def test_of_the_sample_nothing_is_to_mend(capsys):
    code, out, _ = run(capsys, "inspect", sample(), "--strict")
    assert code == 0
    assert out.splitlines()[-1] == "ready"
    for text in (
        "1 (attribute spp)",
        "pixel y-down to-previous (fits): 0.00",
        "world space",
        "view z",
        "none missing",
        "zip",
    ):
        assert text in out


def test_errors_are_listed_and_fail(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    folder = write_room(tmp_path / "in", numbers=[0, 1, 2, 4])
    path = folder / "room.0002.exr"
    path.write_bytes(path.read_bytes()[:5000])
    code, out, _ = run(capsys, "inspect", folder)
    assert code == 2
    text = " ".join(out.split())
    assert "Frames 3 are missing" in text
    assert "room.0002.exr: the pixel data is cut off" in text
    assert out.splitlines()[-1].startswith("cannot run: 2 errors")
    path.unlink()
    code, out, _ = run(capsys, "inspect", folder, "--missing", "hold", "--json")
    assert code == 0
    assert json.loads(out)["scan"]["missing"] == [2, 3]


def test_strict_fails_on_warnings(tmp_path, capsys):
    folder = write_room(tmp_path, numbers=range(2), seed=1)
    assert run(capsys, "inspect", folder)[0] == 0
    code, out, _ = run(capsys, "inspect", folder, "--strict")
    assert code == 2
    assert "can run, 1 thing to mend" in out


def test_json_has_every_number(clean, capsys):
    code, out, _ = run(capsys, "inspect", clean, "--json")
    assert code == 0
    told = json.loads(out)
    assert told["verdict"] == "ready"
    assert told["motion"]["fits"] == ["pixel y-down to-previous"]
    assert told["motion"]["residuals"]["no motion at all"]["pixels"] > 1
    assert told["roles"]["layers"]["depth"]["channels"] == ["depth.Z"]
    assert told["findings"][0]["level"] == "note"
    assert told["light"]["radiance"]["fireflies"]["pixels"] < 0.01


def test_it_speaks_of_the_run_that_is_meant(clean, tmp_path, capsys):
    (tmp_path / "p.toml").write_text('preset = "adaptive"\n')
    told = {}
    for name, given in {
        "paper": (),
        "p.toml": ("--params", tmp_path / "p.toml"),
        "paper max_history=2.0": ("--set", "max_history=2.0"),
        "gaussian": ("--method", "gaussian"),
    }.items():
        told[name] = json.loads(run(capsys, "inspect", clean, "--json", *given)[1])
        assert told[name]["preset"] == name
    needs = {name: one["needs"]["seconds"] for name, one in told.items()}
    assert needs["p.toml"] > needs["paper"]
    assert told["paper max_history=2.0"]["history"] < told["paper"]["history"]
    assert told["gaussian"]["history"] is None


def test_text_from_files_is_never_markup(tmp_path, capsys):
    folder = write_room(tmp_path / "[red]x[bold]", numbers=range(2), attributes={"[blink]spp": 4.0})
    path = folder / "room.0001.exr"
    image = exr.read(path)
    exr.write(path, image._replace(channels={name: p for name, p in image.channels.items() if name != "R"}))
    code, out, _ = run(capsys, "inspect", folder)
    assert code == 2
    assert "[red]x[bold]" in re.sub(r"\s", "", out)  # long paths go over several lines
    assert "[blink]spp" in out


def test_names_do_not_steer_the_terminal(clean, tmp_path, capsys):
    """Those that are given by hand; in a file they are refused (tests/test_hostile_exr.py)."""
    given = ("--channel", "albedo=" + ",".join(f"\x1b[31mred.{c}" for c in "RGB"), "--dry-run", "-o", tmp_path / "out")
    for arguments in (("denoise", clean, *given), ("inspect", clean, "--channel", "id=\x1b[2J")):
        said = "".join(run(capsys, *arguments)[1:])
        assert "\x1b" not in said
        assert "\\x1b" in said


def test_each_correlation_has_its_own_limit(clean):
    facts, _ = inspected(clean)
    for value, texts in (
        (0.2, ["correlated noise", "independent noise"]),
        (0.4, ["correlated noise", "the same noise"]),
    ):
        facts = facts._replace(correlation=value, repeated=value)
        said = dict(_light(facts))
        assert [said[name].startswith(text) for name, text in zip(("neighbours", "frames"), texts, strict=True)] == [
            True
        ] * 2
        assert ("seed" in {one.topic for one in judge(facts)}) == (value > 0.3)


@pytest.mark.parametrize("columns", [80, 120])
def test_it_fits_the_terminal(clean, capsys, monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", str(columns))
    out = run(capsys, "inspect", clean)[1]
    assert max(map(len, out.splitlines())) <= columns
    assert "…" not in out


def test_it_needs_no_jax(clean):
    code = "import sys\nfrom svgf_jax.cli import main\ntry:\n    main(['inspect', sys.argv[1]])\nexcept SystemExit:\n    pass\n"
    code += "print(sorted({'jax', 'jaxlib'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code, str(clean)], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(("name", "motion"), [("cycles/multipart", "pixel y-up to-previous"), ("mitsuba", None)])
def test_files_that_renderers_wrote_are_understood(name, motion):
    """Their conventions are converted before the guides are judged, and judged as they are in the files for motion."""
    facts, found = inspected(Path(__file__).parent / "data" / name)
    assert facts.normals.best == ("world space",)
    assert facts.depth.best == ("view z",)
    assert found.keys() <= {"no id", "fireflies"}
    if motion is not None:
        assert motion in map(str, facts.motion.fits)
        assert facts.samples == ("cycles.ViewLayer.samples", 1)
