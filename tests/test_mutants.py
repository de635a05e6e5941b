"""Known bugs of other SVGF codes, put into this one: each must fail the test that it names.

A mutant is a change of the text of one module (what is replaced must be there, exactly once). The changed text is run as
that module, everything that imports it anew on top of it, and the named test is called with these in place.
"""

import importlib
import inspect
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import pytest
import test_joint_bilateral
import test_outliers
import test_stages_oracle

import svgf_jax

TESTS = (test_stages_oracle, test_outliers, test_joint_bilateral)


class Mutant(NamedTuple):
    """`changes` of text in the module, and the test of one of `TESTS` (with its arguments) that fails."""

    module: str
    changes: tuple[tuple[str, str], ...]
    caught_by: str
    arguments: tuple = ()


def mutant(module, old, new, caught_by, *arguments):
    return Mutant(module, ((old, new),), caught_by, arguments)


SLOPE = """p["slope"][0] * distance_x + p["slope"][1] * distance_y)"""
ISOTROPIC = """jnp.maximum(jnp.abs(p["slope"][0]), jnp.abs(p["slope"][1])) * jnp.hypot(distance_x, distance_y))"""

MUTANTS = {
    # Temporal accumulation
    "moments blended the wrong way round": mutant(
        "accumulation",
        "_blend(old, new, weight_moments)",
        "_blend(new, old, weight_moments)",
        "test_accumulate",
    ),
    "illumination blended the wrong way round": mutant(
        "accumulation",
        "_blend(old, new, weight), previous_colors",
        "_blend(new, old, weight), previous_colors",
        "test_accumulate",
    ),
    "history length without a cap": mutant(
        "accumulation",
        "jnp.minimum(previous_length + 1.0, scalars.max_history)",
        "(previous_length + 1.0)",
        "test_accumulate",
    ),
    "history length rounded down": mutant(
        "accumulation",
        "jnp.minimum(previous_length + 1.0,",
        "jnp.minimum(jnp.floor(previous_length) + 1.0,",
        "test_accumulate",
    ),
    "1 / (h + 1) for 1 / h": mutant(
        "accumulation", "1.0 / jnp.maximum(length, 1.0)", "1.0 / (length + 1.0)", "test_accumulate"
    ),
    "alpha even without history": mutant(
        "accumulation",
        "jnp.where(valid, jnp.maximum(alpha, least), 1.0)",
        "jnp.maximum(alpha, 0.0 * least)",
        "test_accumulate",
    ),
    "history not clamped": mutant("accumulation", "if not config.clamp_radius:", "if True:", "test_accumulate_as_chosen",
                                  {"clamp_radius": 3}),
    "deviation squared for the clamp": mutant(
        "windows", "jnp.sqrt(jnp.where(varies, square, 1.0))", "square", "test_accumulate_as_chosen", {"clamp_radius": 3}
    ),
    "clamped to the light of the background": mutant(
        "accumulation", "colors, frame.object_id != -1, radius", "colors, frame.object_id != -2, radius",
        "test_accumulate_as_chosen", {"clamp_radius": 3},
    ),
    "moments of the accumulated light": mutant(
        "accumulation",
        "[luminance_of_moments(color) for color in colors]",
        "[luminance_of_moments(tuple(_blend(o, c, weight) for o, c in zip(old, color)))"
        " for old, color in zip(previous_colors, colors)]",
        "test_accumulate",
    ),
    "luminance of Rec. 601": mutant("color", "(0.2126, 0.7152, 0.0722)", "(0.299, 0.587, 0.114)", "test_luminance"),
    "modulated without the floor": mutant(
        "color",
        "illumination * jnp.maximum(albedo, albedo_floor)",
        "illumination * albedo",
        "test_remodulate_undoes_demodulate",
    ),
    "floor added instead of applied": mutant(
        "color",
        "broadcast_to(jnp.maximum(albedo, albedo_floor)",
        "broadcast_to((albedo + albedo_floor)",
        "test_demodulate",
    ),
    # Reprojection
    "no history in the first row and column": mutant(
        "sampling", "(row >= 0) & (row < height) & (column >= 0)", "(row >= 1) & (row < height) & (column >= 1)",
        "test_reproject",
    ),
    "the last row and column left out": mutant(
        "sampling", "(row < height) & (column >= 0) & (column < width)",
        "(row < height - 1) & (column >= 0) & (column < width - 1)", "test_reproject",
    ),
    "one bounds test for all four taps": mutant(
        "reprojection",
        "        found = weight >= _LEAST_WEIGHT",
        "        found = (weight >= _LEAST_WEIGHT) & (y >= 0) & (y <= height - 1) & (x >= 0) & (x <= width - 1)",
        "test_reproject",
    ),
    "all four taps or none": mutant(
        "reprojection", "found = weight >= _LEAST_WEIGHT", "found = weight >= 1.0 - 1e-9", "test_reproject"
    ),
    "any weight will do": mutant("reprojection", "_LEAST_WEIGHT = 0.01", "_LEAST_WEIGHT = 1e-30",
                                 "test_reproject_trusts_no_sliver"),
    "weights not renormalised": mutant(
        "reprojection", "jnp.where(found, weight, jnp.where(found_around", "jnp.where(found, 1.0, jnp.where(found_around",
        "test_reproject",
    ),
    "no 3 x 3 fallback": mutant(
        "reprojection", "found_around = missing & (around > 0.0)", "found_around = missing & (around < 0.0)", "test_reproject"
    ),
    "fallback around the pixel to the upper left": mutant(
        "reprojection", "jnp.floor(y + 0.5).astype(jnp.int32), jnp.floor(x + 0.5)",
        "jnp.floor(y).astype(jnp.int32), jnp.floor(x)", "test_reproject",
    ),
    "object ids not compared": mutant(
        "reprojection", "q_id == p[\"id\"] if config.id_test else q_id", "q_id", "test_reproject_tells_objects_apart_by_id_alone"
    ),
    "depth not compared": mutant(
        "reprojection", " & near & ", " & ", "test_reproject_compares_the_depth_that_the_surface_had"
    ),
    "depth compared with what it is now": mutant(
        "reprojection", "\"depth\": frame.prev_depth,", "\"depth\": frame.depth,",
        "test_reproject_compares_the_depth_that_the_surface_had",
    ),
    "depth difference compared with its sign": mutant(
        "reprojection", "jnp.abs(read(guides[\"depth\"]) - p[\"depth\"]) <=", "read(guides[\"depth\"]) - p[\"depth\"] <=",
        "test_reproject_compares_the_depth_that_the_surface_had",
    ),
    "normals not compared": mutant(
        "reprojection", " & (n[0] + n[1] + n[2] >= scalars.reproject_normal)", "",
        "test_reproject_compares_the_depth_that_the_surface_had",
    ),
    "motion with the opposite sign": mutant(
        "reprojection", ".astype(motion.dtype) + motion,", ".astype(motion.dtype) - motion,", "test_reproject"
    ),
    "history length of the nearest pixel": mutant(
        "reprojection",
        "return means, found | found_around",
        "return (*means[:2], read_at(history.history_length, jnp.floor(y + 0.5).astype(jnp.int32),"
        " jnp.floor(x + 0.5).astype(jnp.int32))[0], *means[3:]), found | found_around",
        "test_reproject",
    ),
    # Variance
    "no boost of the short history": mutant(
        "variance", "jnp.where(short, v * boost,", "jnp.where(short, v,", "test_estimate_variance"
    ),
    "boost below one": mutant(
        "variance", "jnp.maximum(1.0, scalars.short_history_boost /", "(scalars.short_history_boost /",
        "test_estimate_variance",
    ),
    "four frames told without slack": mutant("variance", "= 4 - 1e-3", "= 4", "test_estimate_variance"),
    "spatial estimate for five frames and fewer": mutant("variance", "= 4 - 1e-3", "= 6 - 1e-3", "test_estimate_variance"),
    "negative variance": mutant(
        "variance", "jnp.where(difference > 0.0, difference, 0.0)", "difference", "test_variance_of_a_constant_is_not_negative"
    ),
    "a window of 5 x 5": mutant("variance", "_RADIUS = 3", "_RADIUS = 2", "test_estimate_variance"),
    "window's depth tolerance times three": mutant(
        "variance", "distance_y, distance_x = t", "distance_y, distance_x = (3.0 * t[0], 3.0 * t[1])", "test_estimate_variance"
    ),
    "window's weights without edges": mutant(
        "variance", "q[\"guides\"].surface * jnp.exp(exponent)", "q[\"guides\"].surface", "test_estimate_variance"
    ),
    "initial variance after the first frame too": mutant(
        "variance", "_NO_HISTORY = 1 + 1e-3", "_NO_HISTORY = 2 + 1e-3", "test_estimate_variance_otherwise", "temporal"
    ),
    "initial variance scaled": mutant(
        "variance", "scalars.initial_variance, scalars", "scalars.variance_scale * scalars.initial_variance, scalars",
        "test_estimate_variance_otherwise", "temporal",
    ),
    "spatial only while history is short": mutant(
        "variance", "((length < SHORT_HISTORY) | (config.variance == \"spatial\"))", "(length < SHORT_HISTORY)",
        "test_estimate_variance_otherwise", "spatial",
    ),
    # A-trous
    "variance divided by the sum of squared weights": Mutant(
        "atrous",
        (
            ("_add_tap((zero, (zero, zero, zero), zero), weight", "_add_tap((zero, (zero, zero, zero), (zero, zero)), weight"),
            ("variances + weight * (weight * variance)", "(variances[0] + weight**2 * variance, variances[1] + weight**2)"),
            ("variances / divisor / divisor", "variances[0] / jnp.maximum(variances[1], 1e-30)"),
        ),
        "test_atrous_level",
        (0,),
    ),
    "variance filtered like the light": Mutant(
        "atrous",
        (
            ("variances + weight * (weight * variance)", "variances + weight * variance"),
            ("variances / divisor / divisor", "variances / divisor"),
        ),
        "test_atrous_level",
        (0,),
    ),
    "steps starting at 2": mutant("atrous", "jnp.asarray([2**i for", "jnp.asarray([2 ** (i + 1) for", "test_feedback", 1),
    "variance blur not renormalised": mutant(
        "atrous", "jnp.where(any_weight, t / jnp.where(any_weight, weights, 1.0), 0.0)", "jnp.where(any_weight, t, 0.0)",
        "test_atrous_level", 0,
    ),
    "no variance blur": mutant(
        "atrous", "prefiltered = prefilter_variance(variances, guides.surface, margin=margin, strip_rows=strip_rows)",
        "prefiltered = variances", "test_atrous_level", 0,
    ),
    "variance blurred though not asked for": mutant(
        "atrous", "if prefilter:", "if True:", "test_atrous_level_without_prefilter"
    ),
    "blurred variance handed on": mutant(
        "atrous", "\"variance\": variances, \"luma\"", "\"variance\": prefiltered, \"luma\"", "test_atrous_level", 0
    ),
    "slope the same in all directions": mutant("atrous", SLOPE, ISOTROPIC, "test_atrous_level", 0),
    "slope not scaled with the step": mutant(
        "atrous", "jnp.asarray(_OFFSETS, dtype) * jnp.asarray(step_size, dtype)", "jnp.asarray(_OFFSETS, dtype)",
        "test_atrous_level", 1,
    ),
    "the pixel itself forgotten": mutant(
        "atrous", "weight = kernel[2] * kernel[2] * p", "weight = 0.0 * p", "test_atrous_level", 0
    ),
    "centre weight zero": mutant(
        "atrous", "scalars.kernel_near, 1.0)", "scalars.kernel_near, 0.0)", "test_atrous_level", 0
    ),
    "kernel inside out": mutant(
        "atrous", "(scalars.kernel_far, scalars.kernel_near, 1.0)", "(scalars.kernel_near, scalars.kernel_far, 1.0)",
        "test_atrous_level", 0,
    ),
    "luminance of the light that came in, at every level": Mutant(
        "atrous",
        (
            ("            strip_rows=strip_rows,\n        )\n        feedback",
             "            strip_rows=strip_rows,\n            first=first,\n        )\n        feedback"),
            ("    state = (colors, variances, colors)", "    state = (colors, variances, colors)\n    first = colors"),
            ("    strip_rows: int | None,\n) ->", "    strip_rows: int | None,\n    first=None,\n) ->"),
            ("(*color) for color in colors)", "(*color) for color in first or colors)"),
        ),
        "test_feedback",
        (1,),
    ),
    "history of the next level": mutant(
        "atrous", "i == fed_back for i in levels])", "i == fed_back + 1 for i in levels])", "test_feedback", -1
    ),
    "history of no level where feedback_level is beyond the last": mutant(
        "atrous", "config.feedback_level if config.feedback_level < config.levels else config.levels - 1",
        "config.feedback_level", "test_feedback", 9,
    ),
    "parameters of the first level for all": mutant(
        "atrous", "scalars = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf,",
        "scalars = jax.tree.map(lambda leaf: jnp.broadcast_to(jnp.atleast_1d(leaf)[0],", "test_feedback", 1,
    ),
    # Edge-stopping weights
    "variance for deviation": mutant(
        "edges", "jnp.where(varies, jnp.sqrt(jnp.where(varies, deviation_squared, 1.0)), 0.0)", "deviation_squared",
        "test_atrous_level", 0,
    ),
    "depth tolerance absolute": mutant(
        "edges", "depth_epsilon * p.depth", "depth_epsilon", "test_atrous_level", 0
    ),
    "normals through the back": mutant(
        "edges", "faces = cosine > 1e-30", "faces = (cosine := jnp.abs(cosine)) > 1e-30", "test_backs_do_not_count"
    ),
    "the larger of the depth differences": mutant(
        "edges", "jnp.abs(ahead) < jnp.abs(behind), ahead, behind", "jnp.abs(ahead) > jnp.abs(behind), ahead, behind",
        "test_depth_gradient",
    ),
    "a tie takes a side": mutant("edges", "0.5 * (ahead + behind)", "ahead", "test_depth_gradient"),
    "central differences": mutant(
        "edges", "jnp.abs(ahead) == jnp.abs(behind), 0.5", "jnp.abs(ahead) < 1e9, 0.5", "test_depth_gradient"
    ),
    "depth differences across objects": mutant(
        "edges", "(shift(object_id, sign * dy, sign * dx) == object_id) & ", "", "test_depth_gradient"
    ),
    # Temporal anti-aliasing
    "each pixel's own motion": mutant(
        "antialiasing", "q[\"near\"] > nearest", "(q[\"near\"] > nearest) & (nearest < 0)", "test_taa"
    ),
    "history not clipped": mutant("antialiasing", "m + d / outside", "m + d", "test_taa"),
    "history clamped channel by channel": mutant(
        "antialiasing", "m + d / outside for m, d in zip(centre, away, strict=True)",
        "m + jnp.clip(d, -r, r) for m, d, r in zip(centre, away, reach, strict=True)", "test_taa",
    ),
    "anti-aliasing blended the wrong way round": mutant(
        "antialiasing", "(1.0 - a) * old + a * new", "(1.0 - a) * new + a * old", "test_taa"
    ),
    "bright pixels not weighed down": mutant(
        "tonemapping", "scale = 1.0 + _luma(color)", "scale = 1.0 + 0.0 * _luma(color)", "test_taa"
    ),
    # Classic filters
    "normal distance not squared": mutant(
        "joint_bilateral", "return jnp.where(opposite, angle * angle, square)",
        "return jnp.where(opposite, angle, jnp.sqrt(square))", "test_filters_are_their_formulas", "joint", "full",
    ),
    "plane of the tap instead of the pixel": mutant(
        "joint_bilateral", "along = _dot(p.normal, between)", "along = _dot(q.normal, between)",
        "test_filters_are_their_formulas", "joint", "full",
    ),
    "sigma^2 for 2 sigma^2": mutant(
        "joint_bilateral", "return 0.5 * inverse * inverse", "return inverse * inverse",
        "test_filters_are_their_formulas", "gaussian", "full",
    ),
    "masked pixels count": mutant(
        "joint_bilateral", "counts=counts.astype(dtype) if guided else jnp.ones_like(counts, dtype)",
        "counts=jnp.ones_like(counts, dtype)", "test_filters_are_their_formulas", "bilateral", "separable",
    ),
    "steps that do not grow": mutant(
        "joint_bilateral", "[2**level for level in range(levels)]", "[1 for level in range(levels)]",
        "test_filters_are_their_formulas", "bilateral", "atrous",
    ),
    "the pixel itself among its neighbours": mutant("outliers", "centre=False", "centre=True", "test_remove_outliers", 3, 3.0),
    "outliers of the background count": mutant(
        "windows", "one = counts.astype(jax.tree.leaves(image)[0].dtype)",
        "one = jnp.ones_like(counts, jax.tree.leaves(image)[0].dtype)", "test_remove_outliers", 3, 3.0,
    ),
    # Sanitising and the whole
    "infinite radiance kept": mutant(
        "sanitation", "radiance_finite & ~negative, frame", "~jnp.isnan(frame.radiance) & ~negative, frame",
        "test_sanitise",
    ),
    "negative radiance kept": mutant("sanitation", "radiance_finite & ~negative, frame", "radiance_finite, frame",
                                     "test_sanitise"),
    "NaN guides pass as valid": mutant("sanitation", "surface = was_surface & guided", "surface = was_surface", "test_sanitise"),
    "NaN motion passes as valid": mutant(
        "sanitation", "(surface & traced)[..., None], frame.motion", "surface[..., None], jnp.nan_to_num(frame.motion)",
        "test_sanitise",
    ),
    "NaN albedo passes as valid": mutant(
        "sanitation", " & jnp.isfinite(frame.albedo).all(axis=(0, 3))", "", "test_sanitise"
    ),
    "emission forgotten": mutant("modulation", "total = emission", "total = tuple(0.0 * e for e in emission)", "test_step"),
    "background lost": mutant(
        "modulation", "jnp.where(surface, r, own)",
        "jnp.where(surface, r, 0.0)", "test_background_keeps_its_radiance",
    ),
    "filtered light fed back": mutant("pipeline", "illumination=feedback,", "illumination=filtered,", "test_step"),
}  # fmt: skip


def stages(module="pipeline", found=()) -> tuple[str, ...]:
    """The modules that a module stands on, itself included; types apart, which must stay the same types."""
    if module == "types" or module in found:
        return found
    found = (*found, module)
    for lower in re.findall(r"^from svgf_jax\.(\w+) import", source(module), re.MULTILINE):
        found = stages(lower, found)
    return found


def source(module: str) -> str:
    return (Path(inspect.getfile(svgf_jax)).parent / f"{module}.py").read_text(encoding="utf-8")


def mutated(change: Mutant) -> dict[str, ModuleType]:
    """The stages' modules, imported anew, one of them changed; what was loaded before stays what it is."""
    modules = stages("joint_bilateral", stages())
    names = [f"svgf_jax.{stage}" for stage in modules]
    kept = {name: sys.modules.pop(name) for name in names if name in sys.modules}
    try:
        text = source(change.module)
        for old, new in change.changes:
            assert text.count(old) == 1, f"{change.module}.py has {text.count(old)} times, not once: {old}"
            text = text.replace(old, new)
        module = ModuleType(f"svgf_jax.{change.module}")
        sys.modules[module.__name__] = module
        exec(compile(text, f"{change.module}.py with a bug", "exec"), module.__dict__)
        return {stage: importlib.import_module(f"svgf_jax.{stage}") for stage in modules}
    finally:
        for name in names:
            sys.modules.pop(name, None)
        sys.modules.update(kept)
        for name, module in kept.items():
            setattr(svgf_jax, name.removeprefix("svgf_jax."), module)


def put_in_place(monkeypatch, change: Mutant) -> None:
    for stage, module in mutated(change).items():
        for tests in TESTS:
            if hasattr(tests, stage):
                monkeypatch.setattr(tests, stage, module)


@pytest.mark.parametrize("name", MUTANTS)
def test_mutant_is_caught(monkeypatch, name):
    change = MUTANTS[name]
    put_in_place(monkeypatch, change)
    (test,) = (getattr(tests, change.caught_by) for tests in TESTS if hasattr(tests, change.caught_by))
    with pytest.raises(AssertionError):
        test(*change.arguments)


def test_the_modules_are_in_place_again():
    mutated(MUTANTS["emission forgotten"])
    from svgf_jax import pipeline

    assert sys.modules["svgf_jax.pipeline"] is test_stages_oracle.pipeline is pipeline


def test_an_unchanged_module_passes(monkeypatch):
    put_in_place(monkeypatch, Mutant("atrous", (), ""))
    test_stages_oracle.test_atrous_level(0)
