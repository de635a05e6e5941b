"""How little of a sequence is in memory at a time."""

import jax
import numpy as np
import pytest
from shots import init, step, write_shot

from svgf_jax import memory, streaming
from svgf_jax.frames import open_source, read_frame


@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_jax_takes_arrays_as_they_are(dtype):
    given = np.arange(24 * 32 * 3, dtype=dtype).reshape(24, 32, 3)[:, ::2]
    (moved,) = memory.aligned([given])
    np.testing.assert_array_equal(moved, given)
    for array in (moved, memory.zeros((5, 7), dtype)):
        on_device = jax.device_put(array, jax.devices("cpu")[0])
        assert on_device.unsafe_buffer_pointer() == array.ctypes.data
        assert memory.aligned([array])[0] is array


def test_aligning_leaves_one_copy():
    arrays = [np.ones((3, 4)), None, np.ones(5)[1:]]
    assert [None if array is None else array.sum() for array in memory.aligned(arrays)] == [12, None, 4]
    assert arrays == []


def test_telling_the_c_library_never_fails(monkeypatch):
    memory.give_back_large()
    memory.give_back()
    monkeypatch.setattr(memory.ctypes, "CDLL", lambda name: object())
    memory.give_back()


def test_the_filter_gets_arrays_that_jax_takes_as_they_are(tmp_path):
    source, seen = open_source(write_shot(tmp_path / "in", [1])), []
    streaming.run(source, tmp_path / "out", pipeline=(init, step), on_output=lambda item, _: seen.append(item.frame))
    for name, array in read_frame(source, 0).frame._asdict().items():
        np.testing.assert_array_equal(array, getattr(seen[0], name))
        assert array is None or getattr(seen[0], name).ctypes.data % 64 == 0


def test_how_few_frames_are_there_at_a_time(tmp_path, monkeypatch):
    """With one thread: one is filtered, and either the one before it written or the next one read."""
    source, events = open_source(write_shot(tmp_path / "in", range(1, 9))), []

    def noted(what, function, number):
        def run(*arguments, **options):
            result = function(*arguments, **options)
            events.append((what, number(*arguments)))
            return result

        return run

    monkeypatch.setattr(streaming.frames, "read_frame", noted("read", read_frame, lambda source, index: index + 1))
    writes = noted("write", streaming.outputs.write_frame, lambda path, image: int(path.stem[-4:]))
    monkeypatch.setattr(streaming.outputs, "write_frame", writes)
    streaming.run(source, tmp_path / "out", pipeline=(init, step), threads=1)
    at = {event: i for i, event in enumerate(events)}
    assert len(at) == 16
    ahead = [
        max(number for what, number in events[:i] if what == "read") - j for (w, j), i in at.items() if w == "write"
    ]
    assert max(ahead) == 1
