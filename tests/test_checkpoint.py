import json
import pickle
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from svgf_jax import checkpoint
from svgf_jax.checkpoint import Checkpoint, state_folder
from svgf_jax.plan import begin, make_plan, written
from svgf_jax.types import History, SvgfError, TaaHistory

RNG = np.random.default_rng(0)
HISTORY = History(
    illumination=RNG.random((2, 4, 5, 3), np.float32),
    moments=RNG.random((2, 4, 5, 2), np.float32),
    history_length=RNG.random((4, 5), np.float32),
    depth=RNG.random((4, 5), np.float32),
    normal=RNG.random((4, 5, 3), np.float32),
    object_id=RNG.integers(-1, 9, (4, 5), np.int32),
)
IDENTITY = {"parameters": {"alpha": 0.2}, "config": {"levels": 5}, "frames": [[1, "a.1.exr", 10, 20], [2, None]]}


@pytest.fixture
def out(tmp_path):
    with checkpoint.lock(state_folder(tmp_path / "out")):
        yield tmp_path / "out"


TAA = TaaHistory(RNG.random((4, 5, 3), np.float32), np.float32(3))


FULL = HISTORY._replace(taa=TAA, effective_history=RNG.random((2, 4, 5), np.float32))


def every(history):
    return (*history._replace(taa=None), *(history.taa or ()))


@pytest.mark.parametrize("wanted", [HISTORY, FULL], ids=["plain", "with all there may be"])
def test_round_trip_is_exact(out, wanted):
    checkpoint.save_checkpoint(state_folder(out), IDENTITY, Checkpoint(1, wanted))
    index, history = checkpoint.load_checkpoint(state_folder(out), IDENTITY)
    assert index == 1
    assert type(history.taa) is type(wanted.taa)
    for saved, loaded in zip(every(wanted), every(history), strict=True):
        assert (saved is None) == (loaded is None)
        assert saved is None or saved.dtype == loaded.dtype
        np.testing.assert_array_equal(saved, loaded)


def test_a_checkpoint_without_history(out):
    checkpoint.save_checkpoint(state_folder(out), IDENTITY, Checkpoint(2, None))
    assert checkpoint.load_checkpoint(state_folder(out), IDENTITY) == (2, None)


def test_nothing_there(out):
    assert checkpoint.load_checkpoint(state_folder(out), IDENTITY) is None
    assert checkpoint.load_run(state_folder(out)) is None


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"parameters": {"alpha": 0.4}}, r"parameters\.alpha was 0\.2, and is 0\.4 now"),
        ({"config": {"levels": 5, "feedback_level": 0}}, r"config\.feedback_level was None, and is 0 now"),
        ({"frames": [[1, "a.1.exr", 11, 20], [2, None]]}, r"input frame 1 was .*10.* and is .*11"),
        ({"frames": []}, r"input frame 1 was .* and is None now"),
    ],
)
def test_a_checkpoint_of_another_computation_is_refused(out, changed, message):
    checkpoint.save_checkpoint(state_folder(out), IDENTITY, Checkpoint(1, HISTORY))
    with pytest.raises(SvgfError, match=message):
        checkpoint.load_checkpoint(state_folder(out), IDENTITY | changed)


def test_frames_still_to_come_may_change(out):
    checkpoint.save_checkpoint(state_folder(out), IDENTITY, Checkpoint(1, HISTORY))
    frames = [IDENTITY["frames"][0], [2, "a.2.exr", 10, 20], [3, "a.3.exr", 10, 20]]
    assert checkpoint.load_checkpoint(state_folder(out), IDENTITY | {"frames": frames}).next_index == 1


def damage(path, how):
    data = path.read_bytes()
    if how == "empty":
        path.write_bytes(b"")
    elif how == "cut":
        path.write_bytes(data[: len(data) // 2])
    elif how == "flipped":
        middle = data.index(b"illumination.npy") + 200
        path.write_bytes(data[:middle] + bytes(255 - b for b in data[middle : middle + 8]) + data[middle + 8 :])
    elif how == "text":
        path.write_text("not a checkpoint")
    elif how == "pickle":
        path.write_bytes(pickle.dumps({"next_index": 1}))
    elif how == "array":
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    elif how == "objects":
        np.savez(path, format=1, next_index=1, identity=np.array([{"a": 1}], dtype=object))
    elif how == "incomplete":
        identity = np.frombuffer(json.dumps(IDENTITY).encode(), np.uint8)
        np.savez(path, format=1, next_index=1, identity=identity, depth=HISTORY.depth)
    elif how == "later":
        np.savez(path, format=2, next_index=1)


@pytest.mark.parametrize(
    "how", ["empty", "cut", "flipped", "text", "pickle", "array", "objects", "incomplete", "later"]
)
def test_a_damaged_checkpoint_is_a_clear_error(out, how):
    checkpoint.save_checkpoint(state_folder(out), IDENTITY, Checkpoint(1, HISTORY))
    damage(out / ".svgf-jax" / "checkpoint.npz", how)
    with pytest.raises(SvgfError, match=r"Cannot resume from .*checkpoint\.npz.*--overwrite"):
        checkpoint.load_checkpoint(state_folder(out), IDENTITY)


def with_bad(array, value):
    changed = np.array(array)
    changed[(0,) * changed.ndim] = value
    return changed


NUMBERS = {  # what may be wrong in a file that is whole
    "illumination: scalar": {"illumination": np.float32(1)},
    "illumination: NaN": {"illumination": with_bad(HISTORY.illumination, np.nan)},
    "illumination: of text": {"illumination": np.full((2, 4, 5, 3), "a")},
    "illumination: of no signals": {"illumination": HISTORY.illumination[:0], "moments": HISTORY.moments[:0]},
    "moments: inf": {"moments": with_bad(HISTORY.moments, np.inf)},
    "moments: of one signal": {"moments": HISTORY.moments[:1]},
    "history_length: negative": {"history_length": with_bad(HISTORY.history_length, -1)},
    "depth: of another size": {"depth": HISTORY.depth[:3]},
    "depth: of another dtype": {"depth": HISTORY.depth.astype(np.float64)},
    "normal: NaN": {"normal": with_bad(HISTORY.normal, np.nan)},
    "object_id: real": {"object_id": HISTORY.depth},
    "taa: without its count": {"taa.color": TAA.color},
    "taa: NaN": {"taa.color": TAA.color, "taa.frames": np.float32(np.nan)},
    "taa: count of less than none": {"taa.color": TAA.color, "taa.frames": np.float32(-1)},
    "effective_history: of one signal": {"effective_history": FULL.effective_history[:1]},
    "effective_history: negative": {"effective_history": -FULL.effective_history},
    "another name": {"more": np.float32(1)},
    "next_index: a list": {"next_index": np.array([1])},
    "next_index: real": {"next_index": np.float64(1.5)},
    "next_index: beyond": {"next_index": np.array(9)},
    "identity: not one": {"identity": np.frombuffer(b"[]", np.uint8)},
    "identity: deep": {"identity": np.frombuffer(b"[" * 100000, np.uint8)},
}


@pytest.mark.parametrize("what", NUMBERS)
def test_numbers_that_no_run_leaves_are_refused(out, what):
    identity = np.frombuffer(json.dumps(IDENTITY).encode(), np.uint8)
    whole = HISTORY._asdict() | {"format": np.array(1), "next_index": np.array(1), "identity": identity}
    del whole["taa"], whole["effective_history"]
    path = state_folder(out) / "checkpoint.npz"
    np.savez(path, **whole)
    assert checkpoint.load_checkpoint(state_folder(out), IDENTITY).next_index == 1
    np.savez(path, **whole | NUMBERS[what])
    with pytest.raises(SvgfError, match=r"Cannot resume from .*checkpoint\.npz.*damaged.*--overwrite"):
        checkpoint.load_checkpoint(state_folder(out), IDENTITY)


@pytest.mark.parametrize("how", ["encrypted", "unknown method", "bomb", "header"])
def test_an_archive_that_promises_what_it_has_not_is_refused(out, how):
    path = state_folder(out) / "checkpoint.npz"
    identity = np.frombuffer(json.dumps(IDENTITY).encode(), np.uint8)
    if how == "bomb":
        np.savez_compressed(path, format=1, next_index=1, identity=identity, depth=np.zeros(10**6))
    elif how == "header":  # of an array of 8 TB
        with zipfile.ZipFile(path, "w") as archive, archive.open("depth.npy", "w") as file:
            np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    else:
        checkpoint.save_checkpoint(state_folder(out), IDENTITY, Checkpoint(1, HISTORY))
        data = bytearray(path.read_bytes())
        entry = data.index(b"PK\x01\x02")  # of the first array, in the directory
        data[entry + 8 : entry + 12] = b"\x01\0\0\0" if how == "encrypted" else b"\0\0\x63\0"
        path.write_bytes(data)
    tracemalloc.start()
    with pytest.raises(SvgfError, match=r"Cannot resume from .*checkpoint\.npz.*damaged.*--overwrite"):
        checkpoint.load_checkpoint(state_folder(out), IDENTITY)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 10**6


@pytest.mark.parametrize("text", ["deep", "", "{", "[]", '{"format": 9}', '{"format": 1, "identity": {}}'])
def test_a_damaged_record_is_a_clear_error(out, text):
    (out / ".svgf-jax" / "run.json").write_text("[" * 100000 if text == "deep" else text)
    with pytest.raises(SvgfError, match=r"Cannot resume from .*run\.json"):
        checkpoint.load_run(state_folder(out))


def test_a_second_run_is_kept_out(out):
    with (
        pytest.raises(SvgfError, match=r"Another run is writing into .*process \d+"),
        checkpoint.lock(state_folder(out)),
    ):
        pass


def test_the_lock_is_free_again_afterwards(tmp_path):
    for _ in range(2):
        with checkpoint.lock(state_folder(tmp_path)):
            pass


def test_an_unwritable_place_is_a_clear_error(tmp_path):
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file" / "out", "/proc/nothing/out"):
        with (
            pytest.raises(SvgfError, match="Cannot write into the output folder"),
            checkpoint.lock(state_folder(tmp_path / place)),
        ):
            pass


# What a run will write


@pytest.fixture
def files(tmp_path):
    for i in (1, 2, 4):
        (tmp_path / f"shot_v2.{i:04d}.EXR").write_text(str(i))
    return [(i, str(tmp_path / f"shot_v2.{i:04d}.EXR") if i != 3 else None) for i in (1, 2, 3, 4)]


def plan_of(files, out, **options):
    settings = {"hold": True, "png": False, "video": False, "identity": {"parameters": {"alpha": 0.2}}} | options
    return make_plan(files, out, **settings)


def test_outputs_keep_names_and_numbers(files, tmp_path):
    names = [f"shot_v2.{i:04d}" for i in (1, 2, 3, 4)]
    plan = plan_of(files, tmp_path / "out", png=True, video=True)
    assert [path.name for path in plan.outputs] == [f"{name}.exr" for name in names]
    assert [path.name for path in written(plan)] == [
        *(f"{name}{suffix}" for name in names for suffix in (".exr", ".png")),
        "shot_v2.mp4",
    ]
    assert [path and path.name for path in plan_of(files, tmp_path / "out", hold=False).outputs][2] is None


def test_an_output_never_replaces_an_input(files, tmp_path):
    names = [Path.rename(path, path.with_suffix(".exr")) for path in tmp_path.glob("*.EXR")]
    renamed = [(i, path and path.replace(".EXR", ".exr")) for i, path in files]
    assert names
    with pytest.raises(SvgfError, match="would replace an input"):
        plan_of(renamed, tmp_path)
    (tmp_path / "link").symlink_to(tmp_path)
    with pytest.raises(SvgfError, match="would replace an input"):
        plan_of(renamed, tmp_path / "link")


@pytest.mark.parametrize("name", ["out.exr", "out_####", "out_%04d"])
def test_the_output_is_a_folder(files, tmp_path, name):
    with pytest.raises(SvgfError, match="wanted a folder"):
        plan_of(files, tmp_path / name)


def test_nothing_to_hold(files, tmp_path):
    with pytest.raises(SvgfError, match=r"Frame 3 is missing.*none before"):
        plan_of(files[2:], tmp_path / "out")


def finish(plan, frames):
    for path in list(written(plan))[:frames]:
        path.write_text("done")


def test_existing_outputs_are_refused_unless_told(files, out):
    plan = plan_of(files, out)
    assert begin(plan, resume=False, overwrite=False) == (0, None)
    finish(plan, 2)
    with pytest.raises(
        SvgfError, match=r"shot_v2.0001.exr, shot_v2.0002.exr in .* exist already.*--resume.*--overwrite"
    ):
        begin(plan, resume=False, overwrite=False)
    assert begin(plan, resume=False, overwrite=True) == (0, None)
    with pytest.raises(SvgfError, match="Choose one"):
        begin(plan, resume=True, overwrite=True)


def test_resume_starts_where_the_checkpoint_says(files, out):
    plan = plan_of(files, out)
    assert begin(plan, resume=True, overwrite=False) == (0, None)
    finish(plan, 3)
    assert begin(plan, resume=True, overwrite=False) == (0, None)  # killed before the first checkpoint
    checkpoint.save_checkpoint(state_folder(out), plan.identity, Checkpoint(2, None))
    assert begin(plan, resume=True, overwrite=False) == (2, None)
    with pytest.raises(SvgfError, match=r"parameters\.alpha"):
        begin(plan_of(files, out, identity={"parameters": {"alpha": 0.3}}), resume=True, overwrite=False)
    plan.outputs[0].unlink()
    with pytest.raises(SvgfError, match=r"shot_v2.0001.exr, written before, is gone"):
        begin(plan, resume=True, overwrite=False)


def test_resuming_a_complete_run(files, out):
    plan = plan_of(files, out)
    begin(plan, resume=False, overwrite=False)
    finish(plan, 4)
    checkpoint.save_run(state_folder(out), plan.identity, complete=True)
    assert begin(plan, resume=True, overwrite=False) is None
    with pytest.raises(SvgfError, match=r"complete with 4 frames; the input has now 5"):
        begin(plan_of([*files, (5, None)], out), resume=True, overwrite=False)
    with pytest.raises(SvgfError, match=r"input frame 4 was"):
        begin(plan_of(files[:3], out), resume=True, overwrite=False)
    plan.outputs[3].unlink()
    with pytest.raises(SvgfError, match=r"shot_v2.0004.exr, written before, is gone"):
        begin(plan, resume=True, overwrite=False)


def test_foreign_outputs_are_not_resumed(files, out):
    plan = plan_of(files, out)
    finish(plan, 1)
    with pytest.raises(SvgfError, match="exists already"):
        begin(plan, resume=True, overwrite=False)


def test_leftovers_of_a_killed_run_are_removed_and_nothing_else(files, out):
    plan = plan_of(files, out)
    for name in (".shot_v2.0001.exr.12ab.tmp", ".other.exr.12ab.tmp", "shot_v2.0001.exr.tmp"):
        (out / name).write_text("")
    begin(plan, resume=False, overwrite=False)
    assert sorted(path.name for path in out.glob("*tmp")) == [".other.exr.12ab.tmp", "shot_v2.0001.exr.tmp"]
