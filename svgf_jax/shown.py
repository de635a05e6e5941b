"""From one frame's arrays to what the viewer shows of it: pictures, differences from a reference, the filter's own maps. No JAX."""

import importlib.util
from collections.abc import Mapping
from typing import Any

import numpy as np

from svgf_jax import exr, metrics, page, preview
from svgf_jax.page import GREY, HEAT, SIGNED, Legend, Shown

MOST = 24  # frames with pictures
BYTES = 12_000_000  # of all pictures together, as text
WORST = 0.1  # the difference that a map shows brightest
_LEGENDS = {
    "difference": Legend(HEAT, "0", f"{WORST} and more, in x / (1 + x)"),
    "FLIP": Legend(HEAT, "0", "1, of the pictures as shown"),
    "variance": Legend(HEAT, "1e-6", "10, in decades"),
    "history found": Legend(GREY, "none", "yes"),
    "change of light": Legend(SIGNED, "darker", "brighter"),
}


def shown_frame(
    number: int,
    pictures: Mapping[str, np.ndarray],
    target: np.ndarray | None,
    maps: Mapping[str, Mapping[str, Any]],
    count: int,
    *,
    pictures_a_frame: int = 12,
    exposure: float = 1.0,
    curve: str = preview.CURVE,
) -> Shown:
    """One of `count` frames in the viewer: images `[H, W, 3]`, their `maps` and differences from `target`, all encoded."""
    most = share(count, pictures_a_frame)
    every = pictures if target is None else {**pictures, "reference": target}
    shown = {name: preview.to_8bit(image, exposure=exposure, curve=curve) for name, image in every.items()}
    urls = {name: page.picture(picture, most=most) for name, picture in shown.items()}
    known = {name: dict(maps.get(name, {})) for name in pictures}
    psnr = {}
    for name, image in pictures.items() if target is not None else ():
        assert target is not None
        if image.shape == target.shape:
            psnr[name] = metrics.psnr(image, target)
            against = {"difference": difference(image, target)}
            if importlib.util.find_spec("flip_evaluator") is not None:
                pair = (_fitted(picture / np.float32(255)) for picture in (shown[name], shown["reference"]))
                against["FLIP"] = page.heat(metrics.flip_map(*pair))
            known[name] = encoded(against, most) | known[name]
    return Shown(number, urls, {name: found for name, found in known.items() if found}, psnr)


def difference(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """The map of |image - reference| `[H, W, 3]` uint8, the mean over the channels of x / (1 + x)."""
    return page.heat(np.abs(metrics.display(image) - metrics.display(reference)).mean(-1) / WORST)


def _fitted(image: np.ndarray) -> np.ndarray:
    """`[H, W, 3]` not much wider than a page shows: means of whole squares of pixels."""
    factor = max(1, round(image.shape[1] / page.WIDTH))
    height, width = (size // factor for size in image.shape[:2])
    squares = image[: height * factor, : width * factor].reshape(height, factor, width, factor, -1)
    return squares.mean((1, 3))


def diagnostics(
    variance: Any, length: Any, valid: Any, change: Any, worth: Any, *, params: Mapping[str, Any]
) -> dict[str, np.ndarray]:
    """The filter's own maps as pictures; what is None is not there. `params` say how bright.

    Several signals: variances add up, the largest change, the least effective history.
    """
    found = {}
    with np.errstate(all="ignore"):
        if variance is not None:
            decades = np.log10(np.maximum(np.asarray(variance, np.float64).sum(0), 1e-30))
            found["variance"] = page.heat((decades + 6) / 7)
        if length is not None:
            found["history length"] = page.heat(np.asarray(length, np.float64) / _longest(params))
        if valid is not None:
            found["history found"] = page.grey(np.asarray(valid, np.float64))
        if change is not None:
            signals = np.asarray(change, np.float64)
            largest = np.abs(signals).argmax(0)[None]
            found["change of light"] = page.signed(np.take_along_axis(signals, largest, axis=0)[0])
        if worth is not None:
            found["effective history"] = page.heat(np.asarray(worth, np.float64).min(0) / most_worth(params))
    return found


def diagnostic_layers(image: exr.Image, *, params: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The same from the layers that `--diagnostics` adds to an output."""

    def stacked(prefix: str) -> np.ndarray | None:
        planes = [plane for name, plane in image.channels.items() if name.startswith(f"svgf.{prefix}.")]
        return np.stack(planes) if planes else None

    length, valid = (image.channels.get(f"svgf.{name}") for name in ("history_length", "valid"))
    return diagnostics(
        stacked("variance"), length, valid, stacked("change"), stacked("effective_history"), params=params
    )


def legends(params: Mapping[str, Any] | None = None) -> dict[str, Legend]:
    """The maps, and what their colours mean."""
    return _LEGENDS | {
        "history length": Legend(HEAT, "0", f"{_longest(params or {}):g} frames"),
        "effective history": Legend(HEAT, "0", f"worth {most_worth(params or {}):.3g} frames"),
    }


def encoded(maps: Mapping[str, np.ndarray], most: int) -> dict[str, str]:
    """Maps as data URLs of at most so many bytes each."""
    return {name: page.picture(image, most=most) for name, image in maps.items()}


def share(count: int, pictures: int = 12) -> int:
    """Bytes a picture may have, where there are `count` frames of at most so many pictures."""
    return BYTES // (max(count, 1) * pictures)


def _longest(params: Mapping[str, Any]) -> float:
    """The longest history that there may be."""
    return float(np.max(params.get("max_history", 32.0)))


def most_worth(params: Mapping[str, Any]) -> float:
    """How many frames a history is worth in the end, whose frames all weigh as much as the last."""
    alpha = max(float(np.ravel(params.get("alpha", 0.2))[0]), 1 / _longest(params))
    return (2 - alpha) / alpha
