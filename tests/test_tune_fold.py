"""The triangle of [J r] against the rows themselves, and the free coordinates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from svgf_jax import Config, Params, SvgfError
from svgf_jax.parameters import BOUNDS
from tune.fold import combine, factor_blocks, fold
from tune.free import GATES, PER_LEVEL, choose, from_free, natural, params_at, slope, to_free

CONFIG = Config()
ALL_ON = CONFIG._replace(light_cell=4, variance="temporal", clamp_radius=3, taa=True, outlier_radius=3)  # all are read


@settings(deadline=None)
@given(
    columns=st.integers(1, 9),
    sizes=st.lists(st.integers(0, 70), min_size=1, max_size=5),
    block_rows=st.integers(1, 40),
    seed=st.integers(0, 2**31),
    degenerate=st.booleans(),
)
def test_fold_keeps_every_product(columns, sizes, block_rows, seed, degenerate):
    rng = np.random.default_rng(seed)
    blocks = [rng.normal(size=(size, columns)) * 10.0 ** rng.uniform(-3, 3, columns) for size in sizes]
    if degenerate:
        for block in blocks:
            block[:, -1] = block[:, 0]
    triangle = np.zeros((columns, columns))
    for block in blocks:
        triangle = fold(triangle, block, block_rows=block_rows)
    rows = np.concatenate(blocks)
    scale = np.linalg.norm(rows, axis=0)
    tolerance = 1e-12 * (np.outer(scale, scale) + 1e-300)
    assert (np.abs(triangle.T @ triangle - rows.T @ rows) <= tolerance).all()
    assert (np.diag(triangle) >= 0).all()
    np.testing.assert_array_equal(triangle, np.triu(triangle))


def test_fold_is_the_dense_factor():
    rows = np.random.default_rng(0).normal(size=(1000, 6))
    dense = np.linalg.qr(rows, mode="r")
    dense *= np.sign(np.diag(dense))[:, None]
    np.testing.assert_allclose(fold(np.zeros((6, 6)), rows, block_rows=64), dense, atol=1e-12)
    np.testing.assert_allclose(combine(factor_blocks(rows, block_rows=64)), dense, atol=1e-12)


def test_fold_stays_accurate_where_normal_equations_do_not():
    """Columns that differ by one part in 10^9: J'J in float64 has lost that, the triangle has not."""
    rng = np.random.default_rng(1)
    column = rng.normal(size=(5000, 1))
    rows = np.hstack([column, column + 1e-9 * rng.normal(size=column.shape)])
    triangle = fold(np.zeros((2, 2)), rows)
    assert triangle[1, 1] == pytest.approx(1e-9 * np.sqrt(5000), rel=0.05)


@settings(deadline=None)
@given(st.sampled_from(sorted(BOUNDS)), st.floats(-200, 200))
def test_free_coordinates_never_leave_the_bounds(name, y):
    coordinates = choose(Params(), ALL_ON, names=[name])
    least, most = BOUNDS[name]
    value = natural(np.array([y]), coordinates)[0]
    assert least <= value <= most
    assert np.isfinite(value)
    traced = float(getattr(from_free(jnp.asarray([y], jnp.float32), coordinates.start, coordinates.free), name))
    assert least <= traced <= most
    assert np.isfinite(traced)


@pytest.mark.parametrize("per_level", [False, True])
def test_free_coordinates_there_and_back(per_level):
    params = Params(short_history_boost=3.0, sigma_luminance=np.array([4.0, 3.0, 2.0, 2.0, 1.0]))
    coordinates = choose(params, ALL_ON, names=["all"], per_level=per_level)
    y = to_free(coordinates.start, coordinates)
    traced, host = from_free(jnp.asarray(y), coordinates.start, coordinates.free), params_at(y, coordinates)
    for name, value in params._asdict().items():
        np.testing.assert_allclose(
            getattr(host, name), np.broadcast_to(value, np.shape(getattr(host, name))), rtol=1e-12
        )
        np.testing.assert_allclose(np.asarray(getattr(traced, name)), getattr(host, name), rtol=1e-12)
        assert np.ndim(getattr(host, name)) == (
            1 if (name in PER_LEVEL and per_level) or name == "sigma_luminance" else 0
        )
    assert not coordinates.notes


def test_slope_is_the_derivative_of_the_value():
    coordinates = choose(Params(short_history_boost=2.0), ALL_ON, names=["all"])
    y = to_free(coordinates.start, coordinates)
    jacobian = jax.jacfwd(
        lambda y: jnp.stack([jnp.asarray(leaf) for leaf in from_free(y, coordinates.start, coordinates.free)])
    )(jnp.asarray(y))
    np.testing.assert_allclose(np.diag(np.asarray(jacobian)), slope(y, coordinates), rtol=1e-9)


def test_choice_of_numbers():
    chosen = choose(Params(), CONFIG, names=["sigma_luminance[2]", "alpha", "kernel_far"], per_level=["kernel_far"])
    assert chosen.labels == ("sigma_luminance[2]", "alpha", *(f"kernel_far[{i}]" for i in range(5)))
    chosen = choose(Params(), CONFIG, names=["sigma_luminance", "alpha"], per_level=True, freeze=["sigma_luminance[0]"])
    assert chosen.labels == (*(f"sigma_luminance[{i}]" for i in range(1, 5)), "alpha")
    assert set(GATES) <= set(choose(Params(), CONFIG, names=["all"]).labels)
    assert "clamp_sigma" not in choose(Params(), CONFIG, names=["all"]).labels
    assert "clamp_sigma" in choose(Params(), CONFIG._replace(clamp_radius=3), names=["all"]).labels


def test_a_start_on_its_bound_is_moved_inside_and_told():
    chosen = choose(Params(alpha=1.0, short_history_boost=1.0), CONFIG, names=["alpha", "short_history_boost"])
    assert len(chosen.notes) == 2
    assert np.isfinite(to_free(chosen.start, chosen)).all()
    assert 0 < float(chosen.start.alpha) < 1 < float(chosen.start.short_history_boost)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"names": ["sigma_luminanse"]}, "Did you mean sigma_luminance"),
        ({"names": ["alpha[1]"]}, "no level 1 of alpha"),
        ({"names": ["sigma_depth[9]"]}, "there are 5 levels"),
        ({"names": ["sigma_depth[x]"]}, "one level of it"),
        ({"names": ["alpha"], "per_level": ["alpha"]}, "per level"),
        ({"names": ["alpha"], "freeze": ["alpha"]}, "nothing is left"),
        ({"names": ["clamp_sigma"]}, "nothing reads clamp_sigma"),
    ],
)
def test_what_cannot_be_tuned_says_so(options, said):
    with pytest.raises(SvgfError, match=said.replace("[", r"\[")):
        choose(Params(), CONFIG, **options)
