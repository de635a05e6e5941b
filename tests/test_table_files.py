"""The tables of renderers themselves: those that come along, one of one's own, and what is wrong in one."""

import pytest
from test_renderers import H, W, planes, put

from svgf_jax import SvgfError
from svgf_jax.frames import open_source, read_frame
from svgf_jax.renderers import detect_renderer, load_table, renderer_names


@pytest.mark.parametrize("name", renderer_names())
def test_every_table_is_read(name):
    table = load_table(name)
    assert table.title
    if name != "native":
        assert table.detect


def test_native_names_are_native_and_nothing_is_nobody():
    assert detect_renderer(["direct.R", "N.X", "Z"]).name == "native"
    assert detect_renderer(["R", "G", "B", "A"]).name == "native"
    assert detect_renderer(["normal.X", "normal.Y", "normal.Z", "R", "mse.R"]).name == "native"


def test_a_table_of_ones_own(tmp_path):
    path = tmp_path / "studio.toml"
    path.write_text(
        'title = "Ours"\n[channels]\nmotion = ["*.flow.XY"]\nnormal = ["Nn.xyz"]\n[meaning]\nmotion = "ndc"\n'
    )
    channels = planes("", 1) | planes("lgt.flow", [0.5, 0.5], "XY") | planes("Nn", [0, 0, 2], "xyz")
    folder = put(tmp_path / "in", channels, "a_1.exr")
    source = open_source(folder, renderer=str(path))
    assert source.roles.renderer == "studio"
    frame = read_frame(source, 0).frame
    assert frame.motion[0, 0].tolist() == [W / 4, H / 4]
    put(folder, channels | planes("key.flow", 0, "XY"), "a_1.exr")
    with pytest.raises(
        SvgfError, match=r"several channels may be motion: .*key\.flow\.X,key\.flow\.Y.*--channel motion="
    ):
        open_source(folder, renderer=str(path))


WRONG = {
    # text of mine.toml -> (line, what is said)
    "[channels]\nalbedo = 3": (2, "channels.albedo = 3; wanted a text, or a list of texts"),
    "[channels]\nnormal = ['N.XYZ']\nalbdo = 'a.RGB'": (
        3,
        "no key 'albdo' in [channels]. Did you mean albedo? There are dir",
    ),
    "[files]\nmotoin = 'm#.exr'": (2, "no key 'motoin' in [files]. Did you mean motion?"),
    "[channels]\ncolor = 'RGB'": (2, "no key 'color' in [channels]. Did you mean radiance?"),
    "title = 'a'\nchanels = 3": (
        2,
        "no key 'chanels' in a table of a renderer. Did you mean channels? There are title, det",
    ),
    "[detect]\nchannel = 'a'": (2, "no key 'channel' in [detect]. Did you mean channels?"),
    "channels = 'a'": (1, "channels = 'a'; wanted a table"),
    "title = 3": (1, "title = 3; wanted a text"),
    "\n[[light]]\nchannels = ['a']": (2, "[[light]] without 'name'; wanted name, channels, albedo, divided"),
    "light = 'a'": (1, "light = 'a'; wanted tables, [[light]]"),
    "[[light]]\nname = 'a'\nchannels = 'a'\n\n[[light]]\nname = 'b'\nchannels = 'b'\nalbdo = 'b'": (
        8,
        "no key 'albdo' in [[light]]. Did you mean albedo?",
    ),
    "[[light]]\nname = 'a'\nchannels = 3": (3, "light.0.channels = 3; wanted a text, or a list of texts"),
    "layered = 'false'": (1, "layered = 'false'; wanted true or false"),
    "cameras = 'heder'": (1, "cameras = 'heder'; wanted header, or the name of a file"),
    "complete = ['emision']": (1, "no light or role 'emision' in complete. Did you mean emission?"),
    "uncertain = ['moton']": (1, "no role 'moton' in uncertain. Did you mean motion?"),
    "[channels]\nnormal = ['normal.XY']": (2, "normal = 'normal.XY'; wanted 3 channels: normal.XYZ"),
    "[meaning]\nid = 'none'": (2, "id means 'none'; wanted the number"),
    "[meaning]\nnormal = 'view'": (2, "normal means 'view'; wanted world, camera, camera y-down, camera z-back"),
    "[meaning]\nalbedo = 'sRGB'": (2, "no key 'albedo' in [meaning]. There are motion, depth"),
    "[meaning]\nmotion = 'up'": (2, "'up' is not known; wanted one each"),
    "a = ": (1, "not TOML"),
}


@pytest.mark.parametrize("text", WRONG)
def test_what_is_wrong_in_a_table_is_told_with_its_line(tmp_path, text):
    line, said = WRONG[text]
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(SvgfError) as error:
        load_table(str(path))
    assert str(error.value).startswith(f"{path}:{line}: ")
    assert said in str(error.value)


def test_renderers_that_are_not_known():
    with pytest.raises(
        SvgfError, match=r"called 'blender'\. Did you mean cycles\? There are native, arnold, bmfr, cycles"
    ):
        load_table("blender")


def test_what_a_table_of_ones_own_names_and_the_files_lack_is_told(tmp_path):
    """Its native name is looked for then, so that no light is lost; where a role is given by hand, nothing is said."""
    path = tmp_path / "mine.toml"
    path.write_text(
        '[channels]\ndirect = "nothere.RGB"\nnormal = "gone.XYZ"\n[[light]]\nname = "sun"\nchannels = "sun.RGB"\n'
    )
    folder = put(tmp_path / "in", planes("direct", 1) | planes("indirect", 2) | planes("depth", 4, "Z"), "a_1.exr")
    source = open_source(folder, renderer=str(path))
    assert source.roles.signals == ("direct", "indirect")
    said = [text for text in source.warnings if text.startswith(f"{path}: ")]
    assert (
        "direct is nothere.RGB there, but the files have no such channels; taken is direct.RGB, the native name"
        in said[0]
    )
    assert "normal is gone.XYZ there, but the files have no such channels; there is no normal" in said[1]
    assert "light sun is sun.RGB there" in said[2]
    source = open_source(folder, renderer=str(path), channel={"direct": ["direct.R", "direct.G", "direct.B"]})
    assert not any("direct is" in text for text in source.warnings)
