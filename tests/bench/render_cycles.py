"""Render a small moving scene with Blender's Cycles, as tests/data/cycles was.

    python render_cycles.py FOLDER [WIDTH HEIGHT FRAMES] [parts=multi|single] [layers=1|2] [denoise=0|1] [depth=16|32] [samples=1]

Wants the package `bpy` (5.2.3 was used, with Python 3.13). A floor with a pattern, a wall, a rough golden ball, a glass ball, a box
that moves and turns, a lamp, a bulb and sky; the camera moves and turns. Blender's first sample is at the pixel's centre.
"""

import math
import sys

import bpy

folder = sys.argv[1]
words = [word for word in sys.argv[2:] if "=" not in word]
width, height, frames = (int(word) for word in words) if words else (48, 27, 3)
options = dict(word.split("=") for word in sys.argv[2:] if "=" in word)

bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene


def material(name, color, roughness=0.5, metallic=0.0, emission=0.0, transmission=0.0):
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    node = made.node_tree.nodes["Principled BSDF"]
    node.inputs["Base Color"].default_value = (*color, 1)
    node.inputs["Roughness"].default_value = roughness
    node.inputs["Metallic"].default_value = metallic
    node.inputs["Transmission Weight"].default_value = transmission
    node.inputs["Emission Color"].default_value = (1, 0.9, 0.7, 1)
    node.inputs["Emission Strength"].default_value = emission
    return made


def checker(name):
    made = material(name, (0.8, 0.8, 0.8))
    tree = made.node_tree
    pattern = tree.nodes.new("ShaderNodeTexChecker")
    pattern.inputs["Scale"].default_value = 6
    pattern.inputs["Color1"].default_value = (0.75, 0.3, 0.2, 1)
    pattern.inputs["Color2"].default_value = (0.8, 0.78, 0.7, 1)
    coordinates = tree.nodes.new("ShaderNodeTexCoord")
    tree.links.new(coordinates.outputs["Object"], pattern.inputs["Vector"])
    tree.links.new(pattern.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    return made


def add(kind, number, made, **where):
    getattr(bpy.ops.mesh, kind)(**where)
    thing = bpy.context.object
    thing.data.materials.append(made)
    thing.pass_index = number
    return thing


add("primitive_plane_add", 1, checker("floor"), size=8)
wall = add(
    "primitive_plane_add",
    2,
    material("wall", (0.3, 0.5, 0.75)),
    size=5,
    location=(-1.2, 2.5, 1.5),
    rotation=(math.pi / 2, 0, 0),
)
ball = add(
    "primitive_uv_sphere_add",
    3,
    material("gold", (1, 0.75, 0.3), 0.35, 1.0),
    radius=0.6,
    location=(-1.1, 0.6, 0.6),
    segments=48,
    ring_count=24,
)
for face in ball.data.polygons:
    face.use_smooth = True
glass = add(
    "primitive_uv_sphere_add",
    4,
    material("glass", (0.9, 1, 0.95), 0.0, 0, 0, 1.0),
    radius=0.4,
    location=(0.3, -0.7, 0.4),
    segments=48,
    ring_count=24,
)
for face in glass.data.polygons:
    face.use_smooth = True
box = add("primitive_cube_add", 5, material("box", (0.2, 0.6, 0.25), 0.6), size=0.8, location=(0.9, 0.9, 0.5))
add("primitive_uv_sphere_add", 6, material("bulb", (0, 0, 0), emission=25), radius=0.12, location=(0.1, 1.4, 2.2))

bpy.ops.object.light_add(type="AREA", location=(2.5, -2, 3.5), rotation=(0.6, 0.5, 0))
bpy.context.object.data.energy, bpy.context.object.data.size = 250, 1.0
world = bpy.data.worlds.new("sky")
scene.world = world
world.use_nodes = True
world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.3, 0.45, 0.8, 1)
world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.4

bpy.ops.object.camera_add()
camera = bpy.context.object
scene.camera = camera
for frame in range(1, frames + 1):
    t = (frame - 1) * (4 if frames <= 8 else 1)
    camera.location = (2.2 + 0.03 * t, -4.2 + 0.02 * t, 1.9 - 0.01 * t)
    camera.rotation_euler = (math.radians(74 + 0.15 * t), 0, math.radians(24 + 0.35 * t))
    camera.keyframe_insert("location", frame=frame)
    camera.keyframe_insert("rotation_euler", frame=frame)
    box.location = (0.9 - 0.04 * t, 0.9 - 0.02 * t, 0.5)
    box.rotation_euler = (0, 0, math.radians(3 * t))
    box.keyframe_insert("location", frame=frame)
    box.keyframe_insert("rotation_euler", frame=frame)

scene.render.engine = "CYCLES"
scene.cycles.device = "CPU"
scene.cycles.samples = int(options.get("samples", 1))
scene.cycles.use_adaptive_sampling = False
scene.cycles.use_denoising = options.get("denoise", "0") == "1"
scene.cycles.max_bounces = 4
scene.cycles.sample_clamp_indirect = 10
scene.cycles.use_animated_seed = True
scene.render.use_motion_blur = False  # with it, Vector is all 0
scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100
scene.frame_start, scene.frame_end = 1, frames


def passes(layer):
    layer.use_pass_combined = layer.use_pass_z = layer.use_pass_normal = layer.use_pass_vector = True
    layer.use_pass_object_index = layer.use_pass_emit = layer.use_pass_environment = True
    for kind in ("diffuse", "glossy", "transmission"):
        for part in ("direct", "indirect", "color"):
            setattr(layer, f"use_pass_{kind}_{part}", True)
    layer.use_pass_position = True


passes(scene.view_layers[0])
if options.get("layers") == "2":
    other = scene.view_layers.new("Other")
    passes(other)
image = scene.render.image_settings
if hasattr(image, "media_type"):
    image.media_type = "MULTI_LAYER_IMAGE"
image.file_format = "OPEN_EXR_MULTILAYER"
image.color_depth = options.get("depth", "32")
image.exr_codec = "ZIP"
if hasattr(image, "use_exr_interleave"):
    image.use_exr_interleave = options.get("parts", "multi") == "single"
scene.render.filepath = f"{folder}/shot_####.exr"
for frame in range(1, frames + 1):
    scene.frame_set(frame)
    scene.cycles.seed = frame
    scene.render.filepath = f"{folder}/shot_{frame:04d}.exr"
    bpy.ops.render.render(write_still=True)
