"""The parts of following the light, and of reflections, by hand; and bugs put into them, each of which must fail its check.

A check gets the module that it is about: the real one, or one with other text in one place (which must be there, exactly once).
"""

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import test_reflections
from test_adaptation import LUMINANCE, meetings

import svgf_jax
from svgf_jax import adaptation, cells, reflections
from svgf_jax import significance as judging
from svgf_jax.edges import Guides

MODULES = {"adaptation": adaptation, "cells": cells, "reflections": reflections, "significance": judging}
RNG = np.random.default_rng(3)  # begun anew for each check


def planes(*shape):
    return tuple(RNG.gamma(1.0, 1.0, shape) for _ in range(3))


def luma(color):
    return sum(w * c for w, c in zip(LUMINANCE, color, strict=True))


def near(got, wanted):
    np.testing.assert_allclose(np.asarray(got), wanted, rtol=1e-12, atol=1e-12)


def significance(current, previous, square, effective, threshold, remembered):
    change = (luma(current) - luma(previous)) ** 2
    variance = np.maximum(square - change, 0.0)
    noise = threshold**2 * effective * np.maximum(variance, remembered)
    return np.maximum(1.0 - (noise / change) ** 2, 0.0), variance


def ratio(current, previous, scale, s):
    """For light scale."""
    return 1.0 + s * (np.clip((current + 0.01 * scale) / (previous + 0.01 * scale), 1 / 50, 50) - 1.0)


def check_significance(module):
    """About half of the changes are significant, and either of the two variances is the larger."""
    current, previous = planes(40), planes(40)
    square, remembered = (luma(current) - luma(previous)) ** 2 + RNG.gamma(1.0, 0.5, 40), RNG.gamma(1.0, 0.5, 40)
    effective = RNG.uniform(0.1, 0.5, 40)
    got = module._significance(current, previous, square, effective, 1.5, remembered)
    wanted = significance(current, previous, square, effective, 1.5, remembered)
    assert 8 < (wanted[0] > 0).sum() < 32
    near(got[0], wanted[0])
    near(got[1], wanted[1])


def check_ratio(module):
    """Up, down, limited both ways, out of nothing, and in the dark."""
    current, previous = np.array([2.0, 0.5, 900.0, 0.0, 1.0, 1e-8]), np.array([1.0, 1.0, 1.0, 9.0, 0.0, 1e-9])
    scale, s = np.array([1.0, 1.0, 1.0, 9.0, 1.0, 1e-9]), np.array([0.9, 0.8, 0.7, 1.0, 0.6, 1.0])
    wanted = ratio(current, previous, scale, s)
    wanted[-1] = 1.0
    near(module._ratio(current, previous, scale, s), wanted)


def check_sums(module):
    """Sums of squares, corrected afterwards, are those of the corrected samples."""
    current, history, gain = planes(9), planes(9), (1.5, 0.5, 2.0)
    first, second = RNG.gamma(1.0, 1.0, (2, 9))
    second = second + first**2 * np.array([1.0] * 8 + [0.0])
    found = module.compare(current, history, (first, second))
    sums = module.Sums(*(tuple(c.sum() for c in f) if isinstance(f, tuple) else f.sum() for f in found))
    (got,) = module._correct_sums((sums,), (module.Gain(gain, 1.25, 1.0, 0.0),))
    near(got.current, [c.sum() for c in current])
    near(got.previous, [g * c.sum() for g, c in zip(gain, history, strict=True)])
    near(got.square, ((luma(current) - 1.25 * luma(history)) ** 2).sum())
    near(got.noise, 1.25**2 * np.maximum(second - first**2, 0.0).sum())


def check_gain_then_offset(module):
    """The correction that a cell tells, from its two comparisons."""
    effective = RNG.uniform(0.01, 0.2, 30)
    wide, narrow = (
        (c, p, (luma(c) - luma(p)) ** 2 + n, 0.5 * n)
        for c, p, n in [(planes(30), planes(30), RNG.gamma(1.0, 1.0, 30)) for _ in range(2)]
    )
    (before,) = module._gains(effective, (module.Compared(*wide),), threshold=1.5)
    (got,) = module._offsets(effective, (module.Compared(*narrow),), (before,), threshold=2.0)
    s, _ = significance(*wide[:3], effective, 1.5, wide[3])
    t, observed = significance(*narrow[:3], effective, 2.0, narrow[3])
    assert min((s > 0).sum(), (t > 0).sum(), ((s > 0) & (t > 0)).sum(), ((s == 0) | (t == 0)).sum()) > 3
    scale = luma(wide[1])
    near(before.color, [ratio(c, p, scale, s) for c, p in zip(*wide[:2], strict=True)])
    luminance_gain = ratio(luma(wide[0]), scale, scale, s)
    near(before.luminance, luminance_gain)
    near(got.color, [t * (c - p) for c, p in zip(*narrow[:2], strict=True)])
    grown = ratio(luma(narrow[0]), luma(narrow[1]), luma(narrow[1]), t)
    near(got.keep, (1 - s) * (1 - t) * (luminance_gain * grown) ** 2)
    near(got.variance, (1 - (1 - s) * (1 - t)) * observed)
    dimmed = np.maximum(1.0, 1.0 / grown) ** 2
    assert 3 < (dimmed > 1).sum() < 27
    near(got.dimmed, dimmed)
    near(got.noise, dimmed * s**2 * effective + t**2 * effective)


def check_correction(module):
    """What becomes of a pixel's history; darker than black it does not become."""
    color, first, noise = planes(8), RNG.gamma(1.0, 1.0, 8), RNG.gamma(1.0, 1.0, 8)
    gain, offset = planes(8), tuple(o - 2.0 for o in planes(8))
    luminance_gain, keep, variance = planes(8)
    added, fewer, worth = planes(8)
    dimmed = 1.0 + fewer  # below 1 it never is
    correction = judging.Correction(gain, luminance_gain, judging.Offset(offset, keep, variance, dimmed, added))
    got, moments, change, left = module._correct(color, (first, noise + first**2), worth, correction)
    wanted = [np.maximum(g * c + o, 0.0) for g, c, o in zip(gain, color, offset, strict=True)]
    assert (np.array(wanted) == 0).any()
    near(got, wanted)
    mean = np.maximum(luminance_gain * first + luma(offset), 0.0)
    near(moments[0], mean)
    near(moments[1], keep * noise + variance + mean**2)
    near(left, 1.0 / (dimmed / worth + added))
    near(change, (luma(wanted) - luma(color)) / np.maximum(luma(wanted), luma(color)))


def check_paths(module):
    near([module.shared_paths(levels) for levels in (1, 2, 4)], [meetings(levels) for levels in (1, 2, 4)])


def check_cells(module):
    """Cells that hold their centres' places: sums of a cell's pixels, and where a pixel finds the four around it."""
    height, width, size = 14, 9, 4  # two strips of two rows of cells
    y, x = np.mgrid[0:height, 0:width].astype(float)
    one = np.ones((height, width))
    pixels = module.Pixels(Guides(y, (x, x, x), one), (y, x), one, (), (), ())

    def sums(p):
        return module.at_centres(p.guides.depth, size), module.gathered(
            p.known.reshape(-1, size, p.known.shape[1]).sum(axis=1), size
        )

    centres, count = module.to_cells(sums, pixels, size=size)
    near(centres, [[2.0, 2.0, 0.0], [6.0, 6.0, 0.0], [10.0, 10.0, 0.0], [0.0] * 3])  # beyond the image is 0
    near(count, [[16.0, 16.0, 4.0]] * 3 + [[8.0, 8.0, 2.0]])
    down, right = np.mgrid[-1:5, -1:4] * 4.0 + 2.0  # with the margin

    def look(p, corners):
        share = [np.e**c.log_share for c in corners]
        where = [sum(s * c.cells[i] for s, c in zip(share, corners, strict=True)) for i in (0, 1)]
        off = [abs(c.cells[0] - p.guides.depth - c.dy) + abs(c.cells[1] - p.slope[1] - c.dx) for c in corners]
        return *where, sum(share), sum(off) * p.known

    got = module.to_pixels(look, pixels, (down, right), size=size)
    near(got, [y, x, one, 0.0 * one])  # what is linear stays so


def check_mirror(module):
    test_reflections.test_a_flat_mirror_moves_its_picture_as_the_mirror_image_of_the_thing_moves()


def check_roughness(module):
    """As a mirror of so much nearer things, by the factor of the GGX lobe's dominant direction."""
    test_reflections.test_roughness_brings_the_picture_to_the_surface_and_shortens_its_history()
    depth, normal, ids, hit, _ = test_reflections.guides(test_reflections.EYES[1])
    rough, nearer = (
        module.trace_reflections(
            test_reflections.CAMERAS, depth, normal, ids, hit * f, roughness=r, number=1, previous=0
        ).reflected_motion
        for r, f in ((0.64, 1.0), (0.0, 0.36 * (0.6 + 0.64)))
    )
    np.testing.assert_allclose(rough, nearer, atol=1e-5)


def check_signals(module):
    """Glossy signals reflect, others stay; in the first frame all do."""
    depth, normal, ids, hit, _ = test_reflections.guides(test_reflections.EYES[1])
    given = (
        test_reflections.CAMERAS,
        ("diffuse_direct", "glossy_direct"),
        {"hit_distance": hit[..., None]},
        depth,
        normal,
        ids,
    )
    motion, _, longest = module.signals_reflected(*given, number=1, previous=0, origin=(0, 0))
    assert np.isnan(motion[0]).all()
    assert np.isfinite(motion[1]).all()
    assert (longest == 1e6).all()
    first, _, _ = module.signals_reflected(*given, number=1, previous=None, origin=(0, 0))
    assert np.isnan(first).all()


CHECKS = {
    check_significance: {
        "deviations for variances": ("threshold * threshold * effective", "threshold * effective"),
        "the remembered noise forgotten": ("jnp.maximum(variance, remembered)", "variance"),
        "the change counted as noise": ("jnp.maximum(square - change, 0.0)", "jnp.maximum(square, 0.0)"),
        "significance that grows more slowly": (
            "(noise / jnp.where(significant, change, 1.0)) ** 2",
            "(noise / jnp.where(significant, change, 1.0))",
        ),
    },
    check_ratio: {
        "ratio to nothing": ("steady = 0.01 * scale", "steady = 1e-6 * scale"),
        "gain without a limit": ("jnp.clip(ratio, 1.0 / LARGEST_GAIN, LARGEST_GAIN) - 1.0", "ratio - 1.0"),
        "gain in the dark": ("lit = scale > _DARK", "lit = scale > 0.0"),
    },
    check_sums: {
        "product added": ("s.current2 - 2.0 * gain.luminance", "s.current2 + 2.0 * gain.luminance"),
        "variance scaled like the light": ("gain.luminance**2 * s.noise", "gain.luminance * s.noise"),
        "negative noise": ("jnp.clip(moments[1] - moments[0] * moments[0], 0.0,",
                           "jnp.clip(moments[1] - moments[0] * moments[0], -9.0,"),
    },
    check_gain_then_offset: {
        "gain without a noise of its own": ("significance**2 * effective))", "0.0 * effective))"),
        "offset however insignificant": ("significance * (c - p)", "(c - p)"),
        "both for either": ("(1.0 - gain.significance) * (1.0 - sig", "1.0 - gain.significance * (1.0 * sig"),
        "old variance not scaled": ("keep = neither * (gain.luminance * grown) ** 2", "keep = neither * gain.luminance**2"),
        "variance of the gain's comparison lost": ("keep, (1.0 - neither) * observed,", "keep, significance * observed,"),
        "noise of brighter light": ("1.0 / jnp.minimum(grown, 1.0) ** 2", "1.0 / grown**2"),
        "noise of the gain lost": ("gain.noise * dimmed + significance**2", "significance**2"),
    },
    check_correction: {
        "darker than black": ("jnp.clip(gain * jnp.minimum(past, most) + offset, 0.0, most)", "gain * past + offset"),
        "moments left behind": ("first = _within(c.luminance_gain, first,", "first = _within(1.0, first,"),
        "variance for the second moment": ("(first, variance + first * first), change", "(first, variance), change"),
        "new noise not added": ("second - first * first, 0.0), offset.variance,", "second - first * first, 0.0), 0.0,"),
    },
    check_paths: {
        "paths that never meet": (".sum() / (_KERNEL**2).sum() ** levels) ** 2)", ".sum() / (whole**2).sum()) ** 2)"),
        "paths that meet in rows alone": ("(_KERNEL**2).sum() ** levels) ** 2)", "(_KERNEL**2).sum() ** levels))"),
    },
    check_cells: {
        "centre at the upper left": ("plane[size // 2 :: size,", "plane[::size,"),
        "a column of each cell lost": ("for b in range(1, size)", "for b in range(2, size)"),
        "cells of the row above": ("[first_centre : first_centre + rows]", "[:rows]"),
        "cells half a cell away": ("jnp.int32(first_centre + j * size)", "jnp.int32(size + j * size)"),
        "shares exchanged": ("np.stack([1 + first / size, -first / size])", "np.stack([-first / size, 1 + first / size])"),
        "the second row of cells where the first is": ("down(first) + i * size", "down(first)"),
    },
    check_mirror: {
        "seen from the origin": ("away = position - _eye(camera)", "away = position - 0.0"),
        "seen by this frame's camera": ("motion = _screen(before, image)", "motion = _screen(camera, image)"),
        "in front of the mirror": ("image = was + _moved(", "image = was - _moved("),
        "depth of the surface for that of the mirror there": (
            "_depth_along(before, was, image,", "_depth_along(before, was, was,",
        ),
        "history shortened in mirrors": ("drift = (1.0 - share) * np.hypot", "drift = np.hypot"),
    },
    check_roughness: {
        "rough like a mirror": ("share * np.maximum(hit_distance, 0.0)", "np.maximum(hit_distance, 0.0)"),
        "smooth for rough": ("(np.sqrt(1.0 - r) + r)", "(np.sqrt(r) + 1.0 - r)"),
        "history of any length": ("1.0 + 1.0 / np.maximum(drift, 1e-9)", "1.0 + 1e9 / np.maximum(drift, 1e-9)"),
    },
    check_signals: {
        "everything reflects": ("moved if r else still", "moved if reflect else still"),
        "matt things reflect": ("moved if r else still", "still if r else moved"),
    },
}  # fmt: skip
MODULE_OF = dict.fromkeys(
    (check_significance, check_ratio, check_sums, check_gain_then_offset, check_paths), "significance"
) | {
    check_cells: "cells",
    check_mirror: "reflections",
    check_roughness: "reflections",
    check_signals: "reflections",
}


def changed(name: str, old: str, new: str) -> ModuleType:
    text = Path(MODULES[name].__file__).read_text(encoding="utf-8")
    assert text.count(old) == 1, f"{name}.py has {text.count(old)} times, not once: {old}"
    module = ModuleType(f"svgf_jax.{name}")
    exec(compile(text.replace(old, new), f"{name}.py with a bug", "exec"), module.__dict__)
    return module


def run(monkeypatch, check, module):
    monkeypatch.setattr(svgf_jax, "trace_reflections", getattr(module, "trace_reflections", None), raising=False)
    global RNG
    RNG = np.random.default_rng(3)
    check(module)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_by_hand(monkeypatch, check):
    run(monkeypatch, check, MODULES[MODULE_OF.get(check, "adaptation")])


@pytest.mark.parametrize(
    ("check", "bug"),
    [(check, bug) for check, bugs in CHECKS.items() for bug in bugs],
    ids=lambda a: getattr(a, "__name__", a),
)
def test_mutant_is_caught(monkeypatch, check, bug):
    module = changed(MODULE_OF.get(check, "adaptation"), *CHECKS[check][bug])
    with pytest.raises(AssertionError):
        run(monkeypatch, check, module)
