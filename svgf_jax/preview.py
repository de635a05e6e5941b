"""Pictures to look at: tone-mapped 8-bit images, labelled, side by side or split, as PNG, MP4, GIF or WebP. No JAX."""

import importlib
import shutil
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from svgf_jax import atomic, tonemapping
from svgf_jax.types import SvgfError

CURVE = "reinhard-extended"  # what pictures are shown in unless another is asked for


def to_8bit(image: np.ndarray, *, exposure: float = 1.0, curve: str = CURVE) -> np.ndarray:
    """Scene-linear `[H, W, 3]` to 8-bit sRGB `[H, W, 3]` uint8: exposure, a curve of `tonemapping`, the sRGB curve.

    `exposure` is a factor on the radiance, > 0. Negative and nan count as 0, infinity is white.
    """
    linear = np.nan_to_num(np.asarray(image, np.float32))
    shown = tonemapping.encode_srgb(tonemapping.tonemap(linear, curve=curve, exposure=exposure))
    return (shown * 255 + 0.5).astype(np.uint8)


def frame_rate(fps: float) -> Fraction:
    """Frames per second as the fraction that a video stores (23.976 is 2997/125); `SvgfError` outside [0.1, 1000]."""
    if not 0.1 <= fps <= 1000:
        raise SvgfError(f"Got {fps} frames per second; wanted a number from 0.1 to 1000, for example 24 or 23.976.")
    return Fraction(fps).limit_denominator(1001)


def side_by_side(panels: Sequence[tuple[str, np.ndarray]]) -> np.ndarray:
    """8-bit `[H, W, 3]` pictures of one height in a row, each with its label on a strip above: `[H', W', 3]` uint8."""
    if len({picture.shape[0] for _, picture in panels}) != 1:
        shapes = [picture.shape for _, picture in panels]
        raise SvgfError(f"Cannot set pictures of shapes {shapes} side by side: wanted at least one, all of one height.")
    size = max(11, panels[0][1].shape[0] // 18)
    strip, gap = round(1.7 * size), 2
    width = sum(picture.shape[1] for _, picture in panels) + gap * (len(panels) - 1)
    canvas = Image.new("RGB", (width, panels[0][1].shape[0] + strip), (24, 24, 24))
    draw, left = ImageDraw.Draw(canvas), 0
    for label, picture in panels:
        canvas.paste(Image.fromarray(picture), (left, strip))
        middle = (left + picture.shape[1] / 2, strip / 2)
        draw.text(middle, label, fill=(235, 235, 235), font=ImageFont.load_default(size), anchor="mm")
        left += picture.shape[1] + gap
    return np.asarray(canvas)


def split_screen(panels: Sequence[tuple[str, np.ndarray]], *, position: float | None = None) -> np.ndarray:
    """8-bit `[H, W, 3]` pictures of one size as stripes of one picture, from left to right, each with its label in it.

    `position` in [0, 1] is where the line between two pictures is, as a part of the width; None divides the width equally.
    A label that its stripe has no room for is left out. Returns `[H, W, 3]` uint8.
    """
    if len({picture.shape for _, picture in panels}) != 1 or (position is not None and len(panels) != 2):
        shapes = [picture.shape for _, picture in panels]
        raise SvgfError(
            f"Cannot split a screen between pictures of shapes {shapes}{'' if position is None else f' at {position}'}: "
            "wanted pictures of one size, and two of them where the line has a place of its own."
        )
    height, width = panels[0][1].shape[:2]
    cuts = [position] if position is not None else [i / len(panels) for i in range(1, len(panels))]
    edges = [0, *(min(max(round(cut * width), 0), width) for cut in cuts), width]
    size = max(11, height // 20)
    font = ImageFont.load_default(size)
    canvas = Image.new("RGB", (width, height))
    draw = ImageDraw.Draw(canvas)
    for (label, picture), left, right in zip(panels, edges, edges[1:], strict=False):
        canvas.paste(Image.fromarray(np.ascontiguousarray(picture[:, left:right])), (left, 0))
        wide = draw.textlength(label, font=font) + size
        if label and wide <= right - left:
            middle = (left + right) / 2
            draw.rectangle((middle - wide / 2, size * 0.4, middle + wide / 2, size * 2.0), fill=(24, 24, 24))
            draw.text((middle, size * 1.2), label, fill=(235, 235, 235), font=font, anchor="mm")
    for edge in edges[1:-1]:
        draw.line((edge, 0, edge, height), fill=(235, 235, 235), width=max(1, height // 270))
    return np.asarray(canvas)


def write_animation(path: str | Path, pictures: Iterable[np.ndarray], *, fps: float = 24.0) -> float:
    """Write `[H, W, 3]` uint8 pictures of one size as an endless GIF (256 colours a picture) or WebP, by the name's suffix.

    GIF knows hundredths of a second and WebP thousandths: the frame rate is the nearest of these, and returned. Equal pictures
    in a row become one that lasts longer. Written under a temporary name and then renamed; `SvgfError` where that fails.
    """
    kind = Path(path).suffix.lower()
    tick = {".gif": 10, ".webp": 1}[kind]  # milliseconds
    duration = max(round(1000 / float(frame_rate(fps)) / tick), 1) * tick

    def images() -> Iterable[Image.Image]:
        for picture in pictures:
            image = Image.fromarray(np.ascontiguousarray(picture))
            yield image.quantize(256, method=Image.Quantize.MEDIANCUT) if kind == ".gif" else image

    def save(temporary: str) -> None:
        frames = iter(images())
        first = next(frames, None)
        if first is None:
            raise SvgfError(f"There is no picture to put into the video {path}: wanted at least one frame.")
        options = {} if kind == ".gif" else {"quality": 90, "method": 4}
        first.save(
            temporary, format=kind[1:], save_all=True, append_images=frames, duration=duration, loop=0, **options
        )

    _write_atomically(path, save)
    return 1000 / duration


def write_png(path: str | Path, picture: np.ndarray) -> None:
    """Write `[H, W, 3]` uint8 as PNG, under a temporary name and then renamed. `SvgfError` where that fails."""
    _write_atomically(path, lambda temporary: Image.fromarray(picture).save(temporary, format="PNG"))


def write_video(path: str | Path, pictures: Iterable[np.ndarray], *, fps: float = 24.0) -> None:
    """Write `[H, W, 3]` uint8 pictures of one size as an MP4 (H.264, BT.709, sRGB curve), under a temporary name, then renamed.

    Holds one picture at a time. An odd width or height, which H.264 cannot store, is filled up by repeating the last
    row or column. Needs the extra `video` (PyAV); `SvgfError` without it, and where writing fails.
    """
    av, rate = _av(), frame_rate(fps)

    def encode(temporary: str) -> None:
        with av.open(temporary, "w", format="mp4") as container:
            stream = None
            for picture in pictures:
                height, width = picture.shape[:2]
                even = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
                if stream is None:
                    # Without mbtree: with AVX-512 it gives other bytes in every run (x264 core 165).
                    options = {"crf": "16", "x264-params": "mbtree=0"}
                    stream = container.add_stream("libx264", rate=rate, options=options)
                    stream.height, stream.width, stream.pix_fmt = *even.shape[:2], "yuv420p"
                    coding = stream.codec_context  # 1 = BT.709, and the range of television
                    coding.colorspace = coding.color_primaries = coding.color_range = 1
                    coding.color_trc = 13  # the curve of IEC 61966-2-1, which `to_8bit` applies
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
                container.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace="ITU709")))
            if stream is None:
                raise SvgfError(f"There is no picture to put into the video {path}: wanted at least one frame.")
            container.mux(stream.encode())

    _write_atomically(path, encode, av.FFmpegError)


def copy_file(source: str | Path, path: str | Path) -> None:
    """Copy a file, under a temporary name and then renamed. `SvgfError` where that fails."""
    _write_atomically(path, lambda temporary: shutil.copyfile(source, temporary))


def require_video() -> None:
    """Raise `SvgfError` where the extra `video` is not installed, so that a long job finds out before it starts."""
    _av()


def _av():
    """The module `av`: the only place that knows it."""
    try:
        return importlib.import_module("av")
    except ImportError as error:
        raise SvgfError(
            "A video was asked for, but the package av (PyAV) is not installed. "
            "Try `pip install 'svgf-jax[video]'`, or leave the video out."
        ) from error


def _write_atomically(path: str | Path, write: Callable[[str], object], *failures: type[Exception]) -> None:
    """Call `write(temporary name in the same folder)` and rename that to `path`; `SvgfError` where it fails."""
    try:
        with atomic.replacing(path) as temporary:
            write(str(temporary))
    except (OSError, *failures) as error:
        raise SvgfError(
            f"Could not write {path}: {getattr(error, 'strerror', None) or error}. "
            "Check that the folder exists, is writable and is not full."
        ) from error
