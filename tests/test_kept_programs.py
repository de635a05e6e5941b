"""What one command compiled the next one finds; what is damaged there, or not safe, does no harm."""

import os
import warnings
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


def test_the_next_run_finds_what_was_compiled_and_a_damaged_file_is_made_anew(caches, tmp_path, monkeypatch):
    said, first = denoise(tmp_path / "out")
    whole = kept(caches)
    assert len(whole) == 1
    assert MISS in said
    said, second = denoise(tmp_path / "out")
    assert MISS not in said
    assert (second, kept(caches)) == (first, whole)

    [path] = caches.rglob("jit_go*-cache")
    path.write_bytes(path.read_bytes()[:1000])
    monkeypatch.setenv("PYTHONWARNINGS", "error")
    said, third = denoise(tmp_path / "out")
    assert MISS in said
    assert third == first
    mended = kept(caches)
    assert mended.keys() == whole.keys()
    # Compiling does not give the same bytes each time.
    assert len(mended[path.name]) > 0.9 * len(whole[path.name]) > 2000


def test_a_folder_that_the_environment_names_is_taken(caches, tmp_path, monkeypatch):
    monkeypatch.setenv(kept_programs.VARIABLE, str(tmp_path / "elsewhere"))
    denoise(tmp_path / "out")
    assert kept(tmp_path / "elsewhere")
    assert not caches.exists()


def test_a_folder_that_cannot_be_made_does_not_matter(caches, tmp_path):
    caches.write_text("a file where the folder would be")
    denoise(tmp_path / "out")


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be told apart on this system")
def test_programs_for_other_numbers_of_cores_are_kept_apart(place, monkeypatch):
    for cores in ({0}, {0, 1}):
        monkeypatch.delenv(kept_programs.VARIABLE, raising=False)
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, cores=cores: cores)
        kept_programs.keep()
        assert os.environ[kept_programs.VARIABLE] == str(place / f"for-{len(cores)}-cores")


@pytest.fixture
def restored(caches, monkeypatch):
    """The folder of a user's caches; what `keep` sets in this process is put back."""
    monkeypatch.setattr("warnings.showwarning", None)
    for name in (kept_programs.VARIABLE, "TF_CPP_MIN_LOG_LEVEL"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    with warnings.catch_warnings():
        yield caches


@pytest.fixture
def place(restored):
    """Where programs are kept, with one there already."""
    place = restored / "svgf_jax"
    place.mkdir(parents=True, mode=0o700)
    (place / "for-3-cores").mkdir()
    (place / "for-3-cores" / "jit_a-1-cache").write_bytes(bytes(600))
    return place


@posix
@pytest.mark.parametrize(("mode", "left"), [(0o777, 0), (0o775, 0), (0o755, 1), (0o700, 1)])
def test_the_folder_is_closed_to_others_and_emptied_where_they_could_write(place, mode, left):
    place.chmod(mode)
    kept_programs.keep()
    assert os.environ[kept_programs.VARIABLE].startswith(str(place))
    assert len(list(place.iterdir())) == left
    assert place.stat().st_mode & 0o777 == 0o700


@posix
def test_what_is_another_users_is_neither_used_nor_touched(place, monkeypatch):
    place.chmod(0o777)
    monkeypatch.setattr(os, "geteuid", lambda: place.stat().st_uid + 1)
    kept_programs.keep()
    assert kept_programs.VARIABLE not in os.environ
    assert "TF_CPP_MIN_LOG_LEVEL" not in os.environ
    assert list(place.iterdir())
    assert place.stat().st_mode & 0o777 == 0o777


@pytest.mark.parametrize(("limit", "left"), [(600, 1), (599, 0)])
def test_of_too_much_nothing_is_kept(place, monkeypatch, limit, left):
    monkeypatch.setattr(kept_programs, "LIMIT", limit)
    kept_programs.keep()
    assert len(list(place.iterdir())) == left


@posix
def test_the_folder_is_closed_whatever_the_umask(restored):
    umask = os.umask(0)
    try:
        kept_programs.keep()
    finally:
        os.umask(umask)
    assert (restored / "svgf_jax").stat().st_mode & 0o777 == 0o700


@posix
def test_a_link_that_others_put_there_is_removed_and_not_what_it_leads_to(place, tmp_path):
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "jit_go-1-cache").write_bytes(b"")
    (place / "for-2-cores").symlink_to(tmp_path / "theirs")
    place.chmod(0o777)
    kept_programs.keep()
    assert not list(place.iterdir())
    assert list((tmp_path / "theirs").iterdir())


@pytest.mark.parametrize("filtered", ["error", "ignore", "always"])
def test_other_programs_stay_when_one_is_damaged_and_other_warnings_are_shown(place, monkeypatch, filtered):
    shown = []
    monkeypatch.setattr("warnings.showwarning", lambda message, *_: shown.append(str(message)))
    warnings.simplefilter(filtered)
    kept_programs.keep()
    folder = Path(os.environ[kept_programs.VARIABLE])
    folder.mkdir()
    for name in ("jit_a-1-cache", "jit_ab-1-cache", "jit_b-1-cache"):
        (folder / name).write_bytes(b"")
    warnings.warn("Error writing persistent compilation cache entry for 'jit_a': no room")
    assert sorted(path.name for path in folder.iterdir()) == ["jit_ab-1-cache", "jit_b-1-cache"]
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.warn("something else")
    assert shown == ["something else"]


def test_what_xla_says_of_found_programs_is_not_heard_unless_asked_for(place, monkeypatch):
    kept_programs.keep()
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "3"
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "0")
    monkeypatch.delenv(kept_programs.VARIABLE)
    kept_programs.keep()
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "0"
