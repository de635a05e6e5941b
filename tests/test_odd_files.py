"""Files that are none, and text files that would take a reader down: refused with their name, at once."""

import os

import pytest

from svgf_jax import SvgfError, cameras, exr, matrices, parameters
from svgf_jax.camera_files import cameras_of_c_header
from svgf_jax.cameras import load_cameras
from svgf_jax.sequences import Sequence
from svgf_jax.toml import LARGEST, read_toml


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x = " + "[" * 9000, "p.toml: can't be read as TOML: maximum recursion"),
        ("x = " + "[" * 100_000, r"p.toml:1: a line of 100004 characters; wanted at most 10000"),
        ("[params]\nalpha = " + "1" * 6000, r"p.toml: can't be read as TOML: Exceeds the limit \(4300"),
        ("[params]\nsigma_depth = " + "1" * 4000, "p.toml: an integer of more than 64 bits"),
        ("schema = 0x" + "f" * 5000, "p.toml: an integer of more than 64 bits"),
        ("[provenance]\nx." + "a." * 120 + "b = 1", "p.toml: tables or lists nested more than 100 deep"),
        ("x = 1\n" + "# long\n" * (LARGEST // 7), "p.toml: 1000005 bytes; wanted a parameter file, of at most 1000000"),
        ("x = '\udcff'", "p.toml: can't be read as text: 'utf-8' codec"),
    ],
    ids=lambda text: text[:20],
)
def test_a_parameter_file_that_is_something_else_is_refused(text, said, tmp_path):
    path = tmp_path / "p.toml"
    path.write_text(text, errors="surrogateescape")
    with pytest.raises(SvgfError, match=said):
        parameters.load_params(path)


def test_an_integer_that_no_float_holds_is_refused():
    with pytest.raises(SvgfError, match="wanted"):
        parameters.override(*parameters.preset("paper"), {"sigma_depth": 10**400})


MATRIX = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[" * 100_000, "c.json: not valid JSON .*recursion"),
        ("1" * 6000, "c.json: not valid JSON"),
        (f'{{"per_frame":[{{"frame":0,"world_to_camera":{MATRIX.replace("1]]", "1" * 4000 + "]]")}}}]}}', "is wrong"),
        (
            f'{{"per_frame":[{{"frame":0,"world_to_camera":{MATRIX},"camera_to_screen":{MATRIX},'
            f'"object_motion":{{"--7":{MATRIX}}}}}]}}',
            '"object_motion" wants matrices by object id',
        ),
    ],
    ids=["nested", "digits", "integer", "id"],
)
def test_a_cameras_json_that_is_something_else_is_refused(text, said, tmp_path):
    path = tmp_path / "c.json"
    path.write_text(text)
    with pytest.raises(SvgfError, match=said):
        cameras.load_cameras(path)


READERS = {
    "a_1.exr": exr.read,
    "header_1.exr": exr.read_header,
    "p.toml": parameters.load_params,
    "svgf-jax.toml": lambda path: read_toml(path, "project file"),
    "c.json": load_cameras,
    "c.h": lambda path: cameras_of_c_header(str(path), (0,), (2, 2)),
    "matrix_1.mat": lambda path: matrices.load_matrices(Sequence(((1, str(path)),), "m", 0, "hold")),
}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
@pytest.mark.parametrize("name", READERS)
def test_a_named_pipe_is_refused_and_not_waited_for(name, tmp_path):
    path = tmp_path / name
    os.mkfifo(path)
    with pytest.raises(SvgfError, match=f"{name}.*it is a named pipe; wanted a regular file"):
        READERS[name](path)


def test_a_device_is_refused():
    with pytest.raises(SvgfError, match="/dev/null.*it is a device; wanted a regular file"):
        parameters.load_params(os.devnull)
