"""Frames sent to tev, received by a small server that speaks its protocol.

A packet is its length (uint32, itself included), a type (uint8) and what belongs to that type, little-endian, texts ending in 0.
CREATE (4): grab focus, name, width, height, number of channels, their names. UPDATE (6): grab focus, name, number of channels,
their names, x, y, width, height, for each channel its offset and its stride (int64, in values), and the values (float32).
"""

import contextlib
import socket
import struct
import sys
import threading

import numpy as np
import pytest
from shots import init, step, write_shot
from test_dry_run import run as run_command

from svgf_jax import exr, streaming
from svgf_jax.frames import open_source, read_frame
from svgf_jax.outputs import WriteOptions
from svgf_jax.tev import tev
from svgf_jax.types import SvgfError


class Viewer:
    """What tev would show: images by name, planes by channel; `leave_after` packets it goes away."""

    def __init__(self, leave_after=None):
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.address = f"localhost:{self.socket.getsockname()[1]}"
        self.images, self.leave_after = {}, leave_after
        self.thread = threading.Thread(target=self.serve)
        self.thread.start()

    def serve(self):
        try:
            connection, _ = self.socket.accept()
        except OSError:  # closed before it came to this
            return
        with connection, connection.makefile("rb") as stream:
            count = 0
            while (self.leave_after is None or count < self.leave_after) and len(size := stream.read(4)) == 4:
                self.receive(stream.read(struct.unpack("<I", size)[0] - 4))
                count += 1

    def receive(self, data):
        kind, at = data[0], 2

        def text():
            nonlocal at
            end = data.index(0, at)
            found, at = data[at:end].decode(), end + 1
            return found

        def numbers(form):
            nonlocal at
            found = struct.unpack_from(form, data, at)
            at += struct.calcsize(form)
            return found

        name = text()
        if kind == 4:
            width, height, count = numbers("<3i")
            self.images[name] = {text(): np.full((height, width), np.nan, np.float32) for _ in range(count)}
        elif kind == 6:
            (count,) = numbers("<i")
            channels = [text() for _ in range(count)]
            x, y, width, height = numbers("<4i")
            offsets, strides = numbers(f"<{count}q"), numbers(f"<{count}q")
            values = np.frombuffer(data[at:], "<f4")
            for channel, offset, stride in zip(channels, offsets, strides, strict=True):
                plane = values[offset::stride][: width * height].reshape(height, width)
                self.images[name][channel][y : y + height, x : x + width] = plane
        else:
            raise AssertionError(f"packet of type {kind}")

    def close(self):
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)
        self.socket.close()
        self.thread.join(10)


def run(shot, out, **options):
    return streaming.run(
        open_source(shot), out, pipeline=(init, step), options=WriteOptions(full_float=True), **options
    )


def test_every_frame_arrives_with_its_layers(tmp_path):
    pytest.importorskip("tevclient")
    shot, viewer = write_shot(tmp_path / "in", [1, 2, 3]), Viewer()
    with tev(viewer.address) as send:
        run(shot, tmp_path / "out", on_output=send)
    viewer.close()
    assert viewer.images.keys() == {f"svgf-jax frame {number}" for number in (1, 2, 3)}
    for index, number in enumerate((1, 2, 3)):
        planes = viewer.images[f"svgf-jax frame {number}"]
        output = exr.read(tmp_path / "out" / f"shot.{number:04d}.exr")
        frame = read_frame(open_source(shot), index).frame
        noisy = frame.radiance.sum(0) + frame.emission
        for c, name in enumerate("RGB"):
            np.testing.assert_array_equal(planes[name], output.channels[name])
            np.testing.assert_array_equal(planes[f"noisy.{name}"], noisy[..., c])
        assert (planes["history_length"] == number).all()
        assert (planes["valid"] == (number > 1)).all()
        assert np.isfinite(planes["variance"]).all()


def test_a_dry_run_finds_the_viewer_or_says_that_there_is_none(tmp_path, capsys):
    pytest.importorskip("tevclient")
    shot, viewer = write_shot(tmp_path / "in", [1, 2]), Viewer()
    code, _, error = run_command(
        capsys, "denoise", shot, "-o", tmp_path / "out", "--dry-run", "--tev-address", viewer.address
    )
    viewer.close()
    assert (code, viewer.images) == (0, {})
    assert f"tev listens at {viewer.address}" in error
    code, _, error = run_command(
        capsys, "denoise", shot, "-o", tmp_path / "out", "--dry-run", "--tev-address", viewer.address
    )
    assert code == 2
    assert f"No tev at {viewer.address}" in error


def test_a_viewer_that_goes_away_does_not_end_the_run(tmp_path):
    pytest.importorskip("tevclient")
    shot, viewer, told = write_shot(tmp_path / "in", range(1, 8), size=(120, 160)), Viewer(leave_after=2), []
    with tev(viewer.address, tell=told.append) as send:
        summary = run(shot, tmp_path / "out", on_output=send)
    viewer.close()
    assert summary.statuses == {"filtered": 7}
    assert len(told) == 1
    assert "is gone" in told[0]


@pytest.mark.parametrize("address", ["localhost", ":14158", "localhost:tev", "localhost:", "localhost:70000"])
def test_an_address_is_host_and_port(address):
    with pytest.raises(SvgfError, match="wanted HOST:PORT"), tev(address):
        pass


def test_without_the_client_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "tevclient", None)
    with pytest.raises(SvgfError, match=r"svgf-jax\[tev\]"), tev():
        pass


def test_no_viewer_is_told_before_the_run():
    pytest.importorskip("tevclient")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(SvgfError, match=f"No tev at localhost:{port}"), tev(f"localhost:{port}"):
        pass
