"""What one command compiled the next one finds; what is damaged there, or not safe, does no harm."""

import os
from pathlib import Path

import pytest
from calling import command

from svgf_jax import kept_programs

SAMPLE = Path(kept_programs.__file__).parent / "sample"
MISS = "PERSISTENT COMPILATION CACHE MISS for 'jit_go'"
posix = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="folders of this system tell no owner")


@pytest.fixture
def caches(tmp_path, monkeypatch):
    """The folder of a user's caches, in which nothing is yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")  # the tests compile quickly
    monkeypatch.setenv("JAX_EXPLAIN_CACHE_MISSES", "1")
    monkeypatch.delenv(kept_programs.VARIABLE, raising=False)
    return tmp_path / "caches"


def kept(folder: Path) -> dict[str, bytes]:
    """What is kept of the step, by the name of its file."""
    return {path.name: path.read_bytes() for path in folder.rglob("jit_go*-cache")}


def denoise(out: Path) -> tuple[str, bytes]:
    """The standard error of a run, and what it wrote."""
    done = command(
        "denoise", SAMPLE, "-o", out, "--method", "gaussian", "--frames", "0-1", "--only-denoised", "--overwrite"
    )
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    return done.stderr, (out / "frame_0001.exr").read_bytes()


def test_the_next_run_finds_what_was_compiled_and_a_damaged_file_is_made_anew(caches, tmp_path):
    said, first = denoise(tmp_path / "out")
    whole = kept(caches)
    assert len(whole) == 1
    assert MISS in said
    said, second = denoise(tmp_path / "out")
    assert MISS not in said
    assert (second, kept(caches)) == (first, whole)

    [path] = caches.rglob("jit_go*-cache")
    path.write_bytes(path.read_bytes()[:1000])
    said, third = denoise(tmp_path / "out")
    assert MISS in said
    assert third == first
    assert kept(caches).keys() == whole.keys()
    said, fourth = denoise(tmp_path / "out")
    assert MISS not in said
    assert fourth == first


def test_a_folder_that_the_environment_names_is_taken(caches, tmp_path, monkeypatch):
    monkeypatch.setenv(kept_programs.VARIABLE, str(tmp_path / "elsewhere"))
    denoise(tmp_path / "out")
    assert kept(tmp_path / "elsewhere")
    assert not caches.exists()


def test_a_folder_that_cannot_be_made_does_not_matter(caches, tmp_path):
    caches.write_text("a file where the folder would be")
    denoise(tmp_path / "out")


def test_what_xla_says_of_found_programs_is_not_heard_unless_asked_for(caches, monkeypatch):
    monkeypatch.setenv(kept_programs.VARIABLE, "")  # nothing else is done
    for said, heard in ((None, "3"), ("0", "0")):
        monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", said or "")
        if said is None:
            monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL")
        kept_programs.keep()
        assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == heard


@pytest.fixture
def folder(caches, monkeypatch):
    """Where programs are kept, there already with one in it; and what `keep` sets is put back."""
    folder = caches / "svgf_jax" / "compiled"
    folder.mkdir(parents=True, mode=0o700)
    folder.parent.chmod(0o700)
    (folder / "a-cache").write_bytes(bytes(600))
    monkeypatch.setattr("warnings.showwarning", None)
    monkeypatch.setenv(kept_programs.VARIABLE, "")
    monkeypatch.delenv(kept_programs.VARIABLE)
    return folder


@posix
@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("mode", [0o777, 0o775])
def test_what_others_could_have_put_there_is_removed_and_the_folder_closed(folder, level, mode):
    place = (folder, folder.parent)[level]
    place.chmod(mode)
    kept_programs.keep()
    assert os.environ[kept_programs.VARIABLE] == str(folder)
    assert not list(folder.iterdir())
    assert place.stat().st_mode & 0o777 == 0o700


@posix
def test_what_is_another_users_is_neither_used_nor_touched(folder, monkeypatch):
    folder.chmod(0o777)
    monkeypatch.setattr(os, "geteuid", lambda: folder.stat().st_uid + 1)
    kept_programs.keep()
    assert kept_programs.VARIABLE not in os.environ
    assert list(folder.iterdir())
    assert folder.stat().st_mode & 0o777 == 0o777


@pytest.mark.parametrize(("limit", "left"), [(600, 1), (599, 0)])
def test_of_too_much_nothing_is_kept(folder, monkeypatch, limit, left):
    monkeypatch.setattr(kept_programs, "LIMIT", limit)
    kept_programs.keep()
    assert os.environ[kept_programs.VARIABLE] == str(folder)
    assert len(list(folder.iterdir())) == left
