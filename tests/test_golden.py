"""Determinism: the golden set, and that nothing about how a run is organised changes a bit."""

import golden
import numpy as np
import pytest
from shots import init, step, write_shot

from svgf_jax import streaming
from svgf_jax.frames import open_source


def test_what_presets_make_of_a_real_crop_stays_what_it_was():
    """Compiled quickly, as all tests are: that differs by less than 2e-6. tests/golden.py itself does `adaptive` too."""
    lines, good = golden.compare(golden.outputs(("paper", "tuned", "falcor")))
    assert good, "\n".join(lines)


def test_a_difference_is_found_and_told_with_its_place():
    then, tolerance, _ = golden.load()
    assert set(tolerance) == set(golden.LAYERS)
    assert set(then) == {f"{preset}.{layer}" for preset in golden.PRESETS for layer in golden.LAYERS}
    assert golden.compare(then)[1]
    now = {name: array.copy() for name, array in then.items()}
    now["paper.image"][3, 5, 1] *= 1.01
    now["tuned.variance"][0, 2, 2] = np.nan
    lines, good = golden.compare(now)
    assert not good
    wrong = [line for line in lines if "BEYOND (1 of" in line]
    assert [line.split()[0] for line in wrong] == ["paper.image", "tuned.variance"]
    assert "at [3, 5, 1]" in wrong[0]


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    return write_shot(tmp_path_factory.mktemp("shot"), range(1, 8), layers=False)


@pytest.mark.parametrize(("threads", "every"), [(1, 1), (2, 3), (3, 100), (4, 2)])
def test_threads_and_checkpoints_change_nothing(shot, tmp_path, threads, every):
    def made(name, **options):
        streaming.run(open_source(shot), tmp_path / name, pipeline=(init, step), **options)
        return {path.name: path.read_bytes() for path in (tmp_path / name).glob("*.exr")}

    assert made("a", threads=threads, checkpoint_every=every) == made("b")
