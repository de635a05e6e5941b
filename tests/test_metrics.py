import math
import sys

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from svgf_jax import metrics
from svgf_jax.types import SvgfError

RNG = np.random.default_rng(0)
REFERENCE = RNG.gamma(0.5, 2.0, (24, 31, 3))
IMAGE = REFERENCE * RNG.uniform(0.5, 1.5, REFERENCE.shape)


def test_scores_of_a_hand_computed_pixel():
    image, reference = np.full((1, 1, 3), 1.0), np.full((1, 1, 3), 3.0)  # display: 1/2 and 3/4
    assert metrics.psnr(image, reference) == pytest.approx(-10 * math.log10(1 / 16))
    assert metrics.relmse(image, reference) == pytest.approx(4 / 9.01)
    assert metrics.temporal_error(image, reference, reference, reference) == pytest.approx(1 / 4)


def test_identical_images_are_perfect():
    scores = metrics.score(IMAGE, IMAGE, previous=(REFERENCE, REFERENCE), with_flip=True)
    assert scores == (math.inf, 0, pytest.approx(1), 0, 0)


def test_display_clamps_and_survives_extremes():
    np.testing.assert_allclose(
        metrics.display(np.array([-3.0, 0.0, 1.0, np.inf, 65504.0])), [0, 0, 0.5, 1, 65504 / 65505]
    )
    assert np.isnan(metrics.display(np.array([np.nan]))).all()


def test_psnr_sees_no_difference_between_negative_values():
    assert metrics.psnr(np.full((2, 2, 3), -1.0), np.zeros((2, 2, 3))) == math.inf


@pytest.mark.parametrize("shape", [(11, 11, 1), (24, 31, 3), (40, 13, 2)])
def test_ssim_agrees_with_scikit_image(shape):
    reference = RNG.gamma(0.5, 2.0, shape)
    image = reference * RNG.uniform(0.5, 1.5, shape)
    wanted = structural_similarity(
        metrics.display(image),
        metrics.display(reference),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1,
        channel_axis=-1,
    )
    assert metrics.ssim(image, reference) == pytest.approx(wanted, abs=1e-12)


def test_ssim_of_a_tiny_image_does_not_exist():
    assert math.isnan(metrics.ssim(IMAGE[:10], REFERENCE[:10]))


def test_a_steady_error_is_not_flicker():
    still = np.repeat(IMAGE[None], 2, 0)
    assert metrics.temporal_error(still[0], still[1], REFERENCE, REFERENCE) == 0


def test_sequence_scores_pool_the_temporal_error():
    frames = [metrics.Scores(20, 1, 0.5, math.nan, math.nan), metrics.Scores(30, 3, 1.0, 3.0, math.nan)]
    frames.append(metrics.Scores(40, 5, 0.0, 4.0, math.nan))
    mean = metrics.mean_scores(frames)
    assert mean[:3] == (30, 3, 0.5)
    assert mean.temporal == pytest.approx(math.sqrt(12.5))
    assert math.isnan(mean.flip)


def test_a_broken_frame_breaks_the_scores_of_its_sequence():
    broken = IMAGE.copy()
    broken[0, 0, 0] = math.nan
    for order in ([IMAGE, broken, IMAGE], [broken, IMAGE], [IMAGE, broken]):
        scores = [
            metrics.score(image, REFERENCE, previous=(order[i - 1], REFERENCE) if i else None)
            for i, image in enumerate(order)
        ]
        assert all(math.isnan(value) for value in metrics.mean_scores(scores))
        none = metrics.absent(scores)
        assert none[:, 4].all()  # FLIP was not asked for
        assert none[0, 3]
        assert not none[1:, 3].any()
        assert not none[:, :3].any()


def test_flip_of_a_broken_image_is_nan():
    assert math.isnan(metrics.flip(np.full((4, 4, 3), math.nan), REFERENCE[:4, :4]))


def test_flip_orders_images():
    pytest.importorskip("flip_evaluator")
    near = REFERENCE * 1.01
    assert 0 < metrics.flip(near, REFERENCE) < metrics.flip(IMAGE, REFERENCE) < 1


def test_flip_without_its_package_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(SvgfError, match=r"svgf-jax\[flip\]"):
        metrics.flip(IMAGE, REFERENCE)
    with pytest.raises(SvgfError, match=r"svgf-jax\[flip\]"):
        metrics.require_flip()


def test_errors_name_the_shapes():
    with pytest.raises(SvgfError, match=r"\(24, 31, 3\) and \(23, 31, 3\)"):
        metrics.psnr(IMAGE, REFERENCE[1:])
    with pytest.raises(SvgfError, match="at least one"):
        metrics.mean_scores([])


def noisy_and_reference(folder):
    """The noisy and the reference beauty of a shared sequence, frame by frame."""
    import OpenEXR

    def beauty(path):
        with OpenEXR.File(str(path), separate_channels=True) as file:
            planes = {name: channel.pixels for name, channel in file.channels().items()}
        layers = ("direct", "indirect", "emission")
        return sum(np.stack([planes[f"{layer}.{c}"].astype(np.float64) for c in "RGB"], -1) for layer in layers)

    for path in sorted(folder.glob("frame_*.exr")):
        yield beauty(path), beauty(path.with_name(path.name.replace("frame", "ref")))


@pytest.mark.parametrize(
    ("sequence", "psnr", "temporal"),
    [("cornell-dolly", 28.16, 0.0550), ("gallery-pan", 24.42, 0.0854), ("lights-flicker", 22.04, 0.1138)],
)
def test_published_scores_of_the_noisy_sequences(data, sequence, psnr, temporal):
    scores, previous = [], None
    for image, reference in noisy_and_reference(data / sequence):
        error = math.nan if previous is None else metrics.temporal_error(image, previous[0], reference, previous[1])
        scores.append(metrics.Scores(metrics.psnr(image, reference), 0, 0, error, 0))
        previous = (image, reference)
    mean = metrics.mean_scores(scores)
    assert mean.psnr == pytest.approx(psnr, abs=0.01)
    assert mean.temporal == pytest.approx(temporal, abs=1e-4)


def test_frames_are_scored_in_turn():
    """As `score` does; a frame without a reference, or of another size, is one that no change is measured from."""
    rng = np.random.default_rng(0)
    images = [rng.random((size, 12, 3)) for size in (12, 12, 12, 12, 13)]
    targets = [rng.random(image.shape) for image in images]
    found = list(metrics.score_frames(zip(images, [*targets[:2], None, *targets[3:]], strict=True)))
    assert found[1] == metrics.score(images[1], targets[1], previous=(images[0], targets[0]))._replace(
        flip=found[1].flip
    )
    assert found[2] is None
    assert [math.isnan(found[i].temporal) for i in (0, 1, 3, 4)] == [True, False, True, True]
