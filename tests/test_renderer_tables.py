"""Renderers that cannot be run here: tiny files written to their documented conventions."""

import numpy as np
import pytest
from test_renderers import H, W, planes, put

from svgf_jax import SvgfError
from svgf_jax.frames import open_source, read_frame
from svgf_jax.references import read_radiance

HALF = np.float16


def rgb(value):
    return planes("", value, "RGB", HALF)


@pytest.fixture
def mogwai(tmp_path):
    """Falcor's frame capture: one half-float file an output, numbers without padding, of frames 9 and 10."""
    sky = np.array([[np.inf]] + [[4.0]] * (H - 1))[..., None]  # 1e8, in half float
    nothing = np.zeros_like(sky)
    for number in (9, 10):
        outputs = {
            "PathTracer.color": rgb(2),
            "GBufferRT.mvec": rgb([0.25, -0.5, 0]),
            "GBufferRT.linearZ": rgb(np.concatenate([sky, nothing, nothing], -1)),
            "GBufferRT.guideNormalW": rgb([0, 0.6, -0.8]),
            "GBufferRT.diffuseOpacity": rgb(0.5),
            "GBufferRT.emissive": rgb(0.25),
        }
        for name, channels in outputs.items():
            put(tmp_path, channels, f"Mogwai.{name}.{number}.exr")
    return tmp_path


def test_falcor_has_a_file_for_each_output(mogwai):
    source = open_source(mogwai)
    assert source.table.name == "falcor"
    assert [number for number, _ in source.sequence.files] == [9, 10]
    assert source.sequence.name.endswith("Mogwai.PathTracer.color.#.exr")
    assert source.warnings == (
        "depth is in half float, in steps of 0.1 %: slopes become stairs. Mogwai captures in half: copy the texture out in 32-bit.",
    )
    item = read_frame(source, 1)
    frame = item.frame
    np.testing.assert_array_equal(frame.motion[1, 1], [0.25 * W, -0.5 * H])
    assert (frame.object_id[0] == -1).all()
    assert (frame.object_id[1:] == 0).all()
    assert (frame.depth[1:] == 4).all()
    np.testing.assert_allclose(frame.normal[1, 1], [0, 0.6, -0.8], atol=5e-4)  # half float
    assert (frame.albedo == 0.5).all()
    np.testing.assert_allclose(frame.radiance[0] + frame.emission, 2)
    assert (frame.emission == 0.25).all()


def test_an_output_that_is_missing_says_what_to_mark(mogwai):
    for path in mogwai.glob("*.mvec.*"):
        path.unlink()
    source = open_source(mogwai / "Mogwai.PathTracer.color.#.exr")
    (told,) = [text for text in source.warnings if text.startswith("no motion")]
    assert told.endswith("In NVIDIA Falcor: mark GBufferRT.mvec as an output.")
    put(mogwai, rgb(0), "Other.GBufferRT.mvec.9.exr")
    put(mogwai, rgb(0), "Other.GBufferRT.mvec.10.exr")
    put(mogwai, rgb(0), "Mogwai.GBufferRT.mvec.9.exr")
    with pytest.raises(SvgfError, match=r"several files may be motion: .*--file motion="):
        open_source(mogwai / "Mogwai.PathTracer.color.#.exr")


def rotation(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]])


def pbrt_frame(number, coordinates, shape=(H, W)):
    """What pbrt's gbuffer film says of a surface 3 to 4 in front of a camera that turns and goes; by its documentation.

    Returns channels, header, and the world positions and normals.
    """
    height, width = shape
    to_camera = rotation(0.05 * number) @ np.array(
        [[1, 0, 0, -0.1 * number], [0, 1, 0, 0.2], [0, 0, 1, 1], [0, 0, 0, 1.0]]
    )
    tangent = 0.4  # of half the field of view along the shorter side
    to_screen = np.array([[1 / tangent, 0, 0, 0], [0, 1 / tangent, 0, 0], [0, 0, 1, -0.01], [0, 0, 1, 0]])
    to_ndc = np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0, 0, 0.5, 0.5], [0, 0, 0, 1]]) @ to_screen @ to_camera
    aspect = width / height
    world, local = np.zeros((2, height, width, 3))
    for y in range(height):
        for x in range(width):
            screen_x = (2 * (x + 0.5) / width - 1) * max(aspect, 1)
            screen_y = (1 - 2 * (y + 0.5) / height) * max(1 / aspect, 1)
            z = 3 + 0.1 * x
            local[y, x] = screen_x * tangent * z, screen_y * tangent * z, z
            world[y, x] = (np.linalg.inv(to_camera) @ [*local[y, x], 1])[:3]
    normal = np.array([0, 0.6, -0.8])
    told = local if coordinates == "camera" else world
    channels = planes_of("P", told) | planes_of("Albedo", np.full_like(told, 0.5), "RGB")
    channels |= planes_of("", np.full_like(told, 2), "RGB") | planes_of("u", told[..., :1], "x")
    turned = to_camera[:3, :3] @ normal if coordinates == "camera" else normal
    channels |= planes_of("Ns", np.broadcast_to(turned, told.shape))
    header = {"worldToCamera": to_camera.astype(np.float32), "worldToNDC": to_ndc.astype(np.float32)}
    return channels, header, world, to_camera


def planes_of(name, values, letters="XYZ"):
    stem = f"{name}." if name else ""
    return {f"{stem}{c}": np.ascontiguousarray(values[..., i], np.float32) for i, c in enumerate(letters)}


@pytest.mark.parametrize("coordinates", ["camera", "world"])
@pytest.mark.parametrize("shape", [(H, W), (W, H)])
def test_pbrt_has_its_camera_in_the_header(tmp_path, coordinates, shape):
    for number in (0, 1):
        channels, header, *_ = pbrt_frame(number, coordinates, shape)
        put(tmp_path, channels, f"p_{number:02d}.exr", attributes=header)
    source = open_source(tmp_path, position=True)
    assert (source.table.name, source.warnings) == ("pbrt", ())
    assert source.cameras.files == source.sequence.files  # what a run that is resumed looks at
    item = read_frame(source, 1)
    assert item.notes == ()
    frame = item.frame
    world = pbrt_frame(1, coordinates, shape)[2]
    np.testing.assert_allclose(frame.position, world, atol=1e-5)
    np.testing.assert_allclose(frame.normal, np.broadcast_to([0, 0.6, -0.8], world.shape), atol=1e-6)
    np.testing.assert_allclose(frame.depth, np.broadcast_to(3 + 0.1 * np.arange(shape[1]), shape), rtol=1e-5)
    before = pbrt_frame(0, coordinates, shape)[3]
    earlier = world @ before[:3, :3].T + before[:3, 3]
    np.testing.assert_allclose(frame.prev_depth, earlier[..., 2], rtol=1e-5)
    screen = earlier[..., :2] / earlier[..., 2:] / 0.4
    half = np.array([max(shape[1] / shape[0], 1), max(shape[0] / shape[1], 1)])
    pixel = (screen / half * [1, -1] + 1) / 2 * shape[::-1]
    y, x = np.mgrid[: shape[0], : shape[1]]
    np.testing.assert_allclose(frame.motion, pixel - np.stack([x, y], -1) - 0.5, atol=1e-3)


def test_a_crop_of_pbrt(tmp_path):
    for number in (0, 1):
        channels, header, *_ = pbrt_frame(number, "camera")
        put(tmp_path / "whole", channels, f"p_{number}.exr", attributes=header)
        cut = {name: np.ascontiguousarray(pixels[2:, 3:]) for name, pixels in channels.items()}
        window = ((3, 2, W - 1, H - 1), (0, 0, W - 1, H - 1))
        put(tmp_path / "cut", cut, f"p_{number}.exr", attributes=header, window=window)
    whole, cut = (read_frame(open_source(tmp_path / name), 1).frame for name in ("whole", "cut"))
    np.testing.assert_allclose(cut.motion, whole.motion[2:, 3:], atol=1e-5)


def test_a_pbrt_frame_without_its_matrices(tmp_path):
    for number in (0, 1):
        channels, header, *_ = pbrt_frame(number, "camera")
        put(tmp_path, channels, f"p_{number}.exr", attributes={} if number else header)
    with pytest.raises(SvgfError, match=r"p_1\.exr: no worldToCamera and worldToNDC in the header"):
        open_source(tmp_path)
    assert read_frame(open_source(tmp_path, cameras=None), 0).frame.depth[0, 0] == pytest.approx(3)


def bmfr(folder, text=None):
    """Two frames of BMFR's data: a wall at z = 4 in the world, and cameras for row vectors in a C header."""
    rows, positions = [], []
    for number in (0, 1):
        to_camera = rotation(0.03 * number)
        to_camera[:3, 3] = -0.1 * number, 0.05 * number, 0.2 * number
        to_clip = np.array([[1.5, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, -0.1], [0, 0, 1, 0]])
        matrix = to_clip @ to_camera
        rows.append(matrix.T)
        place = np.zeros((H, W, 3))
        for y in range(H):
            for x in range(W):
                u, v = 2 * (x + 0.5) / W - 1, 2 * (y + 0.5) / H - 1
                a = np.array([matrix[0] - u * matrix[3], matrix[1] - v * matrix[3]])
                place[y, x] = [*np.linalg.solve(a[:, :2], -a[:, 2] * 4 - a[:, 3]), 4]
        positions.append((place, to_camera))
        for name, value in (("color", 2), ("albedo", 0.5), ("shading_normal", [0, 0, -1]), ("world_position", place)):
            put(folder, planes("", value), f"{name}{number}.exr")
    body = ",\n".join(
        "{" + ",".join("{" + ", ".join(f"{v:.9g}f" for v in row) + "}" for row in one) + "}" for one in rows
    )
    header = (
        f"// cameras\n"
        f"const float camera_matrices[2][4][4] = {{{body}}};\nconst float pixel_offsets[2][2] = {{{{0.5f, 0.5f}}}};\n"
    )
    (folder / "camera_matrices.h").write_text(header if text is None else text)
    return rows, positions


def test_bmfr_has_its_cameras_in_a_c_header(tmp_path):
    rows, positions = bmfr(tmp_path)
    source = open_source(tmp_path)
    assert (source.table.name, source.warnings) == ("bmfr", ())
    frame = read_frame(source, 1).frame
    place, to_camera = positions[1]
    np.testing.assert_allclose(frame.depth, (place @ to_camera[:3, :3].T + to_camera[:3, 3])[..., 2], rtol=1e-5)
    before = positions[0][1]
    np.testing.assert_allclose(frame.prev_depth, (place @ before[:3, :3].T + before[:3, 3])[..., 2], rtol=1e-5)
    clip = np.concatenate([place, np.ones((H, W, 1))], -1) @ rows[0]
    pixel = (clip[..., :2] / clip[..., 3:] + 1) / 2 * [W, H] - 0.5
    y, x = np.mgrid[:H, :W]
    np.testing.assert_allclose(frame.motion, pixel - np.stack([x, y], -1), atol=1e-4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("int x;", r"camera_matrices\.h: 0 numbers for camera_matrices"),
        ("float camera_matrices[1][4][4] = {" + "1.5," * 15 + "};", "15 numbers for camera_matrices"),
        ("float camera_matrices[1][4][4] = {" + "1,0,0,0, 0,1,0,0, 0,0,1,1, 0,0,0,0" + "};", "no camera for frame 1"),
    ],
)
def test_c_headers_that_do_not_fit(tmp_path, text, message):
    bmfr(tmp_path, text)
    with pytest.raises(SvgfError, match=message + ".*--cameras none"):
        open_source(tmp_path)


def test_luxcore_has_a_file_for_each_output(tmp_path):
    for name, value in (("RGB_IMAGEPIPELINE", 2), ("ALBEDO", 0.5), ("SHADING_NORMAL", [0, 1, 0]), ("DEPTH", 3)):
        put(tmp_path, planes("", value), f"{name}_0001.exr")
    source = open_source(tmp_path)
    assert source.table.name == "luxcore"
    frame = read_frame(source, 0).frame
    assert (frame.albedo == 0.5).all()
    assert (frame.depth == 3).all()
    assert [told.split(",")[0] for told in source.warnings] == [
        "no motion: taken as 0: what moves",
        "depth is the distance along the ray",
    ]


SINGLE = {
    "renderman": (
        planes("Ci", 3) | planes("albedo", 0.5) | planes("normal", [0, 0, 1], "XYZ") | planes("z", 2, "R")
        | planes("backward", [1, 2], "XY") | planes("mse", 0) | planes("diffuse", 1) | planes("specular", 0.5),
        ("diffuse", "specular", "rest"), {"albedo": 0.5, "rest": 1.5},
    ),
    "arnold": (
        planes("", 3, "RGBA") | planes("N", [0, 0, 1]) | {"Z": np.full((H, W), 2, np.float32)} | planes("emission", 0.5)
        | planes("motionvector", [1, 2, 0]) | planes("diffuse_direct", 1) | planes("diffuse_indirect", 0.5)
        | planes("diffuse_albedo", 0.5),
        ("diffuse_direct", "diffuse_indirect", "rest"), {"albedo": 0.5, "rest": 1},
    ),
    "karma": (
        planes("C", 3, "RGBA") | planes("N", [0, 0, 1], "XYZ") | planes("depth", 2, "R") | planes("albedo", 0.5)
        | planes("motionvectors", [1, 2], "XY") | planes("directdiffuse", 1),
        ("radiance",), {"albedo": 0.5},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SINGLE)
def test_channels_of_other_renderers(tmp_path, name):
    channels, signals, values = SINGLE[name]
    source = open_source(put(tmp_path, channels, "a_1.exr"))
    assert (source.table.name, source.roles.signals) == (name, signals)
    (told,) = source.warnings
    assert "is not certain; taken as pixel y-down to-previous. `svgf-jax inspect` measures it" in told
    assert open_source(tmp_path, motion="pixel").warnings == ()  # said by hand
    frame = read_frame(source, 0).frame
    assert frame.motion[1, 1].tolist() == [1, 2]
    assert (frame.depth == 2).all()
    assert (frame.albedo[0] == values["albedo"]).all()
    if "rest" in values:
        assert (frame.radiance[-1] == values["rest"]).all()
    assert (frame.radiance.sum(0) + frame.emission == 3).all()
    assert (read_radiance(tmp_path / "a_1.exr") == 3).all()
