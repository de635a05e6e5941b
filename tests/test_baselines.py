"""What SVGF grew from: against loops, step by step as in a scan, with finite gradients, resumable; its options and their errors."""

import functools
import typing

import games202
import jax
import numpy as np
import oracle_games202 as oracle
import pytest
import scenes
from bridge import to_frame
from compiling import AS_USERS

from svgf_jax import SvgfError, exr, streaming
from svgf_jax.baselines import baseline_denoise, baseline_init, baseline_step, filter_alone, one_signal
from svgf_jax.commands import settings
from svgf_jax.frames import load_sequence, open_source
from svgf_jax.joint_bilateral import gaussian_filter
from svgf_jax.methods import METHODS, method
from svgf_jax.outputs import WriteOptions

SIZE = (10, 36)
RADIUS = 3
REAL = (200, 240)  # the corner of the real window, (y, x)
# Weights of the same order for all four guides over a window this small.
PARAMS = {"space": 2.5, "color": 0.7, "normal": 0.3, "plane": 0.2, "alpha": 0.3, "clamp": 0.8}


@functools.cache
def moving(dirty=False):
    """Synthetic frames with world positions, what moves and what comes into view."""
    frames = scenes.synthetic(5, *SIZE, frames=3, dirty=dirty)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    for frame in frames:
        frame["normal"] = np.where(frame["object_id"][..., None] == -1, 0, frame["normal"])
        z = np.where(np.isfinite(frame["depth"]), frame["depth"], 1.0)
        frame["position"] = scenes.rounded({"p": np.stack([x * z / 20, y * z / 20, z], -1)})["p"]
    return frames


@functools.cache
def real(data):
    """A window of the homework's frames, at the edge of its moving ball."""
    frames = load_sequence(data / "games202-box", frames="0-1", position=True)
    y, x = REAL
    return [
        scenes.crop({k: np.asarray(v[t]) for k, v in frames._asdict().items() if v is not None}, x, y, *SIZE[::-1])
        for t in range(2)
    ]


def chosen(name, dtype=np.float64):
    """A method with the numbers of this file and a small window."""
    params, config = method(name)
    values = {"sigma_" + k: v for k, v in PARAMS.items()} | {"alpha": PARAMS["alpha"], "clamp_sigma": PARAMS["clamp"]}
    params = params._replace(**{k: np.asarray(values[k], dtype) for k in params._fields})
    return params, config._replace(radius=RADIUS if config.filter != "none" else 0)


@functools.cache
def jitted(config, options=()):
    return jax.jit(functools.partial(baseline_step, config=config), compiler_options=dict(options))


def run(frames, name, dtype=np.float64, options=()):
    params, config = chosen(name, dtype)
    go, history, results = jitted(config, options), baseline_init(to_frame(frames[0], dtype)), []
    for frame in frames:
        history, output = go(history, to_frame(frame, dtype), params=params)
        results.append(jax.tree.map(np.asarray, (history, output)))
    return results


def assert_like_the_loops(frames, name):
    _, config = chosen(name)
    expected = oracle.denoise(
        frames,
        PARAMS,
        filter_=config.filter,
        radius=config.radius,
        footprint=config.footprint,
        temporal=config.temporal,
    )
    got = run(frames, name)
    for (history, output), (past, image, valid) in zip(got, expected, strict=True):
        np.testing.assert_allclose(output.image, image, rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(output.valid, valid)
        np.testing.assert_array_equal(output.history_length, past["length"])
        if config.temporal:
            surface = past["object_id"] != -1
            np.testing.assert_allclose(history.illumination[0][surface], past["color"][surface], rtol=1e-9, atol=1e-9)
    return got, expected


@pytest.mark.parametrize("name", ["games202", "accumulate", "joint-bilateral-atrous", "bilateral", "gaussian"])
def test_methods_are_the_loops(name):
    got, _ = assert_like_the_loops(moving(), name)
    surface = moving()[-1]["object_id"] != -1
    share = got[-1][1].valid[surface].mean()
    assert 0.2 < share < 0.95 if METHODS[name].config.temporal else share == 0


def test_dirty_frames_are_the_loops():
    assert_like_the_loops(moving(dirty=True), "games202")


def test_the_homework_is_the_loops(data):
    got, _ = assert_like_the_loops(real(data), "games202")
    moves = real(data)[-1]["object_id"] == 6
    assert 0.2 < moves.mean() < 0.6
    for pixels in (moves, ~moves):
        assert 0.5 < got[-1][1].valid[pixels].mean() < 0.9


def test_a_sequence_is_its_steps():
    params, config = chosen("games202")
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *map(to_frame, moving()))
    sequence = jax.jit(functools.partial(baseline_denoise, config=config), compiler_options=dict(AS_USERS))
    history, outputs = sequence(stacked, params=params)
    steps = run(moving(), "games202", options=AS_USERS)
    jax.tree.map(np.testing.assert_array_equal, history, steps[-1][0])
    for t, (_, output) in enumerate(steps):
        jax.tree.map(lambda a, b, t=t: np.testing.assert_array_equal(a[t], b), outputs, output)


def test_gradients_are_finite():
    """Of what is around the filter, that is; its own are in `test_joint_bilateral`."""
    params, config = chosen("accumulate", np.float32)
    first, second = (to_frame(frame, np.float32) for frame in moving(dirty=True)[:2])
    inputs = {name: getattr(second, name) for name in ("radiance", "emission", "depth", "motion")}
    history = baseline_init(first)._replace(
        illumination=np.nan_to_num(first.radiance[:1], posinf=0, neginf=0), object_id=first.object_id
    )

    def loss(params, inputs, history):
        _, output = baseline_step(history, second._replace(**inputs), params=params, config=config)
        return (output.image**2).mean()

    gradients = jax.jit(jax.grad(loss, argnums=(0, 1), allow_int=True))(params, inputs, history)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    assert all(np.asarray(leaf) != 0 for leaf in gradients[0])


def test_demodulated_light_is_filtered_alone():
    """A textured wall under even light: the texture stays, while the filtered beauty loses it; emission is added again."""
    frame = scenes.flat(*SIZE, signals=2) | {"position": moving()[0]["position"]}
    frame["albedo"] *= 0.2 + 0.6 * (np.arange(SIZE[1]) % 2)[None, None, :, None]
    frame["radiance"] *= frame["albedo"]
    frame["emission"] += 0.25
    beauty = frame["radiance"].sum(axis=0) + frame["emission"]
    params, config = chosen("gaussian")
    images = {}
    for demodulate in (False, True):
        go = jitted(config._replace(demodulate=demodulate))
        images[demodulate] = go(baseline_init(to_frame(frame)), to_frame(frame), params=params)[1].image
    np.testing.assert_allclose(images[True], beauty, rtol=1e-12)
    assert np.abs(images[False] - beauty).max() > 0.2
    each = to_frame(frame | {"albedo": np.repeat(frame["albedo"], 2, axis=0)})
    with pytest.raises(SvgfError, match="one albedo for all signals; got 2"):
        baseline_step(baseline_init(each), each, params=params, config=config._replace(demodulate=True))


def test_positions_are_asked_for():
    frame = to_frame(scenes.flat(3, 4))
    with pytest.raises(SvgfError, match="position=True"):
        baseline_step(baseline_init(frame), frame)
    wrong = frame._replace(position=np.zeros((3, 4)))
    with pytest.raises(SvgfError, match=r"position has shape \(3, 4\)"):
        baseline_init(wrong)


def test_a_broken_position_is_no_surface():
    frame = to_frame({name: value.copy() for name, value in moving()[0].items()})
    y, x = np.argwhere(frame.object_id != -1)[7]
    frame.position[y, x] = np.nan
    params, config = chosen("joint-bilateral-atrous")
    output = jitted(config)(baseline_init(frame), frame, params=params)[1]
    assert int(output.rejected.surface) == 1
    assert np.isfinite(output.image).all()


# From disk to disk


def test_resumed_is_the_same_bit_for_bit(tmp_path):
    shot = games202.write_shot(tmp_path / "box")
    params, config = method("accumulate")
    options = {"params": params, "config": config, "method": "accumulate", "checkpoint_every": 2}
    options["options"] = WriteOptions(diagnostics=True, png=True)

    def go(out, **more):
        return streaming.run(open_source(shot), tmp_path / out, **options, **more)

    go("whole")
    assert go("parts", stop=lambda: True).interrupted
    summary = go("parts", resume=True)
    assert (summary.resumed_at, summary.interrupted) == (1, False)
    for file in sorted((tmp_path / "whole").glob("beauty_*")):
        assert file.read_bytes() == (tmp_path / "parts" / file.name).read_bytes()
    image = exr.read(tmp_path / "whole" / "beauty_3.exr")
    assert image.attributes["svgf_jax:method"] == "accumulate"
    assert {name for name in image.channels if name.startswith("svgf.")} == {"svgf.history_length", "svgf.valid"}
    moved = [m.copy() for m in games202.matrices(0)]
    moved[1][0, 3] += 0.5
    (shot / "input" / "matrix_0.mat").write_bytes(games202.pack(*moved))
    with pytest.raises(SvgfError, match=r"input frame 1 was .*matrix_0\.mat"):
        go("parts", resume=True)


# Names and numbers


def test_the_command_knows_every_method():
    assert set(typing.get_args(settings.Method)) == {"svgf", *METHODS}


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("gaussian", ["sigma_normal=1"]), "method gaussian has no 'sigma_normal' .it belongs to svgf, games202"),
        (("svgf", ["sigma_plane=1"]), "method svgf has no 'sigma_plane' .it belongs to games202"),
        (("games202", ["max_history=3"]), "belongs to svgf"),
        (("games202", ["levels=3"]), "levels and last_pass are of the footprint atrous"),
        (("bilateral", ["footprint=separable", "last_pass=true"]), "levels and last_pass are of the footprint atrous"),
        (("games202-atrous", ["levels=9"]), "wanted none or 0 or 1"),
        (("games202", ["sigma_colour=3"]), "did you mean sigma_color"),
        (("games202", ["temporal=false"]), "has no 'temporal'"),
        (("games202", ["alpha=3"]), "wanted a number from 0 to 1"),
        (("games202", ["sigma_color=1,2"]), "wanted a number >= 0$"),
        (("games202", ["sigma_color=abc"]), "wanted a number.$"),
        (("games202", ["radius=-1"]), "wanted a whole number from 0 to 128"),
        (("games202", ["footprint=round"]), "wanted full or separable or atrous"),
        (("svgf", ["fallback=maybe"]), "wanted true or false"),
    ],
)
def test_what_a_method_does_not_have_is_told(arguments, complaint):
    name, changes = arguments
    with pytest.raises(SvgfError, match=complaint):
        settings.choose_method(name, None, None, changes)


def test_the_passes_of_atrous_are_set_by_name():
    """And arrive in the filter."""
    frame = one_signal(to_frame(moving()[0], np.float64), config=method("gaussian")[1])
    for passes in ({}, {"levels": 1}, {"levels": 2, "last_pass": True}, {"levels": None, "last_pass": False}):
        changes = [f"{name}={str(value).lower()}" for name, value in passes.items()]
        _, params, config = settings.choose_method("gaussian", None, None, ["footprint=atrous", "radius=3", *changes])
        got = filter_alone(frame.radiance, frame, params=params, config=config)[0]
        options = {"sigma": params.sigma_space, "radius": 3, "footprint": "atrous", "mask": frame.object_id != -1}
        np.testing.assert_array_equal(got, gaussian_filter(frame.radiance[0], **options, **passes))
    _, _, config = settings.choose_method("joint-bilateral-atrous", None, None, ["levels=3", "last_pass=true"])
    assert (config.levels, config.last_pass) == (3, True)


def test_presets_belong_to_svgf():
    with pytest.raises(SvgfError, match="--preset is of svgf"):
        settings.choose_method("games202", "paper", None, [])


def test_numbers_are_set_by_name():
    record, params, config = settings.choose_method(
        "games202", None, None, ["sigma_color=0.3", "radius=8", "fallback=true"]
    )
    assert record == "games202 sigma_color=0.3 radius=8 fallback=true"
    assert (params.sigma_color, params.alpha, config.radius, config.fallback) == (0.3, 0.2, 8, True)
    with pytest.raises(SvgfError, match="Did you mean games202"):
        method("games2002")
