"""The oracle itself, on cases small enough to work out by hand."""

import math

import numpy as np
import oracle
import pytest
import scenes


def run(frames, params=oracle.PAPER, **config):
    return oracle.denoise(frames, params, oracle.PAPER_CONFIG | config)


def history_of(frame, illumination=0.0, length=1.0):
    height, width = frame["depth"].shape
    signals = len(frame["radiance"])
    return {
        "illumination": np.broadcast_to(illumination, (signals, height, width, 3)).astype(float),
        "moments": np.zeros((signals, height, width, 2)),
        "history_length": np.broadcast_to(length, (height, width)).astype(float),
        "depth": frame["depth"],
        "normal": frame["normal"],
        "object_id": frame["object_id"],
    }


def taps_of(frame, y, x, history=None):
    clean, usable, _ = oracle.sanitise(frame)
    return oracle.reproject_taps(clean, usable, history or history_of(frame), oracle.PAPER)[y][x]


def test_a_single_pixel_is_averaged_over_time():
    frames = [scenes.flat(1, 1, radiance=r, albedo=0.5) for r in (1.0, 2.0, 4.0)]
    first, second, third = run(frames)
    np.testing.assert_allclose(first["illumination"], 2.0)
    np.testing.assert_allclose(second["illumination"], 3.0)  # a = 1/2
    np.testing.assert_allclose(third["illumination"], (2 * 3.0 + 8.0) / 3)  # a = 1/3
    np.testing.assert_allclose(third["image"], (2 * 3.0 + 8.0) / 6)
    np.testing.assert_allclose(third["history"]["moments"][0, 0, 0], [(2 + 4 + 8) / 3, (4 + 16 + 64) / 3])
    # The spatial estimate of one pixel is that of its own moments, times max(1, 1/3).
    np.testing.assert_allclose(third["variance"], (4 + 16 + 64) / 3 - ((2 + 4 + 8) / 3) ** 2)
    assert [float(o["history_length"].item()) for o in (first, second, third)] == [1, 2, 3]


def test_alpha_and_the_cap_of_the_history_length():
    frames = [scenes.flat(1, 1, radiance=float(t)) for t in range(5)]
    params = oracle.PAPER | {"alpha": 0.6, "alpha_moments": 0.4, "max_history": 3.0}
    outputs = run(frames, params)
    c, m = 0.0, 0.0
    for t in range(1, 5):
        h = min(t + 1, 3)
        c = c + max(0.6, 1 / h) * (t - c)
        m = m + max(0.4, 1 / h) * (t - m)
    np.testing.assert_allclose(outputs[-1]["illumination"], c)
    np.testing.assert_allclose(outputs[-1]["history"]["moments"][0, 0, 0, 0], m)
    assert outputs[-1]["history_length"].item() == 3


def test_short_history_boost_divides_by_the_history_length():
    frame = scenes.flat(1, 2)
    frame["radiance"][0, 0, 1] = 3.0
    outputs = run([frame, frame, frame, frame, frame], oracle.PAPER | {"short_history_boost": 4.0}, levels=0)
    one = (1 + 9) / 2 - 2**2
    np.testing.assert_allclose(outputs[0]["variance"], 4 * one)
    np.testing.assert_allclose(outputs[1]["variance"], 2 * one)
    np.testing.assert_allclose(outputs[2]["variance"], 4 / 3 * one)
    np.testing.assert_allclose(outputs[3]["variance"], 0.0, atol=1e-12)


def test_one_level_on_two_pixels():
    frame = scenes.flat(1, 2)
    frame["radiance"][0, 0, 1] = 3.0
    (output,) = run([frame], levels=1)
    variance = 1.0
    w_l = math.exp(-2.0 / (4 * math.sqrt(variance) + 1e-6))
    centre, beside = 3 / 8, 1 / 4 * w_l
    total = centre + beside
    np.testing.assert_allclose(output["illumination"][0, 0, 0], (centre * 1 + beside * 3) / total, rtol=1e-12)
    np.testing.assert_allclose(output["illumination"][0, 0, 1], (centre * 3 + beside * 1) / total, rtol=1e-12)
    np.testing.assert_allclose(output["variance_filtered"], variance * (centre**2 + beside**2) / total**2, rtol=1e-12)


def test_level_one_reaches_two_pixels_away_and_not_one():
    frame = scenes.flat(1, 4)
    frame["radiance"][0, 0] = [[1.0] * 3, [2.0] * 3, [3.0] * 3, [4.0] * 3]
    illumination, variance = frame["radiance"], np.ones((1, 1, 4))
    wide = oracle.PAPER | {"sigma_luminance": 1e30}
    out, _ = oracle.atrous_level(
        illumination,
        variance,
        frame["depth"].tolist(),
        frame["normal"].tolist(),
        [[True] * 4],
        [[(0.0, 0.0)] * 4],
        1,
        wide,
    )
    np.testing.assert_allclose(out[0, 0, 0], (3 / 8 * 1 + 1 / 4 * 3) / (5 / 8))
    np.testing.assert_allclose(out[0, 0, 1], (3 / 8 * 2 + 1 / 4 * 4) / (5 / 8))


def test_variance_after_one_uniform_level():
    frame = scenes.flat(5, 5)
    plane = [[(0.0, 0.0)] * 5] * 5
    _, variance = oracle.atrous_level(
        frame["radiance"],
        np.full((1, 5, 5), 7.0),
        frame["depth"].tolist(),
        frame["normal"].tolist(),
        (frame["object_id"] == 0).tolist(),
        plane,
        0,
        oracle.PAPER,
    )
    np.testing.assert_allclose(variance[0, 2, 2], 7 * (35 / 128) ** 2)


def test_normals_at_an_angle():
    frame = scenes.flat(1, 2)
    frame["normal"][0, 1] = [0.0, math.sin(0.1), -math.cos(0.1)]
    frame["radiance"][0, 0, 1] = 3.0
    (output,) = run([frame], oracle.PAPER | {"sigma_luminance": 1e30}, levels=1)
    beside = 1 / 4 * math.cos(0.1) ** 128
    np.testing.assert_allclose(output["illumination"][0, 0, 0], (3 / 8 + 3 * beside) / (3 / 8 + beside), rtol=1e-12)


@pytest.mark.parametrize(
    ("depths", "gradient"),
    [
        ([1.0, 2.0, 4.0], 1.0),  # the smaller one
        ([1.0, 3.0, 4.0], 1.0),
        ([1.0, 2.0, 3.0], 1.0),
        ([1.0, 2.0, 1.0], 0.0),  # a tie: the mean
        ([2.0, 1.0, 3.0], -1.0),
    ],
)
def test_depth_gradient(depths, gradient):
    assert oracle.depth_gradient([depths], [[0, 0, 0]])[0][1] == (gradient, 0.0)
    column = [[d] for d in depths]
    assert oracle.depth_gradient(column, [[0], [0], [0]])[1][0] == (0.0, gradient)


def test_depth_gradient_stays_within_the_object():
    assert oracle.depth_gradient([[1.0, 2.0, 9.0]], [[5, 0, 0]])[0][1] == (7.0, 0.0)
    assert oracle.depth_gradient([[1.0, 2.0, 9.0]], [[5, 0, 5]])[0][1] == (0.0, 0.0)


def test_a_plane_in_depth_is_no_edge():
    """On a plane |z(p) - z(q)| is what the gradient predicts, so w_z = exp(-1) at every distance (sigma_depth 1)."""
    assert oracle.depth_weight(5.0, 5.6, (0.3, 0.0), 2, 1, 1.0, 0.0) == pytest.approx(math.exp(-1))
    assert oracle.depth_weight(5.0, 5.0, (0.0, 0.0), 2, 1, 1.0, 0.0) == 1.0
    assert oracle.depth_weight(5.0, 5.1, (0.0, 0.0), 2, 1, 1.0, 0.0) == 0.0


def test_bilinear_taps():
    frame = scenes.flat(4, 4)
    frame["motion"][:] = [0.25, -0.5]
    assert sorted(taps_of(frame, 2, 1)) == [(1, 1, 0.375), (1, 2, 0.125), (2, 1, 0.375), (2, 2, 0.125)]


def test_bilinear_taps_outside_or_of_another_object_are_left_out_one_by_one():
    frame = scenes.flat(4, 4)
    frame["motion"][:] = [0.25, -0.5]
    assert sorted(taps_of(frame, 0, 0)) == [(0, 0, 0.75), (0, 1, 0.25)]
    history = history_of(frame) | {"object_id": np.array([[0, 0, 0, 0], [0, 0, 9, 0], [0, 0, 0, 0], [0, 0, 0, 0]])}
    assert [t[:2] for t in sorted(taps_of(frame, 2, 1, history))] == [(1, 1), (2, 1), (2, 2)]
    assert sum(t[2] for t in taps_of(frame, 2, 1, history)) == pytest.approx(1)


def test_fallback_to_the_three_by_three_neighbourhood():
    frame = scenes.flat(5, 5)
    ids = np.full((5, 5), 9)
    ids[1, 1] = ids[2, 3] = 0
    taps = taps_of(frame, 2, 2, history_of(frame) | {"object_id": ids})
    assert sorted(taps) == [(1, 1, 0.5), (2, 3, 0.5)]
    frame["motion"][:] = 0.49  # the taps at (2, 3): weight .51 * .49, found by the bilinear ones
    assert taps_of(frame, 2, 2, history_of(frame) | {"object_id": ids}) == [(2, 3, 1.0)]


def test_outside_the_image_there_is_no_history_but_its_edge_is_found():
    frame = scenes.flat(3, 3)
    frame["motion"][:] = -1e4
    assert taps_of(frame, 1, 1) == []
    frame["motion"][:] = [-2.5, 0.0]  # P = (-1.5, 1), floor(P + 1/2) = (-1, 1): the 3x3 around it touches column 0
    assert [t[:2] for t in sorted(taps_of(frame, 1, 1))] == [(0, 0), (1, 0), (2, 0)]
    frame["motion"][:] = [-2.75, 0.0]
    assert taps_of(frame, 1, 1) == []


def test_depth_and_normal_decide_consistency():
    frame = scenes.flat(1, 1, depth=2.0)
    for expected, found in ((2.0, True), (1.82, True), (1.81, False), (2.22, True), (2.23, False)):
        frame["prev_depth"][:] = expected
        assert bool(taps_of(frame, 0, 0)) is found
    frame["prev_depth"][:] = 2.0
    for cosine, found in ((0.91, True), (0.89, False)):
        history = history_of(frame)
        history["normal"] = np.array([[[0.0, math.sqrt(1 - cosine**2), -cosine]]])
        assert bool(taps_of(frame, 0, 0, history)) is found


def test_background_passes_through_and_gives_nothing():
    frame = scenes.flat(3, 3)
    frame["object_id"][1, 1] = -1
    frame["radiance"][0, 1, 1], frame["emission"][1, 1] = 50.0, 7.0
    for output in run([frame, frame]):
        np.testing.assert_array_equal(output["image"][1, 1], 57.0)
        np.testing.assert_allclose(output["image"][0, 0], 1.0)
        for name in ("illumination", "variance", "variance_filtered"):
            assert not output[name][0, 1, 1].any()
        assert output["history_length"][1, 1] == 0
        assert not output["valid"][1, 1]


def test_sanitising():
    frame = scenes.flat(2, 2, signals=2)
    frame["radiance"][1, 0, 0] = [np.nan, -1.0, 5.0]
    frame["emission"][0, 1] = [np.inf, -1.0, 2.0]
    frame["depth"][1, 0] = np.nan
    frame["motion"][1, 1, 0] = np.inf
    clean, usable, rejected = oracle.sanitise(frame)
    np.testing.assert_array_equal(clean["radiance"][1, 0, 0], [0, 0, 5])
    np.testing.assert_array_equal(clean["emission"][0, 1], [0, -1, 2])
    assert clean["object_id"].tolist() == [[0, 0], [-1, 0]]
    assert usable.tolist() == [[True, True], [True, False]]
    assert rejected == {
        "radiance": 1,
        "negative": 1,
        "emission": 1,
        "surface": 1,
        "motion": 1,
        "normal": 0,
        "bright": 0,
    }


def test_feedback_level():
    frame = scenes.synthetic(0, 6, 7, frames=1)[0]
    per_level = []
    for level in range(-1, 4):
        (output,) = run([frame], levels=3, feedback_level=level)
        per_level.append(output["history"]["illumination"])
    (unfiltered,) = run([frame], levels=0)
    np.testing.assert_array_equal(per_level[0], unfiltered["illumination"])
    np.testing.assert_array_equal(per_level[3], output["illumination"])
    np.testing.assert_array_equal(per_level[4], per_level[3])
    assert np.abs(per_level[1] - per_level[2]).max() > 0


def test_a_constant_image_stays_constant():
    outputs = run([scenes.flat(6, 7, signals=2, radiance=3.0, albedo=0.5)] * 5)
    np.testing.assert_allclose(outputs[-1]["image"], 6.0, rtol=1e-14)
    np.testing.assert_allclose(outputs[-1]["variance"], 0.0, atol=1e-12)


def test_numbers_per_level_equal_one_number_for_all():
    frames = scenes.synthetic(1, 5, 6, frames=2)
    params = {name: [value] * 2 for name, value in oracle.PAPER.items()}
    np.testing.assert_array_equal(
        run(frames, params, levels=2)[-1]["image"], run(frames, oracle.PAPER, levels=2)[-1]["image"]
    )


def test_the_synthetic_scenes_are_as_awkward_as_they_say():
    frames = scenes.synthetic(0, 24, 30, frames=6)
    assert any((f["object_id"] == -1).any() for f in frames)
    assert any((f["albedo"][0][f["object_id"] != -1] == 0).all(axis=-1).any() for f in frames)
    outputs = run(frames, levels=0)
    surface = frames[-1]["object_id"] != -1
    assert 0.02 < 1 - outputs[-1]["valid"][surface].mean() < 0.5
    assert (outputs[-1]["history_length"] >= 4 - 1e-3).any()
    assert ((outputs[-1]["history_length"] < 4 - 1e-3) & surface).any()
    assert any((o["variance"] == 0)[:, f["object_id"] == 15].any() for o, f in zip(outputs, frames, strict=True))
    z = frames[0]["depth"]
    ridge = (z[:, 2:] - z[:, 1:-1]) == -(z[:, 1:-1] - z[:, :-2])
    assert (ridge & (z[:, 2:] != z[:, 1:-1])).any()
    assert not all(np.isfinite(v).all() for v in scenes.synthetic(0, 24, 30, frames=1, dirty=True)[0].values())


def test_the_real_crops_hold_what_they_are_for(data):
    for name in scenes.CROPS:
        frame = scenes.real(data, name, frames=1)[0]
        assert frame["depth"].shape == (48, 64)
        assert len(np.unique(frame["object_id"])) >= 4
        if name == "gallery-pan":
            background = frame["object_id"] == -1
            assert background.any()
            assert (frame["albedo"][0, ~background].max(axis=-1) == 0).any()
