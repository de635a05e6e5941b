"""What may lie in a state folder by now: nobody waits for it, believes it, or writes through it."""

import os

import pytest

from svgf_jax import SvgfError, checkpoint, filing
from svgf_jax.plan import check_writable, find_start, locked, make_plan


def test_a_missing_frame_is_not_held_in_a_folder_that_is_anothers_by_now(tmp_path):
    (tmp_path / "a_1.exr").touch()
    files = [(1, str(tmp_path / "a_1.exr")), (2, None)]
    plan = make_plan(files, tmp_path / "out", hold=True, png=False, video=False, identity={})
    with locked(plan) as still:
        work = filing.Work(None, plan, None, {}, None, still)
        plan.outputs[0].touch()
        assert filing.fill_gap(work, 1).status == "held"
        plan.outputs[1].unlink()
        (plan.state / "lock").unlink()
        with pytest.raises(SvgfError, match="the output folder was removed"):
            filing.fill_gap(work, 1)
    assert not plan.outputs[1].exists()


def test_a_folder_in_the_place_of_an_output_is_known_before_the_first_is_written(tmp_path):
    (tmp_path / "a_1.exr").touch()
    files = [(1, str(tmp_path / "a_1.exr"))]
    plan = make_plan(files, tmp_path / "out", hold=True, png=True, video=False, identity={})
    (plan.out / "a_1.png").mkdir(parents=True)
    for options in ({"overwrite": True, "resume": False}, {"overwrite": False, "resume": True}):
        with pytest.raises(SvgfError, match="a_1.png in .*: a folder in the place of an output"):
            find_start(plan, **options)


def test_a_link_to_nowhere_is_no_output_folder(tmp_path):
    (tmp_path / "out").symlink_to(tmp_path / "nowhere")
    with pytest.raises(SvgfError, match="out is not a folder"):
        check_writable(tmp_path / "out")


@pytest.mark.parametrize("put", ["pipe", "device"])
def test_nobody_waits_for_a_pipe_or_reads_a_device(tmp_path, put):
    for name in ("lock", "run.json", "frames.jsonl", "checkpoint.npz"):
        if put == "pipe":
            os.mkfifo(tmp_path / name)
        else:
            (tmp_path / name).symlink_to("/dev/zero")
    assert not checkpoint.is_held(tmp_path)
    assert checkpoint.holder(tmp_path) == ""
    assert checkpoint.load_figures(tmp_path) == {}
    said = f"it is a {'named pipe' if put == 'pipe' else 'device'}"
    for read in (checkpoint.load_run, lambda state: checkpoint.load_checkpoint(state, {})):
        with pytest.raises(SvgfError, match=rf"{tmp_path}/.*{said}.*--overwrite"):
            read(tmp_path)
    with pytest.raises(SvgfError, match=f"{tmp_path}/frames.jsonl: {said}"):
        checkpoint.append_figures(tmp_path, {"number": 1})
    with pytest.raises(SvgfError, match=said if put == "pipe" else "is a symbolic link"):
        checkpoint.lock(tmp_path).__enter__()


def test_lines_that_no_run_wrote_count_for_nothing(tmp_path):
    sound = '{"number": 7, "status": "held", "path": null, "counts": {"normal": 3}, "notes": [], "seconds": 0.5}'
    wrong = [
        "[" * 100_000,
        "7",
        '{"status": "held"}',
        '{"number": Infinity}',
        '{"number": "7"}',
        '{"number": 7, "seconds": NaN}',
        '{"number": 7, "seconds": "1"}',
        '{"number": 7, "history": -Infinity}',
        '{"number": 7, "counts": [1]}',
        '{"number": 7, "counts": {"normal": "3"}}',
        f'{{"number": 7, "counts": {{"normal": 1{"0" * 4000}}}}}',
        '{"number": 7, "status": ["<script>"]}',
    ]
    (tmp_path / "frames.jsonl").write_text("\n".join([sound, *wrong]))
    assert checkpoint.load_figures(tmp_path)[7]["counts"] == {"normal": 3}
    assert list(checkpoint.load_figures(tmp_path)) == [7]


@pytest.mark.parametrize(
    "record", ['{"format": 1, "complete": "no", "identity": {"frames": []}}', "[" * 10_000, "null", "7", "[1, 2, 3]"]
)
def test_a_record_that_no_run_wrote_is_refused(tmp_path, record):
    (tmp_path / "run.json").write_text(record)
    with pytest.raises(SvgfError, match="run.json: it is damaged or of another version") as told:
        checkpoint.load_run(tmp_path)
    assert not any(word in str(told.value) for word in ("indices", "subscript", "recursion"))


def test_a_record_of_another_version_beside_a_whole_checkpoint_is_refused(tmp_path):
    (tmp_path / "a_1.exr").touch()
    files = [(1, str(tmp_path / "a_1.exr"))]
    plan, older = (
        make_plan(files, tmp_path / "out", hold=True, png=False, video=False, identity={"version": version})
        for version in ("2", "1")
    )
    plan.state.mkdir(parents=True)
    checkpoint.save_checkpoint(plan.state, plan.identity, checkpoint.Checkpoint(0, None))
    checkpoint.save_run(plan.state, older.identity, complete=False)
    with pytest.raises(SvgfError, match="version was 1, and is 2 now"):
        find_start(plan, resume=True, overwrite=False)
    checkpoint.save_run(plan.state, plan.identity, complete=False)
    assert find_start(plan, resume=True, overwrite=False).next_index == 0
