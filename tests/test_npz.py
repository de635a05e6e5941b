import numpy as np
import pytest

from svgf_jax.npz import read_arrays


def test_what_was_saved_is_read(tmp_path):
    saved = {"a": np.arange(6.0).reshape(2, 3), "text": np.array("ä"), "one": np.array(7, np.int32)}
    np.savez(tmp_path / "a.npz", **saved)
    found = read_arrays(tmp_path / "a.npz")
    assert found.keys() == saved.keys()
    for name, array in saved.items():
        np.testing.assert_array_equal(found[name], array, strict=True)


def test_what_would_fill_the_memory_is_refused(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros(10**6))
    with pytest.raises(ValueError, match="larger than the file"):
        read_arrays(tmp_path / "a.npz")


def test_only_a_missing_file_is_told_apart(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_arrays(tmp_path / "none.npz")
    (tmp_path / "a.npz").write_bytes(b"PK\x03\x04 and no more")
    for path in (tmp_path / "a.npz", tmp_path):
        with pytest.raises(ValueError, match=r"\w"):
            read_arrays(path)
