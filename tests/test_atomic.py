import os
import stat

import pytest

from svgf_jax import atomic
from svgf_jax.commands.results import require_writable, save
from svgf_jax.types import SvgfError


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("unique", [True, False])
def test_a_file_appears_complete(tmp_path, unique):
    with atomic.replacing(tmp_path / "a.txt", unique=unique) as temporary:
        temporary.write_text("new")
        assert temporary.parent == tmp_path
        assert temporary.name.startswith(".a.txt.")
        assert temporary.name.endswith(".tmp")
        assert not (tmp_path / "a.txt").exists()
    assert (tmp_path / "a.txt").read_text() == "new"
    assert names(tmp_path) == ["a.txt"]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    atomic.write_text(tmp_path / "a.txt", "old é\n")
    with pytest.raises(OSError), atomic.replacing(tmp_path / "a.txt") as temporary:  # noqa: PT011 (any)
        (temporary / "under a file").touch()
    assert (tmp_path / "a.txt").read_bytes() == "old é\n".encode()
    assert names(tmp_path) == ["a.txt"]


def test_what_is_written_is_flushed_before_it_is_renamed_and_the_name_after(tmp_path, monkeypatch):
    seen, fsync = [], os.fsync

    def flush(descriptor):
        kind = "folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file"
        seen.append((kind, (tmp_path / "a.txt").exists()))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", flush)
    atomic.write_text(tmp_path / "a.txt", "x")
    assert seen == [("file", False), ("folder", True)]


def test_what_a_killed_process_left_is_written_over(tmp_path):
    (tmp_path / ".a.txt.tmp").write_text("left over")
    with atomic.replacing(tmp_path / "a.txt", unique=False) as temporary:
        temporary.write_text("new")
    assert names(tmp_path) == ["a.txt"]


def test_what_cannot_be_written_is_known_before(tmp_path):
    atomic.require_writable(tmp_path / "a.txt")
    with pytest.raises(IsADirectoryError):
        atomic.require_writable(tmp_path)
    for do in (atomic.require_writable, lambda path: atomic.write_text(path, "")):
        with pytest.raises(FileNotFoundError):
            do(tmp_path / "nowhere" / "a.txt")
    assert names(tmp_path) == []


def test_the_folders_of_a_result_are_made_when_it_is_written(tmp_path):
    page = tmp_path / "clean" / "today" / "report.html"
    require_writable((page, None), overwrite=False)
    assert list(tmp_path.iterdir()) == []
    save(page, "text")
    assert [path.name for path in page.parent.iterdir()] == ["report.html"]
    for path in (page, page / "a.html", page / "a" / "b.html"):
        with pytest.raises(SvgfError, match="exists already|Could not write"):
            require_writable((path,), overwrite=False)
