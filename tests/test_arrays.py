"""Frames from arrays in memory are those from files; Mitsuba's tensors are told apart by the number of their channels."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

import svgf_jax as svgf
from svgf_jax import demo
from svgf_jax.frames import open_source, read_frame

DATA = Path(__file__).parent / "data"
H, W = 3, 4
RNG = np.random.default_rng(5)
COLOR, NORMAL, GREY = RNG.random((H, W, 3)), np.broadcast_to([0.0, 0.6, -0.8], (H, W, 3)), RNG.random((H, W))


def assert_same(one, other):
    for name, a, b in zip(svgf.Frame._fields, one, other, strict=True):
        assert (a is None) == (b is None), name
        if a is not None:
            assert a.dtype == b.dtype, name
            np.testing.assert_array_equal(a, b, err_msg=name)


@pytest.mark.parametrize("name", ["cycles/multipart", "cycles/half", "mitsuba", "sample"])
def test_channels_in_memory_are_those_of_a_file(name):
    folder = demo.sample() if name == "sample" else DATA / name
    source = open_source(folder)
    items = [read_frame(source, index) for index in (0, 1)]
    cameras: list = [None, None]
    if source.cameras:
        cameras = json.loads(Path(source.cameras.path).read_text())["per_frame"][:2]
    frames = [
        svgf.frame_of(item.image.channels, camera=now, previous_camera=before)
        for item, before, now in zip(items, [None, cameras[0]], cameras, strict=True)
    ]
    for frame, item in zip(frames, items, strict=True):
        assert_same(frame, item.frame)


def test_images_by_role_are_channels_of_the_native_names():
    item = read_frame(open_source(demo.sample(), cameras=None), 1)
    there = item.image.channels
    letters = {"direct": "RGB", "indirect": "RGB", "albedo": "RGB", "emission": "RGB", "normal": "XYZ", "motion": "XY"}
    images = {name: np.stack([there[f"{name}.{one}"] for one in text], -1) for name, text in letters.items()}
    guides = {"depth": there["depth.Z"], "object_id": there["id.I"].astype(np.int64)[..., None]}
    assert_same(svgf.frame_of(images | guides | {"position": None}), item.frame)
    mixed = {name: plane for name, plane in there.items() if not name.startswith(("direct", "indirect"))}
    assert_same(svgf.frame_of(mixed | {name: images[name] for name in ("direct", "indirect")}), item.frame)


def test_what_is_not_there_is_as_with_files():
    frame = svgf.frame_of({"color": np.dstack([COLOR, GREY > 0.5])})
    np.testing.assert_array_equal(frame.radiance, COLOR[None].astype(np.float32))
    np.testing.assert_array_equal(frame.object_id, np.where(GREY > 0.5, 0, -1))  # by the alpha
    surface = frame.object_id == 0
    assert (frame.depth[surface] == 1).all()
    assert (frame.albedo == 1).all()
    assert not frame.motion.any()
    svgf.init(frame)  # shapes and dtypes fit


def test_the_role_of_a_channel_can_be_given_by_hand():
    channels = {f"mine.{c}": COLOR[..., i] for i, c in enumerate("RGB")} | {"far": 4 * GREY}
    frame = svgf.frame_of(channels, channel={"radiance": ["mine.R", "mine.G", "mine.B"], "depth": ["far"]})
    np.testing.assert_array_equal(frame.radiance[0], COLOR.astype(np.float32))
    np.testing.assert_array_equal(frame.depth, 4 * GREY.astype(np.float32))


AOVS = ["albedo.R", "albedo.G", "albedo.B", "nn.X", "nn.Y", "nn.Z", "dd.T"]
INNER = [f"{name}.{letter}" for name in ("img", "emission") for letter in "RGBA"]


@pytest.mark.parametrize("kind", ["render rgb", "render rgba", "film rgb", "film rgba"])
def test_a_mitsuba_tensor_is_read_by_the_names_of_its_integrator(kind):
    """Layouts of `mitsuba.render` and of the film's bitmap as Mitsuba 3.9.1 gives them."""
    alpha = np.ones((H, W, 1 if kind.endswith("rgba") else 0))
    beauty = np.dstack([COLOR, alpha])
    inner = (
        [beauty, 0.25 * COLOR, alpha]
        if kind.startswith("render")
        else [beauty, COLOR, np.ones((H, W, 1)), 0.25 * COLOR, np.ones((H, W, 1))]
    )
    tensor = np.dstack([*inner, 0.5 + 0 * COLOR, NORMAL, 2 + GREY]).astype(np.float32)
    assert tensor.shape[2] == {"render rgb": 13, "render rgba": 15, "film rgb": 18, "film rgba": 19}[kind]
    frame = svgf.frame_of(tensor, names=INNER + AOVS)
    np.testing.assert_allclose(frame.radiance[0], 0.75 * COLOR, rtol=1e-6)
    np.testing.assert_allclose(frame.emission, 0.25 * COLOR, rtol=1e-6)
    np.testing.assert_allclose(frame.normal, NORMAL, rtol=1e-6)
    np.testing.assert_allclose(frame.depth, 2 + GREY, rtol=1e-6)
    assert (frame.albedo == 0.5).all()


def test_motion_that_stands_in_the_frame_before_is_taken_from_there():
    images = {"radiance": COLOR, "motion": np.full((H, W, 2), 9.0)}
    frame = svgf.frame_of(images, motion="to-next y-up", previous_motion=np.full((H, W, 2), 0.5))
    np.testing.assert_array_equal(frame.motion, np.broadcast_to(np.float32([-0.5, 0.5]), (H, W, 2)))


def test_what_is_odd_is_warned_of():
    camera = {"world_to_camera": np.eye(4), "camera_to_screen": np.eye(4), "object_motion": {7: np.eye(4)}}
    with pytest.warns(UserWarning, match="beside the centres of their pixels"):
        svgf.frame_of({"radiance": COLOR, "depth": 1 + GREY, "position": 9 * COLOR}, camera=camera)


@pytest.mark.parametrize(
    ("images", "options", "complaint"),
    [
        ({"albedo": COLOR}, {}, "no radiance"),
        ({"radiance": COLOR, "direct": COLOR}, {}, "give by hand either it, or direct and indirect"),
        ({"radiance": COLOR, "normals": NORMAL}, {}, r"'normals' is \(3, 4, 3\), and no role"),
        ({"radiance": COLOR, "normal": NORMAL[..., :2]}, {}, "normal has 2 channels"),
        ({"radiance": COLOR, "depth": GREY[1:]}, {}, r"depth\[0\] \(2, 4\); wanted one size"),
        ({"radiance": COLOR[None]}, {}, r"\(1, 3, 4, 3\); wanted \[H, W, 3\] of one frame"),
        ({"radiance": COLOR, "color": COLOR}, {}, "there twice, once as color"),
        ({"radiance": (255 * COLOR).astype(np.uint8)}, {}, "radiance is uint8; wanted floating-point .*decode_srgb"),
        ({"radiance": COLOR + 1j}, {}, "complex128; wanted real numbers"),
        ({"radiance": COLOR, "depth": [[1.0], [2.0, 3.0]]}, {}, "depth: list cannot be read as an array"),
        ({"radiance": COLOR}, {"names": ["R"]}, "Leave names out"),
        ({"radiance": COLOR}, {"renderer": "pixar"}, "no renderer is called 'pixar'"),
        ({"radiance": COLOR}, {"position": True}, "no positions"),
        ({"radiance": COLOR}, {"channel": {"color": ["R", "G", "B"]}}, "given as an image and by channel"),
        ({"radiance": COLOR, "motion": COLOR}, {"motion": "world"}, "world space needs cameras"),
        ({"radiance": COLOR, "motion": COLOR[..., :2]}, {"motion": "to-next"}, "previous_motion is not there"),
        ({"radiance": COLOR}, {"previous_motion": COLOR[..., :2]}, "previous_motion is there; wanted it for to-next"),
        ({"radiance": COLOR}, {"previous_camera": {}}, "without a camera"),
        ({"radiance": COLOR}, {"camera": {"world_to_camera": [1]}}, 'camera: "world_to_camera" is wrong'),
        (COLOR, {}, "without names; wanted a dict"),
        (COLOR, {"names": ["R", "G"]}, "3 channels and 2 names"),
        (COLOR, {"names": ["R", "G", "G"]}, "no two alike"),
    ],
)
def test_misuse_is_told(images, options, complaint):
    with pytest.raises(svgf.SvgfError, match=complaint):
        svgf.frame_of(images, **options)


def test_tracing_is_told_what_to_do_instead():
    with pytest.raises(svgf.SvgfError, match=r"put in what is traced: frame._replace\(radiance=...\)"):
        jax.jit(lambda color: svgf.frame_of({"radiance": color}).radiance)(COLOR)
