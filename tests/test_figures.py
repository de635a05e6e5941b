"""What a run notes of its frames, for a report after it was resumed."""

import numpy as np
import pytest
from shots import init, step, write_shot

from svgf_jax import checkpoint, streaming
from svgf_jax.frames import open_source
from svgf_jax.types import SvgfError


def run(pattern, out, **options):
    return streaming.run(open_source(pattern), out, pipeline=(init, step), **options)


def test_every_frame_is_seen_and_noted_across_a_break(tmp_path):
    shot, out = write_shot(tmp_path / "in", range(1, 5)), tmp_path / "out"
    reports, seen = [], {}

    def look(item, output):
        assert isinstance(output.image, np.ndarray)
        seen[item.number] = output.history_length.mean()

    options = {"on_frame": reports.append, "on_output": look}
    assert run(shot, out, stop=lambda: True, **options).interrupted
    assert run(shot, out, resume=True, **options).resumed_at == 1
    assert seen == {1: 1, 2: 2, 3: 3, 4: 4}
    figures = checkpoint.load_figures(checkpoint.state_folder(out))
    for report in reports:
        noted = figures[report.number]
        assert (noted["status"], noted["history"]) == ("filtered", report.number)
        assert noted["seconds"] == report.seconds > 0
    run(shot, out, overwrite=True, stop=lambda: True)
    assert list(checkpoint.load_figures(checkpoint.state_folder(out))) == [1]


def test_a_damaged_line_counts_for_nothing(tmp_path):
    state = checkpoint.state_folder(tmp_path)
    state.mkdir()
    checkpoint.append_figures(state, {"number": 3, "seconds": 1.0})
    checkpoint.append_figures(state, {"number": 3, "seconds": 2.0})
    with (state / "frames.jsonl").open("a") as file:
        file.write('[1]\n{"seconds": 3}\n{"number": 4, "sec')
    assert checkpoint.load_figures(state) == {3: {"number": 3, "seconds": 2.0}}
    assert checkpoint.load_figures(tmp_path / "none") == {}
    with pytest.raises(SvgfError, match=r"Could not write .*frames\.jsonl"):
        checkpoint.append_figures(tmp_path / "none", {})
