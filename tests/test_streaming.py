import threading

import numpy as np
import pytest
from shots import SIZE, init, step, write_frame, write_shot

from svgf_jax import exr, streaming
from svgf_jax.frames import open_source, read_frame
from svgf_jax.outputs import WriteOptions
from svgf_jax.types import Config, History, Params, SvgfError


@pytest.fixture
def shot(tmp_path):
    return write_shot(tmp_path / "in")


def run(source, out, **options):
    source = open_source(source) if isinstance(source, str) else source
    return streaming.run(source, out, pipeline=(init, step), **options)


def by_hand(pattern, params=None):
    """What the stand-in filter gives, frame by frame, without streaming."""
    source, history, images = open_source(pattern), None, []
    for i in range(len(source.sequence.files)):
        frame = read_frame(source, i).frame
        history, output = step(
            init(frame) if history is None else history, frame, params=params or Params(), config=Config()
        )
        images.append(np.asarray(output.image))
    return images


def colour(path):
    channels = exr.read(path).channels
    return np.stack([channels[c] for c in "RGB"], -1)


def contents(folder):
    """Name -> bytes of every visible file."""
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*")) if path.is_file()}


def test_frames_keep_their_numbers_and_the_history_runs_through(shot, tmp_path):
    reports = []
    summary = run(shot, tmp_path / "out", on_frame=reports.append, options=WriteOptions(full_float=True))
    assert [path.name for path in sorted((tmp_path / "out").glob("*"))] == [".svgf-jax"] + [
        f"shot.{i:04d}.exr" for i in range(1, 8)
    ]
    for number, wanted in enumerate(by_hand(shot), start=1):
        np.testing.assert_allclose(colour(tmp_path / "out" / f"shot.{number:04d}.exr"), wanted, rtol=1e-6, atol=1e-7)
    assert [report.number for report in reports] == list(range(1, 8))
    assert summary.statuses == {"filtered": 7}
    assert (summary.frames, summary.resumed_at, summary.interrupted) == (7, 0, False)
    assert summary.device.startswith("cpu")
    assert not (tmp_path / "out" / ".svgf-jax" / "checkpoint.npz").exists()


def test_layers_types_windows_and_attributes_pass_through(tmp_path):
    write_shot(tmp_path / "in", [1])
    path = tmp_path / "in" / "shot.0001.exr"
    height, width = SIZE
    crop = exr.read(path)._replace(data_window=(5, 6, 4 + width, 5 + height), display_window=(0, 0, 99, 49))
    exr.write(path, crop)
    run(str(path), tmp_path / "out", options=WriteOptions(diagnostics=True), preset="paper")
    before, after = exr.read(path), exr.read(tmp_path / "out" / path.name)
    assert (after.data_window, after.display_window) == (before.data_window, before.display_window)
    for name, pixels in before.channels.items():
        assert after.channels[name].dtype == pixels.dtype
        np.testing.assert_array_equal(after.channels[name], pixels)
    added = after.channels.keys() - before.channels.keys()
    assert added == {*"RGB", "svgf.variance.direct", "svgf.variance.indirect", "svgf.history_length", "svgf.valid"}
    assert {after.channels[name].dtype.name for name in added} == {"float16"}
    assert after.attributes["comments"] == "take [bold]1[/bold]"
    assert after.attributes["svgf_jax:preset"] == "paper"
    assert '"sigma_normal": 128.0' in after.attributes["svgf_jax:parameters"]
    assert after.attributes["svgf_jax:source"] == str(path)
    assert after.attributes["svgf_jax:version"]


def test_only_denoised_drops_the_rest(shot, tmp_path):
    run(shot, tmp_path / "out", options=WriteOptions(only_denoised=True, full_float=True, compression="piz"))
    image = exr.read(tmp_path / "out" / "shot.0002.exr")
    assert set(image.channels) == set("RGB")
    assert {pixels.dtype.name for pixels in image.channels.values()} == {"float32"}
    assert not any(name in image.attributes for name in ("comments", "iso", "shot"))


def test_pictures_and_video(shot, tmp_path):
    pytest.importorskip("av")
    summary = run(shot, tmp_path / "out", options=WriteOptions(png=True), video=True)
    names = set(contents(tmp_path / "out"))
    assert names == {f"shot.{i:04d}.{kind}" for i in range(1, 8) for kind in ("exr", "png")} | {"shot.mp4"}
    assert summary.video == tmp_path / "out" / "shot.mp4"


def test_an_interrupted_video_is_made_by_resuming_without_filtering_again(shot, tmp_path, monkeypatch):
    pytest.importorskip("av")

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(streaming.preview, "write_video", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run(shot, tmp_path / "out", video=True)
    summary = run(shot, tmp_path / "out", video=True, resume=True)
    assert (summary.resumed_at, summary.statuses) == (7, {})
    assert (tmp_path / "out" / "shot.mp4").exists()


def test_existing_outputs_are_never_replaced_unasked(shot, tmp_path):
    run(shot, tmp_path / "out")
    before = contents(tmp_path / "out")
    with pytest.raises(SvgfError, match=r"shot\.0001\.exr.*exist already"):
        run(shot, tmp_path / "out", params=Params(alpha=0.7))
    assert contents(tmp_path / "out") == before
    run(shot, tmp_path / "out", params=Params(alpha=0.7), overwrite=True)
    assert contents(tmp_path / "out") != before


def test_a_foreign_file_is_not_replaced_and_leaves_no_trace_of_the_attempt(shot, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "shot.0003.exr").write_text("precious")
    with pytest.raises(SvgfError, match="exists already"):
        run(shot, tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").glob("*")] == ["shot.0003.exr"]


class Killed(BaseException):
    pass


@pytest.mark.parametrize("every", [1, 2, 3, 100])
@pytest.mark.parametrize("killed_at", [1, 4, 6])
def test_a_killed_run_resumes_bit_identically(shot, tmp_path, every, killed_at):
    """Killed without a chance to save: only what is on the disk counts."""
    options = WriteOptions(diagnostics=True, full_float=True, png=True)
    run(shot, tmp_path / "whole", options=options)

    def kill(report):
        if report.number >= killed_at:
            raise Killed

    with pytest.raises(Killed):
        run(shot, tmp_path / "out", options=options, checkpoint_every=every, on_frame=kill)
    summary = run(shot, tmp_path / "out", options=options, checkpoint_every=every, resume=True)
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")
    assert summary.resumed_at + summary.statuses["filtered"] == 7
    assert summary.resumed_at % every == 0


def test_stopping_leaves_a_checkpoint_at_that_very_frame(shot, tmp_path):
    run(shot, tmp_path / "whole")
    stops = iter([False, False, True])
    summary = run(shot, tmp_path / "out", stop=lambda: next(stops))
    assert summary.interrupted
    assert set(contents(tmp_path / "out")) == {f"shot.{i:04d}.exr" for i in (1, 2, 3)}
    summary = run(shot, tmp_path / "out", resume=True)
    assert summary.resumed_at == 3
    assert not summary.interrupted
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")
    assert run(shot, tmp_path / "out", resume=True).resumed_at == 7  # nothing left to do


def test_resume_refuses_other_parameters_inputs_and_options(shot, tmp_path):
    stops = iter([False, True])
    run(shot, tmp_path / "out", stop=lambda: next(stops))
    with pytest.raises(SvgfError, match=r"parameters\.alpha was 0\.2, and is 0\.5 now"):
        run(shot, tmp_path / "out", resume=True, params=Params(alpha=0.5))
    with pytest.raises(SvgfError, match=r"config\.levels was 5, and is 4 now"):
        run(shot, tmp_path / "out", resume=True, config=Config(levels=4))
    with pytest.raises(SvgfError, match=r"options\.full_float was False, and is True now"):
        run(shot, tmp_path / "out", resume=True, options=WriteOptions(full_float=True))
    write_frame(tmp_path / "in" / "shot.0002.exr", 99)
    with pytest.raises(SvgfError, match=r"input frame 2 was"):
        run(shot, tmp_path / "out", resume=True)


def test_an_unreadable_frame_in_the_middle_can_be_repaired_and_resumed(shot, tmp_path):
    run(shot, tmp_path / "whole")
    path = tmp_path / "in" / "shot.0005.exr"
    good = path.read_bytes()
    path.write_bytes(good[: len(good) // 2])
    with pytest.raises(SvgfError, match=r"shot\.0005\.exr"):
        run(shot, tmp_path / "out")
    assert set(contents(tmp_path / "out")) == {f"shot.{i:04d}.exr" for i in (1, 2, 3, 4)}
    path.write_bytes(good)
    assert run(shot, tmp_path / "out", resume=True).resumed_at == 4
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_a_size_that_changes_mid_sequence_is_an_error(shot, tmp_path):
    write_frame(tmp_path / "in" / "shot.0004.exr", 4, size=(10, 12))
    with pytest.raises(SvgfError, match=r"shot\.0004\.exr.*(12|11)"):
        run(shot, tmp_path / "out")


def test_a_checkpoint_of_another_size_is_an_error(shot, tmp_path):
    stops = iter([True])
    run(shot, tmp_path / "out", stop=lambda: next(stops))
    state = tmp_path / "out" / ".svgf-jax" / "checkpoint.npz"
    with np.load(state) as file:
        entries = dict(file)
    for name in set(History._fields) - {"effective_history", "taa"}:
        rows = entries[name].shape.index(SIZE[0])
        entries[name] = entries[name].take(range(3), axis=rows)
    np.savez(state, **entries)
    with pytest.raises(SvgfError, match="wanted one size"):
        run(shot, tmp_path / "out", resume=True)


def test_a_failure_before_the_first_output_leaves_no_trace(shot, tmp_path):
    path = tmp_path / "in" / "shot.0001.exr"
    source = open_source(shot)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(SvgfError, match=r"shot\.0001\.exr"):
        run(source, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("stop_after", [1, 2, 3, 4, None])
def test_held_frames_repeat_the_output_and_keep_the_history(tmp_path, stop_after):
    pattern = write_shot(tmp_path / "in", [1, 2, 5, 6])
    reports = []
    if stop_after:
        stops = iter([False] * (stop_after - 1) + [True])
        run(open_source(pattern, missing="hold"), tmp_path / "out", stop=lambda: next(stops), on_frame=reports.append)
    run(open_source(pattern, missing="hold"), tmp_path / "out", resume=True, on_frame=reports.append)
    assert [report.status for report in reports] == ["filtered", "filtered", "held", "held", "filtered", "filtered"]
    written = contents(tmp_path / "out")
    assert list(written) == [f"shot.{i:04d}.exr" for i in range(1, 7)]
    assert written["shot.0002.exr"] == written["shot.0003.exr"] == written["shot.0004.exr"]
    history = exr.read(tmp_path / "out" / "shot.0006.exr")
    run(write_shot(tmp_path / "dense", range(1, 5)), tmp_path / "dense_out")
    assert history.channels.keys() == exr.read(tmp_path / "dense_out" / "shot.0004.exr").channels.keys()


@pytest.mark.parametrize("stop_after", [1, 2, 3, 4, None])
def test_a_reset_starts_anew_after_a_gap(tmp_path, stop_after):
    pattern = write_shot(tmp_path / "in", [1, 2, 5, 6])
    options = WriteOptions(diagnostics=True, full_float=True)
    if stop_after:
        stops = iter([False] * (stop_after - 1) + [True])
        run(open_source(pattern, missing="reset"), tmp_path / "out", stop=lambda: next(stops), options=options)
    run(open_source(pattern, missing="reset"), tmp_path / "out", resume=True, options=options)
    assert list(contents(tmp_path / "out")) == [f"shot.{i:04d}.exr" for i in (1, 2, 5, 6)]
    lengths = [
        exr.read(path).channels["svgf.history_length"].max() for path in sorted((tmp_path / "out").glob("*.exr"))
    ]
    assert lengths == [1, 2, 1, 2]


def test_repaired_pixels_and_empty_frames_are_told(tmp_path):
    pattern = write_shot(tmp_path / "in", [1, 2])
    path = tmp_path / "in" / "shot.0002.exr"
    image = exr.read(path)
    image.channels["direct.R"][3, 4:7] = -1
    image.channels["emission.G"][:] = 60000
    image.channels["direct.G"][5, 5] = 60000
    image.channels["id.I"][:] = -1
    exr.write(path, image)
    reports = []
    summary = run(pattern, tmp_path / "out", on_frame=reports.append)
    assert reports[0].counts == {}
    assert reports[1].counts["negative"] == summary.counts["negative"] == 3
    assert summary.counts["clipped"] == 1
    assert any("without any surface" in note for note in summary.notes)


def test_output_that_is_not_finite_is_told(shot, tmp_path):
    def broken(history, frame, *, params, config):
        history, output = step(history, frame, params=params, config=config)
        return history, output._replace(image=output.image.at[2, 3:5].set(np.nan).at[1, 1, 0].set(np.inf))

    summary = streaming.run(open_source(shot), tmp_path / "out", pipeline=(init, broken))
    assert summary.counts["not_finite"] == 3 * 7


def test_a_full_disk_is_a_clear_error_and_resumable(shot, tmp_path, monkeypatch):
    run(shot, tmp_path / "whole")
    write = exr.write

    def full(path, image, **options):
        if "0005" in str(path):
            raise SvgfError(f"{path}: cannot be written (no space left on device).")
        return write(path, image, **options)

    with monkeypatch.context() as patch:
        patch.setattr(exr, "write", full)
        with pytest.raises(SvgfError, match="no space left"):
            run(shot, tmp_path / "out", checkpoint_every=2)
    assert run(shot, tmp_path / "out", resume=True).resumed_at <= 4
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_work_in_flight_is_bounded(tmp_path, monkeypatch):
    """However slow the disk is, only a few frames are in memory."""
    pattern = write_shot(tmp_path / "in", range(1, 25), layers=False)
    alive, most, guard = 0, 0, threading.Lock()
    read, write = streaming.frames.read_frame, streaming.outputs.write_frame

    def count(change):
        nonlocal alive, most
        with guard:
            alive += change
            most = max(most, alive)

    def reading(*arguments):
        count(1)
        return read(*arguments)

    def writing(*arguments, **options):
        threading.Event().wait(0.01)
        count(-1)
        return write(*arguments, **options)

    monkeypatch.setattr(streaming.frames, "read_frame", reading)
    monkeypatch.setattr(streaming.outputs, "write_frame", writing)
    run(pattern, tmp_path / "out")
    assert alive == 0
    assert most <= 8


def test_two_runs_do_not_mix(shot, tmp_path):
    def second(report):
        with pytest.raises(SvgfError, match="Another run is writing"):
            run(shot, tmp_path / "out", overwrite=True)

    run(shot, tmp_path / "out", on_frame=second)


def test_senseless_options(shot, tmp_path):
    with pytest.raises(SvgfError, match="at least 1"):
        run(shot, tmp_path / "out", threads=0)
    with pytest.raises(SvgfError, match=r"no device 'tpu:3'.*cpu:0"):
        run(shot, tmp_path / "out", device="tpu:3")
    for exposure in (-1.0, 0.0, np.nan):
        with pytest.raises(SvgfError, match="exposure"):
            run(shot, tmp_path / "out", options=WriteOptions(exposure=exposure))
    for fps in (0.0, -1.0, np.nan):
        with pytest.raises(SvgfError, match="frames per second"):
            run(shot, tmp_path / "out", fps=fps)
    assert not (tmp_path / "out").exists()
