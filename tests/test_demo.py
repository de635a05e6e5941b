import numpy as np
import pytest
from PIL import Image

from svgf_jax import demo, exr
from svgf_jax.cameras import reproject
from svgf_jax.cli import main
from svgf_jax.frames import open_source, read_frame


def test_the_sample_is_small_complete_and_starts_at_zero():
    folder = demo.sample()
    assert sum(path.stat().st_size for path in folder.iterdir()) < 6_000_000
    for i in range(10):
        header = exr.read_header(folder / f"frame_{i:04d}.exr")
        reference = exr.read_header(folder / f"ref_{i:04d}.exr")
        assert header.data_window == header.display_window == reference.data_window == (0, 0, 223, 135)
    assert (folder / "README.md").is_file()


def test_the_samples_cameras_belong_to_the_crop():
    """Motion derived from the shifted cameras is the motion that the renderer wrote."""
    source = open_source(demo.sample())
    assert not source.warnings
    assert source.cameras is not None
    for i in (1, 5, 9):
        frame = read_frame(source, i).frame
        _, motion = reproject(source.cameras, frame.depth, frame.object_id, number=i, previous=i - 1)
        surface = frame.object_id != -1
        assert np.abs(motion - frame.motion)[surface].max() < 0.01


def test_the_demo_denoises_measures_and_shows(tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        main(["demo", "-o", str(tmp_path / "out")])
    assert end.value.code == 0
    told = capsys.readouterr()
    assert "noisy" in told.out
    assert "denoised" in told.out
    assert told.err.count(": filtered -> ") == 10
    assert len(list((tmp_path / "out").glob("frame_*.exr"))) == 10
    picture = np.asarray(Image.open(tmp_path / "out" / "demo.png")).astype(float)
    assert picture.shape[1] > 3 * 448
    left, middle, right = (picture[-272:, i * 450 : i * 450 + 448] for i in range(3))
    assert np.abs(middle - right).mean() < 0.25 * np.abs(left - right).mean()
    with pytest.raises(SystemExit) as end:
        main(["demo", "-o", str(tmp_path / "out")])
    assert end.value.code == 2
    assert "--overwrite" in capsys.readouterr().err


def test_the_demo_gains_what_it_claims(tmp_path):
    from svgf_jax.parameters import preset

    params, config = preset("paper")
    made = demo.run(tmp_path / "out", params=params, config=config, preset="paper")
    assert made.noisy.psnr == pytest.approx(28.14, abs=0.01)
    assert made.denoised.psnr > made.noisy.psnr + 9
    assert made.denoised.temporal < 0.25 * made.noisy.temporal
    assert made.denoised.ssim > 0.97
