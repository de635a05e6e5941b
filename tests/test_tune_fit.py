"""The fit: the folded derivatives against dense ones, and parameters that data made by the filter itself knows."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scenes
from bridge import to_frames

import tune
from svgf_jax import Config, Frame, Params, SvgfError, denoise, tonemap
from tune import checkpoint, share
from tune import solver as solvers
from tune.free import choose, from_free, to_free
from tune.residuals import (
    REFERENCE,
    Seen,
    Term,
    geman_mcclure,
    huber,
    image_error,
    noisy_error,
    noisy_terms,
    reference_terms,
)
from tune.shots import shot_of_arrays, window
from tune.sweep import GATE_STEP, pose, sweep

CONFIG = Config(levels=1)  # less to compile
NAMES = ("alpha", "sigma_luminance", "sigma_normal")
TRUE = Params(alpha=0.45, sigma_luminance=2.0, sigma_normal=60.0)
START = Params(alpha=0.6)
TERMS = REFERENCE[:2]  # no prior: the truth is the least


@functools.cache
def made(frames=5, seed=3, height=16, width=20):
    """Frames, and what the filter makes of them at TRUE."""
    noisy = to_frames(scenes.synthetic(seed, height, width, frames=frames))
    _, output = jax.jit(functools.partial(denoise, config=CONFIG))(noisy, params=Params(*map(jnp.asarray, TRUE)))
    return noisy, np.asarray(output.image)


def shot(**options):
    return shot_of_arrays(*made(**options))


def problem(params=START, *, names=NAMES, terms=TERMS, shots=None, **options):
    coordinates = choose(params, CONFIG, names=names)
    return pose(coordinates, to_free(coordinates.start, coordinates), terms, shots or [shot()], **options)


def dense_residual(posed, y):
    """All residuals of all frames at once, written anew from the definition."""
    noisy, target = made()
    params = from_free(y, posed.coordinates.start, posed.coordinates.free)
    _, output = denoise(noisy, params=params, config=CONFIG)
    error = tonemap(output.image) - tonemap(jnp.asarray(target))
    share = posed.pixel_weights[0] / len(target) / error[0].size
    change = error[1:] - error[:-1]
    return jnp.concatenate([error.reshape(-1) * np.sqrt(share), change.reshape(-1) * np.sqrt(share * 0.5)])


@functools.cache
def dense_derivatives():
    """`dense_residual` and its Jacobian, compiled once."""
    residual = functools.partial(dense_residual, problem())
    return jax.jit(lambda y: (residual(y), jax.jacfwd(residual)(y)))


def test_iterates_are_those_of_the_dense_solver():
    """Four steps of `optx.least_squares` on every residual at once end where four on the triangle do."""
    posed, dense = problem(), dense_derivatives()
    shapes = jax.eval_shape(dense, posed.y_start)
    call = lambda y: jax.pure_callback(lambda y: jax.tree.map(np.asarray, dense(y)), shapes, y)  # noqa: E731
    scaled = jax.custom_jvp(lambda y: np.sqrt(solvers.SCALE) * call(y)[0])

    @scaled.defjvp
    def _(y, along):
        residual, jacobian = call(y[0])
        return np.sqrt(solvers.SCALE) * residual, np.sqrt(solvers.SCALE) * (jacobian @ along[0])

    solver = optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9)
    start = jnp.asarray(posed.y_start)
    wanted = optx.least_squares(lambda y, _: scaled(y), solver, start, max_steps=4, throw=False).value
    descent = solvers.begin(solver, posed.y_start)
    for _ in range(4):
        descent, _ = solvers.advance(descent, sweep(posed, descent.trial, linear=True).triangle)
    assert np.abs(descent.y - posed.y_start).max() > 0.3
    np.testing.assert_allclose(descent.y, wanted, rtol=0, atol=1e-6)


def test_triangle_holds_the_dense_products():
    posed = problem(terms=(*TERMS, REFERENCE[2]), tangent_batch=2)
    y = posed.y_start + np.array([0.2, -0.1, 0.3])
    found = sweep(posed, y, linear=True)
    r, j = map(np.asarray, dense_derivatives()(jnp.asarray(y)))
    away = (y - posed.y_start) * np.sqrt(0.02 / 3)
    rows = np.vstack([np.column_stack([j, r]), np.column_stack([np.eye(3) * np.sqrt(0.02 / 3), away])])
    np.testing.assert_allclose(found.triangle.T @ found.triangle, rows.T @ rows, rtol=1e-9)
    assert found.loss == pytest.approx((rows[:, -1] ** 2).sum(), rel=1e-12)
    plain = sweep(posed, y, linear=False)
    assert plain.loss == pytest.approx(found.loss, rel=1e-12)
    assert not sweep(posed, y, linear=False, bound=found.loss / 2).complete


def test_tangent_groups_change_nothing():
    y = problem().y_start
    whole, parts = (sweep(problem(tangent_batch=batch), y, linear=True).triangle for batch in (8, 1))
    np.testing.assert_allclose(whole, parts, rtol=1e-9, atol=1e-12)


STARTS = [
    START,
    Params(alpha=0.8, sigma_luminance=8.0, sigma_normal=20.0),
    Params(alpha=0.5, sigma_luminance=1.0),
]


@pytest.mark.parametrize("start", STARTS)
def test_recovers_what_made_the_data(start):
    fit = tune.fit(start, CONFIG, [shot()], TERMS, names=NAMES, least_gain=0)
    assert fit.converged, fit.result
    for name in NAMES:
        assert getattr(fit.params, name) == pytest.approx(getattr(TRUE, name), rel=1e-3)
    assert fit.loss < 1e-6
    assert [i.number for i in fit.iterations] == list(range(len(fit.iterations)))


@pytest.mark.parametrize("solver", ["dogleg", "gauss-newton"])
def test_other_solvers_find_it_too(solver):
    fit = tune.fit(START, CONFIG, [shot()], TERMS, names=NAMES, least_gain=0, solver=solver)
    assert fit.params.sigma_luminance == pytest.approx(2.0, rel=1e-3)
    assert fit.params.alpha == pytest.approx(0.45, rel=1e-3)


@pytest.mark.parametrize("name", ["alpha"])  # all of them: tests/bench/recover_each.py
def test_recovers_each_alone(name):
    start = TRUE._replace(**{name: {"alpha": 0.8, "sigma_luminance": 4.0, "sigma_normal": 128.0}[name]})
    fit = tune.fit(start, CONFIG, [shot()], TERMS, names=[name], least_gain=0)
    assert getattr(fit.params, name) == pytest.approx(getattr(TRUE, name), rel=1e-3)


def test_per_level_values_and_a_degenerate_parameter_is_named_and_stays():
    """Five frames never reach the cap of the history; the second level differs from the first."""
    noisy, _ = made()
    two, levels = Config(levels=2), np.array([1.5, 5.0])
    truth = TRUE._replace(sigma_luminance=levels)
    run = jax.jit(functools.partial(denoise, config=two))
    target = run(noisy, params=Params(*map(jnp.asarray, truth)))[1].image
    names = ("sigma_luminance", "max_history")
    little = reference_terms(prior_weight=1e-3)
    shots = [shot_of_arrays(noisy, target)]
    fit = tune.fit(TRUE, two, shots, little, names=names, per_level=["sigma_luminance"], least_gain=0)
    np.testing.assert_allclose(fit.params.sigma_luminance, levels, rtol=0.02)  # the prior pulls a little
    assert fit.knowledge.undetermined == ("max_history",)
    assert fit.params.max_history == pytest.approx(32.0)
    assert np.isinf(fit.knowledge.standard_errors[-1])
    assert np.isfinite(fit.knowledge.standard_errors[:-1]).all()


def test_resumed_fit_is_the_same_bit_for_bit(tmp_path):
    path = tmp_path / "progress.npz"
    saved = []

    def save(progress):
        saved.append(progress)
        if len(progress.iterations) == 2:
            checkpoint.save(path, progress, {"take": 1})

    options = {"names": NAMES, "least_gain": 0}
    whole = tune.fit(START, CONFIG, [shot()], TERMS, save=save, **options)
    resumed = tune.fit(
        START, CONFIG, [shot()], TERMS, resume=lambda fresh: checkpoint.load(path, fresh, {"take": 1}), **options
    )
    np.testing.assert_array_equal(whole.y, resumed.y)
    assert [i.loss for i in whole.iterations] == [i.loss for i in resumed.iterations]
    assert whole.result == resumed.result
    fresh = solvers.begin(solvers.make_solver("lm"), whole.y)
    with pytest.raises(SvgfError, match="another fit"):
        checkpoint.load(path, fresh, {"take": 2})
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(SvgfError, match="damaged"):
        checkpoint.load(path, fresh, {"take": 1})
    with pytest.raises(SvgfError, match="no checkpoint"):
        checkpoint.load(tmp_path / "none.npz", fresh, {})


def test_several_starts_keep_the_best():
    fit = tune.fit(START, CONFIG, [shot()], TERMS, names=NAMES, starts=3, max_steps=3, seed=1)
    assert {i.start for i in fit.iterations} == {0, 1, 2}
    assert fit.loss == min(i.loss for i in fit.iterations if i.accepted)


def test_an_interrupted_fit_returns_the_best_so_far():
    readings = 0

    def read(index):
        nonlocal readings
        readings += 1
        if readings > 13:
            raise KeyboardInterrupt
        return shot().read(index)

    fit = tune.fit(START, CONFIG, [shot()._replace(read=read)], TERMS, names=NAMES)
    assert fit.result.startswith("interrupted")
    assert fit.params.sigma_luminance == pytest.approx(START.sigma_luminance)


def test_interrupted_between_trial_points_it_returns_the_best_so_far():
    """Ctrl-C is likeliest right after a line has appeared."""

    def interrupt(iteration):
        if iteration.number == 2:
            raise KeyboardInterrupt

    fit = tune.fit(START, CONFIG, [shot()], TERMS, names=NAMES, on_iteration=interrupt)
    assert fit.result.startswith("interrupted")
    assert len(fit.iterations) == 3
    assert fit.loss < 1


def test_a_solver_that_loses_its_way_is_told_by_the_result_and_the_best_is_kept(monkeypatch):
    advance = solvers.advance

    def astray(descent, triangle):
        descent, accepted = advance(descent, triangle)
        if len(seen) == 2:
            state = eqx.tree_at(lambda state: state.y_eval, descent.state, jnp.full(3, jnp.nan))
            descent = descent._replace(state=state)
        seen.append(descent)
        return descent, accepted

    seen = []
    monkeypatch.setattr(solvers, "advance", astray)
    fit = tune.fit(START, CONFIG, [shot()], TERMS, names=NAMES, least_gain=0)
    assert (fit.diverged, fit.converged, len(fit.iterations)) == (True, False, 3)
    assert "--solver lm" in fit.result
    assert fit.loss == min(i.loss for i in fit.iterations) < 1
    assert np.isfinite(fit.y).all()
    np.testing.assert_array_equal([getattr(fit.params, name) for name in NAMES], fit.iterations[-1].values)


def test_holes_in_the_data_count_for_nothing():
    noisy, target = made()
    radiance = np.array(noisy.radiance)
    radiance[:, :, 3, 4] = np.nan
    holed = np.array(target)
    holed[2, 5, 6, 0] = np.nan
    holed[1] = np.inf
    whole = shot_of_arrays(noisy._replace(radiance=radiance), holed)
    fit = tune.fit(START, CONFIG, [whole], TERMS, names=NAMES)
    assert np.isfinite(fit.loss)
    assert fit.params.sigma_luminance == pytest.approx(2.0, rel=0.2)


def test_a_start_without_error_and_frames_of_another_size_say_so():
    with pytest.raises(SvgfError, match="nothing to go by"):
        tune.fit(TRUE, CONFIG, [shot()], TERMS, names=NAMES)
    noisy, target = made()
    with pytest.raises(SvgfError, match="of the same size"):
        shot_of_arrays(noisy, target[:, :-1])
    with pytest.raises(SvgfError, match="no frames"):
        tune.fit(START, CONFIG, [], TERMS, names=NAMES)
    with pytest.raises(SvgfError, match="looks at pixels"):
        tune.fit(START, CONFIG, [shot()], REFERENCE[2:], names=NAMES)
    with pytest.raises(SvgfError, match="no solver"):
        tune.fit(START, CONFIG, [shot()], TERMS, names=NAMES, solver="adam")


def test_gates_are_differentiated_across_a_step():
    names = ("reproject_depth", "sigma_luminance")
    posed = problem(Params(reproject_depth=0.0025, alpha=0.3), names=names)
    found = sweep(posed, posed.y_start, linear=True).triangle
    step = np.array([GATE_STEP, 0.0])
    dense = jax.jit(functools.partial(dense_residual, posed))
    above, below, here = (dense(jnp.asarray(posed.y_start + s)) for s in (step, -step, 0 * step))
    column = (np.asarray(above) - np.asarray(below)) / (2 * GATE_STEP)
    assert np.abs(column).max() > 0
    gram = found.T @ found
    assert gram[0, 0] == pytest.approx(float(column @ column), rel=1e-9)
    assert gram[0, 2] == pytest.approx(float(column @ np.asarray(here)), rel=1e-9)


def test_memory_does_not_grow_with_frames():
    """What lives on the device while frames are read: the same at the end of a long pass as at its beginning."""
    noisy, target = made()
    held = []

    def read(index):
        held.append(sum(array.nbytes for array in jax.live_arrays()))
        return tune.Example(Frame(*(leaf if leaf is None else leaf[index % 5] for leaf in noisy)), target[index % 5])

    posed = problem(shots=[tune.Shot("long", 40, read)])
    held.clear()
    sweep(posed, posed.y_start, linear=True)
    assert np.mean(held[22:]) <= 1.1 * np.mean(held[4:22])


def test_noisy_targets_are_unbiased():
    """The gradient against noisy targets is, in the mean, the one against their expectation."""
    rng = np.random.default_rng(0)
    image, reference, pilot = rng.gamma(1.0, 1.0, (3, 40, 40, 3))
    known, away = np.ones((40, 40)), jnp.zeros(1)
    slope = rng.normal(size=(40, 40, 3))

    def gradient(target):
        now = Seen(jnp.asarray(image), jnp.asarray(target), jnp.asarray(known), jnp.asarray(pilot))
        run = lambda t: noisy_error(now._replace(image=now.image + t * jnp.asarray(slope)), now, away)  # noqa: E731
        residual, change = jax.jvp(run, (jnp.zeros(()),), (jnp.ones(()),))
        return float((residual * change).sum())

    exact = gradient(reference)
    noisy = [gradient(reference * rng.gamma(0.5, 2.0, (40, 40, 1))) for _ in range(400)]
    assert np.mean(noisy) == pytest.approx(exact, abs=4 * np.std(noisy) / 20)


def test_two_noisy_renders_fit_like_a_reference():
    noisy, target = made()
    rng = np.random.default_rng(0)
    second = target * (1 + 0.05 * rng.choice([-1.0, 1.0], (*target.shape[:3], 1)))
    fit = tune.fit(START, CONFIG, [shot_of_arrays(noisy, second)], noisy_terms(), names=NAMES)
    assert fit.params.sigma_luminance == pytest.approx(2.0, rel=0.2)
    assert fit.params.alpha == pytest.approx(0.45, rel=0.2)


@pytest.mark.parametrize(
    ("shape", "rho"),
    [
        (huber, lambda r: np.where(np.abs(r) <= 0.1, r**2, 0.2 * np.abs(r) - 0.01)),
        (geman_mcclure, lambda r: r**2 / (1 + (r / 0.1) ** 2)),
    ],
)
def test_robust_forms_have_the_squares_they_should(shape, rho):
    x = np.linspace(-1, 1, 41)
    robust = lambda r: shape(lambda now, before, away: r, 0.1)(None, None, None)  # noqa: E731
    got, slopes = jax.jvp(robust, (jnp.asarray(x),), (jnp.ones(41),))
    np.testing.assert_allclose(np.asarray(got) ** 2, rho(x), atol=1e-12)
    assert (np.sign(got) == np.sign(x)).all()
    assert np.isfinite(slopes).all()
    assert (np.asarray(slopes) >= 0).all()


def test_a_residual_of_ones_own():
    blue = Term("blue", lambda now, before, away: image_error(now, before, away)[..., 2:])
    fit = tune.fit(START, CONFIG, [shot()], [blue], names=NAMES, least_gain=0)
    assert fit.params.sigma_luminance == pytest.approx(2.0, rel=1e-2)


def test_window_is_a_crop():
    noisy, target = made()
    part = window(shot(), rows=slice(2, 9), columns=slice(3, 15), frames=slice(1, 4))
    assert part.length == 3
    frame, wanted = part.read(0)
    np.testing.assert_array_equal(frame.radiance, noisy.radiance[1, :, 2:9, 3:15])
    np.testing.assert_array_equal(frame.depth, noisy.depth[1, 2:9, 3:15])
    np.testing.assert_array_equal(frame.motion, noisy.motion[1, 2:9, 3:15])
    np.testing.assert_array_equal(wanted, target[1, 2:9, 3:15])


def test_sequences_of_several_processes_fold_into_what_one_finds():
    posed = problem(shots=[shot(), shot(seed=4), shot(seed=5)])
    y = posed.y_start + 0.1
    whole, packed = sweep(posed, y, linear=True), []

    def keep(found, bound):
        packed.append(share._packed(found))
        return found

    parts = [sweep(posed._replace(share=share.Share(index, 2, keep)), y, linear=True) for index in range(2)]
    assert [np.count_nonzero(part.shot_losses) for part in parts] == [2, 1]
    merged = share._merged(parts[0], packed, np.inf)
    for name, value in whole._asdict().items():
        np.testing.assert_allclose(getattr(merged, name), value, rtol=1e-9, atol=1e-12, err_msg=name)
    assert not share._merged(parts[1], packed, 0.5 * whole.loss).complete
    assert share._merged(sweep(posed, y, linear=False), packed, np.inf).triangle is None
