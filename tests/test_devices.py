"""One frame over several devices gives what one device gives. Presets, derivatives and times: tests/bench/devices.py."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from shots import write_shot
from test_dry_run import run as command

from svgf_jax.compiled import check_devices
from svgf_jax.devices import rows_of_each
from svgf_jax.methods import method
from svgf_jax.types import Config, SvgfError

TESTS = Path(__file__).parent


def told(*arguments):
    environment = os.environ | {"PYTHONPATH": f"{TESTS.parent}", "JAX_NUM_CPU_DEVICES": "4"}
    strict = {"JAX_NUMPY_DTYPE_PROMOTION": "strict", "JAX_NUMPY_RANK_PROMOTION": "raise"}
    call = [sys.executable, "-W", "error", str(TESTS / "over_devices.py"), *arguments]
    done = subprocess.run(call, env=environment | strict, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_rows_of_other_devices_are_read_as_ones_own():
    differences = told("readings")
    assert len(differences) == 5
    assert max(differences.values()) < 1e-6, differences


def test_a_step_is_the_same_over_three_devices():
    """Of the preset with the most stages; of 21 rows the last device has 5, and 3 that are beyond."""
    assert told("steps")["adaptive"] < 1e-5


def test_each_device_gets_whole_cells():
    assert rows_of_each(1080, 4, Config()) == 270
    assert rows_of_each(1080, 4, Config(light_cell=4)) == 272
    assert rows_of_each(5, 4, Config()) == 2


def test_what_cannot_be_divided_is_told_at_once(tmp_path, capsys):
    write_shot(tmp_path / "in", [1])
    code, _, error = command(capsys, "denoise", tmp_path / "in", "-o", tmp_path / "out", "--devices", "0")
    assert (code, "wanted 1 or more" in error) == (2, True)
    assert not (tmp_path / "out").exists()
    with pytest.raises(SvgfError, match="only svgf divides a frame"):
        check_devices(method("gaussian")[1], None, 2)
    with pytest.raises(SvgfError, match="wanted a kind, cpu or gpu"):
        check_devices(Config(), "gpu:1", 2)
    check_devices(Config(), "gpu:1", 1)
