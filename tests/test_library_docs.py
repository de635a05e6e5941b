"""The page on the library says what is so: its examples run, one after another, and print what they say."""

import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

DOCS = Path(__file__).parents[1] / "svgf_jax" / "docs"
PAGE = (DOCS / "library.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"^```python\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)
(MATRICES,) = re.findall(r"```python\n(.*?)```", (DOCS / "renderers.md").read_text(encoding="utf-8"), flags=re.DOTALL)


class Film(dict):
    """What `mitsuba.load_dict` gives here: the description itself, with an integrator's names and a scene's sensor."""

    def aov_names(self):
        inner = [f"{key}.{letter}" for key, value in self.items() if isinstance(value, dict) for letter in "RGBA"]
        letters = {"albedo": "RGB", "sh_normal": "XYZ", "depth": "T", "position": "XYZ", "shape_index": "I"}
        pairs = [aov.split(":") for aov in self["aovs"].split(",")]
        return [*inner, *(f"{name}.{letter}" for name, kind in pairs for letter in letters[kind])]

    def sensors(self):
        return [self]

    def film(self):
        return SimpleNamespace(size=lambda: self.size, crop_size=lambda: self.size, crop_offset=lambda: (0, 0))

    @property
    def size(self):
        film = self["sensor"]["film"]
        return film["width"], film["height"]

    near_clip = far_clip = lambda self: 1.0


def stand_in():
    """As much of Mitsuba as the example calls: a camera before a wall at z 0, moving sideways."""
    at = {"sensor.to_world": np.eye(4)}

    def look_at(origin, target, up):
        pose = np.diag([-1.0, 1.0, -1.0, 1.0])
        pose[:3, 3] = origin
        return pose

    def render(scene, *, integrator, spp, seed):
        width, height = scene.size
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        eye = at["sensor.to_world"][:3, 3]
        wall = np.stack([eye[0] + (x / width - 0.5) * eye[2], eye[1] - (y / height - 0.5) * eye[2], 0 * x], -1)
        ones, distance = np.ones((height, width, 3)), np.linalg.norm(wall - eye, axis=-1)
        noise = np.random.default_rng(seed).random((height, width, 1))
        return np.dstack([noise * ones, 0 * ones, ones, ones * [0, 0, 1], distance, wall, 0 * x + 3]).astype(np.float32)

    view = np.array(
        [[1, 0, 0.5, 0], [0, 1, 0.5, 0], [0, 0, 1, 0], [0, 0, 1, 0]]
    )  # to the picture's widths, where x points left
    flip = np.diag([-1.0, -1.0, 1.0, 1.0])
    return SimpleNamespace(
        set_variant=lambda name: None,
        load_dict=Film,
        cornell_box=lambda: {"sensor": {"film": {}}},
        traverse=lambda scene: Parameters(at, scene),
        ScalarTransform4f=lambda: SimpleNamespace(look_at=look_at),
        perspective_projection=lambda *_: SimpleNamespace(matrix=view @ flip),
        render=render,
    )


class Parameters:
    """`mitsuba.traverse`: keys of the scene, and those of the sensor where it is one."""

    def __init__(self, at, scene):
        self.at = at

    def __getitem__(self, key):
        return SimpleNamespace(matrix=self.at["sensor.to_world"]) if key == "to_world" else None

    def __setitem__(self, key, value):
        self.at[key] = value

    def update(self):
        pass


def run(examples, names, capsys):
    for example in examples:
        exec(compile(example, "library.md", "exec"), names)
        printed = capsys.readouterr().out.splitlines()
        assert printed == re.findall(r"^print\(.*\)  # (.*)$", example, flags=re.MULTILINE), example


def test_the_examples_run(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "mitsuba", stand_in())
    names = {}
    exec(MATRICES, names)
    run(EXAMPLES, names, capsys)
    motion = names["shots"][1].motion
    np.testing.assert_allclose(motion, np.broadcast_to([0.05 / 3.9 * 32, 0.0], motion.shape), atol=1e-4)
    assert np.abs(names["to_radiance"]).max() > 0
    assert all(slope != 0 for slope in names["slopes"].values())


def test_mitsuba_itself_runs_its_example(capsys):
    pytest.importorskip("mitsuba", reason="mitsuba is not installed; the example runs on a stand-in all the same")
    names = {}
    exec(MATRICES, names)
    (example,) = [text for text in EXAMPLES if "mitsuba" in text]
    exec(EXAMPLES[0], names)
    capsys.readouterr()
    run([example], names, capsys)
    first, second = names["shots"]
    assert (second.object_id != -1).any()
    assert (
        0.1 < np.ptp(second.motion[..., 0][second.object_id != -1]) < 1
    )  # the camera goes round the middle of the box
    assert first.emission.max() > 1
