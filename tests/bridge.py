"""From the dicts that `oracle` and `scenes` speak to the library's types and back; the library jitted once per case."""

import functools

import jax
import numpy as np
import oracle

from svgf_jax.pipeline import denoise, init, step
from svgf_jax.types import Config, Frame, History, Output, Params

DTYPES = (np.float64, np.float32)
PRESETS = {
    "paper": (oracle.PAPER, oracle.PAPER_CONFIG),
    "falcor": (oracle.FALCOR, oracle.FALCOR_CONFIG),
}
COMPARED = ("image", "illumination", "variance", "variance_filtered", "history_length", "valid")


def to_frame(frame, dtype=np.float64) -> Frame:
    with np.errstate(over="ignore"):
        given = {k: v for k, v in frame.items() if v is not None}
        return Frame(**{k: np.asarray(v, np.int32 if k == "object_id" else dtype) for k, v in given.items()})


def to_frames(frames, dtype=np.float64) -> Frame:
    """A sequence: one Frame with a leading T."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *[to_frame(f, dtype) for f in frames])


def to_history(history, dtype=np.float64) -> History:
    return History(**{k: np.asarray(v, np.int32 if k == "object_id" else dtype) for k, v in history.items()})


def to_params(params, dtype=np.float64) -> Params:
    """All as arrays of one type; what the oracle does not know keeps its default."""
    return Params(**{k: np.asarray(v, dtype) for k, v in (Params()._asdict() | params).items()})


def to_config(config) -> Config:
    return Config(**config)


@functools.cache
def jitted(function, config: Config, options=()):
    return jax.jit(functools.partial(function, config=config), compiler_options=dict(options))


def jitted_step(config: Config, options=()):
    return jitted(step, config, options)


def jitted_denoise(config: Config, options=()):
    return jitted(denoise, config, options)


def run(
    frames, params=oracle.PAPER, config=oracle.PAPER_CONFIG, dtype=np.float64, options=()
) -> list[tuple[History, Output]]:
    """The library over a list of frames, one jitted step at a time: NumPy (History, Output) of each."""
    go, history, results = jitted_step(to_config(config), options), init(to_frame(frames[0], dtype)), []
    for frame in frames:
        history, output = go(history, to_frame(frame, dtype), params=to_params(params, dtype))
        results.append(jax.tree.map(np.asarray, (history, output)))
    return results


def relative_error(actual, expected, size=0.0):
    """Per element: |actual - expected| / (|expected| + 1e-3 of the largest), or of `size` if that is larger."""
    actual, expected = np.asarray(actual, np.float64), np.asarray(expected, np.float64)
    assert actual.shape == expected.shape
    assert np.isfinite(expected).all()
    scale = np.abs(expected) + 1e-3 * max(np.abs(expected).max(initial=0), size)
    error = np.abs(actual - expected)
    return np.where(error == 0, 0, error / np.where(scale > 0, scale, 1))


def worst(results, expected) -> dict[str, float]:
    """The largest relative error of each output over all frames; the history too, its guides only where they count."""
    errors = dict.fromkeys(COMPARED, 0.0)
    for (history, output), wanted in zip(results, expected, strict=True):
        # The variance is a small difference of large moments: no two ways of rounding agree on its last digits.
        second_moment = wanted["history"]["moments"][..., 1].max()
        for name in COMPARED:
            size = second_moment if name.startswith("variance") else 0.0
            errors[name] = max(errors[name], relative_error(getattr(output, name), wanted[name], size).max())
        for name in ("illumination", "moments", "history_length"):
            error = relative_error(getattr(history, name), wanted["history"][name]).max()
            errors[f"history.{name}"] = max(errors.get(f"history.{name}", 0.0), error)
        surface = wanted["history"]["object_id"] != -1
        np.testing.assert_array_equal(np.asarray(history.object_id), wanted["history"]["object_id"])
        for name in ("depth", "normal"):
            got, want = np.asarray(getattr(history, name))[surface], wanted["history"][name][surface]
            np.testing.assert_array_equal(got, want.astype(got.dtype))
    return errors
