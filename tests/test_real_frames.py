"""From files to frames: the real sequences, where they are here."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from svgf_jax.frames import open_source, read_frame
from svgf_jax.references import load_reference, read_radiance


@pytest.mark.parametrize("name", ["cornell-dolly", "gallery-pan", "lights-flicker"])
def test_the_real_sequences(data, name):
    source = open_source(data / name)
    assert source.warnings == ()
    item = read_frame(source, 4)
    assert item.counts.keys() <= {"guides"}
    assert item.notes == ()
    frame = item.frame
    assert all(np.isfinite(array).all() for array in frame if array is not None)
    surface = frame.object_id != -1
    np.testing.assert_array_equal(surface, item.image.channels["id.I"] != -1)
    np.testing.assert_allclose(np.linalg.norm(frame.normal[surface], axis=-1), 1, atol=1e-6)
    apart = np.abs(frame.prev_depth - frame.depth)[surface] / frame.depth[surface]
    assert apart.max() > 1e-3 if name != "lights-flicker" else apart.max() < 1e-4
    total = frame.radiance.sum(0) + frame.emission
    np.testing.assert_allclose(read_radiance(item.path), total, rtol=1e-6)


def test_a_real_frame_in_threads_is_the_same(data):
    source = open_source(data / "cornell-dolly", frames="0-3")
    alone = [read_frame(source, i).frame for i in range(4)]
    with ThreadPoolExecutor(4) as pool:
        for one, other in zip(alone, pool.map(lambda i: read_frame(source, i).frame, range(4)), strict=True):
            for a, b in zip(one, other, strict=True):
                np.testing.assert_array_equal(a, b)


def test_the_real_references(data):
    assert load_reference(data / "cornell-dolly", frames="0-2").shape == (3, 270, 480, 3)


def test_the_homework_scene_by_hand(data):
    folder = data / "games202-box" / "input"
    files = {
        role: folder / f"{name}_#.exr" for role, name in {"normal": "normal", "depth": "depth", "id": "ID"}.items()
    }
    source = open_source(folder / "beauty_#.exr", file=files)
    frame = read_frame(source, 1).frame
    assert frame.radiance.shape == (1, 512, 512, 3)
    assert -1 in frame.object_id
    assert frame.object_id.max() == 6
