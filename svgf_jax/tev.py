"""Frames sent to a running tev viewer as they are made. Needs the extra `tev` (tevclient); NumPy only."""

import contextlib
import importlib
import threading
from collections.abc import Callable, Generator

import numpy as np

from svgf_jax.frames import LoadedFrame
from svgf_jax.types import Output, SvgfError

ADDRESS = "localhost:14158"  # where tev listens if nothing else is said


@contextlib.contextmanager
def tev(
    address: str = ADDRESS, *, tell: Callable[[str], None] = lambda text: None
) -> Generator[Callable[[LoadedFrame, Output], None]]:
    """What `streaming.run(on_output=...)` takes: it sends each frame to tev as one image `svgf-jax frame N`.

    The image has the layers R G B (denoised), noisy, variance, history_length and valid. A viewer that goes away while the
    run lasts is told once, and the run goes on. Raises SvgfError: no tevclient, no HOST:PORT, nobody there.
    """
    host, colon, port = address.rpartition(":")
    if not (colon and host and port.isdigit() and int(port) < 65536):
        raise SvgfError(f"Got {address} as the address of tev; wanted HOST:PORT, for example {ADDRESS}.")
    client = _tevclient()
    lock = threading.Lock()  # frames come from several threads
    with contextlib.ExitStack() as stack:
        viewer = client.Ipc(host, int(port))
        try:
            stack.enter_context(viewer)
        except OSError as error:
            viewer.__exit__(None, None, None)  # it leaves its socket open
            raise SvgfError(
                f"No tev at {address} ({error}). Start tev first, or say where it listens: --tev-address HOST:PORT."
            ) from error
        gone = False

        def send(item: LoadedFrame, output: Output) -> None:
            nonlocal gone
            channels = _channels(item, output)
            pixels = np.stack(list(channels.values()), axis=-1)
            name = f"svgf-jax frame {item.number}"
            with lock:
                if gone:
                    return
                try:
                    viewer.create_image(name, pixels.shape[1], pixels.shape[0], list(channels), grab_focus=True)
                    viewer.update_image(name, pixels, list(channels), perform_tiling=False)
                except OSError as error:
                    gone = True
                    tell(f"tev at {address} is gone ({error}); frames from {item.number} on are not sent")

        yield send


def _channels(item: LoadedFrame, output: Output) -> dict[str, np.ndarray]:
    """The planes `[H, W]` float32 of one frame by the names that tev groups layers by."""
    noisy = item.frame.radiance.sum(0) + item.frame.emission
    planes = {name: output.image[..., c] for c, name in enumerate("RGB")}
    planes |= {f"noisy.{name}": noisy[..., c] for c, name in enumerate("RGB")}
    if output.variance is not None:
        planes["variance"] = np.asarray(output.variance).sum(0)
    planes |= {"history_length": output.history_length, "valid": output.valid}
    return {name: np.asarray(plane, np.float32) for name, plane in planes.items()}


def _tevclient():
    """The module `tevclient`: the only place that knows it."""
    try:
        return importlib.import_module("tevclient")
    except ImportError as error:
        raise SvgfError(
            "--tev needs the package tevclient, which is not installed. Try `pip install 'svgf-jax[tev]'`, or leave it out."
        ) from error
