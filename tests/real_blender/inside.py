"""Run inside a real Blender, on the tests' scene: what it evaluates and draws against the core.

    blender -b walk.blend --python inside.py -- answer.json

The answer says by how much Blender and the core differ; the test says how much is too much.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np
from bl_ext.user_default.pav_blender.bridge import avatars, mesh
from bl_ext.user_default.pav_blender.core import images
from bl_ext.user_default.pav_blender.core.collection import read_collection
from bl_ext.user_default.pav_blender.core.head import builtin_head
from bl_ext.user_default.pav_blender.core.rendering.cameras import Camera
from bl_ext.user_default.pav_blender.core.rendering.render import RenderSettings, render
from mathutils import Quaternion

scene = bpy.context.scene
head = next(thing for thing in scene.objects if thing.pav.avatar)
avatar = avatars.load(avatars.path_of(head.pav))
collection = read_collection(Path(bpy.data.filepath).parent / "collection")
clip = collection.clip("walk")
scratch = Path(tempfile.mkdtemp())


def core(appearance):
    """Frame 3, which is the clip's first, as the core draws it."""
    return render(
        avatar,
        collection.posed(clip, np.array([0]))[0],
        Camera(clip.width, clip.height, clip.intrinsics[0], clip.camera_to_world[0]),
        appearance,
        RenderSettings.preset("final"),
        expression=clip.expression[0],
    )


def off(appearance) -> float:
    """How far F12's picture is from the core's, in steps of 255."""
    scene.frame_set(3)
    scene.render.filepath = str(scratch / "picture.png")
    bpy.ops.render.render(write_still=True)
    found = images.read_rgba(scratch / "picture.png") / 255
    wanted = core(appearance).rgba
    colour = np.abs(found[..., :3] - wanted[..., :3]) * wanted[..., 3:]
    return 255 * float(max(colour.max(), np.abs(found[..., 3] - wanted[..., 3]).max()))


def depth_off() -> float:
    """How far the depth pass is from the core's where something is, metres."""
    settings = scene.render.image_settings
    before = settings.file_format, settings.color_depth
    settings.file_format, settings.color_depth = "OPEN_EXR_MULTILAYER", "32"
    bpy.context.view_layer.use_pass_z = True
    scene.render.filepath = str(scratch / "depth.exr")
    bpy.ops.render.render(write_still=True)
    settings.file_format, settings.color_depth = before
    import OpenImageIO as oiio

    source = oiio.ImageInput.open(str(scratch / "depth.exr"))
    names = list(source.spec().channelnames)
    depth = np.asarray(source.read_image(0, 0, 0, len(names), "float"))[
        ..., next(i for i, name in enumerate(names) if name.endswith("Depth.Z"))
    ]
    wanted = core("morning").depth
    there = np.isfinite(wanted)
    assert (depth[~there] == 1e10).all()
    return float(np.abs(depth - wanted)[there].max())


def rig_off() -> float:
    """How far the evaluated mesh is from the head model's, over random parameters, metres."""
    model, rng = builtin_head(), np.random.default_rng(0)
    for thing in (head.data.shape_keys, head.parent):
        thing.animation_data.action = None
    worst = 0.0
    for _ in range(5):
        expression = rng.uniform(-0.5, 1, len(model.expression_names)).astype(np.float32)
        turns = rng.normal(0, 0.2, (len(model.joint_names), 3)).astype(np.float32)
        for name, value in zip(model.expression_names, expression, strict=True):
            head.data.shape_keys.key_blocks[name].value = value
        for name, turn in zip(model.joint_names, turns, strict=True):
            angle = float(np.linalg.norm(turn))
            bone = head.parent.pose.bones[name]
            bone.rotation_quaternion = Quaternion((turn / angle).tolist(), angle)
        head.parent.pose.bones[model.joint_names[0]].location = (0, 0, 0)
        bpy.context.view_layer.update()
        shown = head.evaluated_get(bpy.context.evaluated_depsgraph_get())
        still = np.zeros((1, 3), np.float32)
        wanted = model.pose(avatar.betas, expression[None], turns[None], still)[0].numpy()
        worst = max(worst, float(np.abs(mesh.evaluated_vertices(shown) - wanted).max()))
    return worst


def recorded() -> float:
    """The value that a recording's one shape has on the rig, for 0.75 in the file."""
    from bl_ext.user_default.pav_blender.core.head.livelink import ARKIT_NAMES

    columns = [name[0].upper() + name[1:] for name in ARKIT_NAMES]
    rows = [",".join(("Timecode", "BlendShapeCount", *columns))]
    for frame in range(3):
        values = ["0.75" if name == "JawOpen" else "0" for name in columns]
        rows.append(",".join((f"10:00:00:{frame:02d}.000", str(len(columns)), *values)))
    path = scratch / "take.csv"
    path.write_text("\n".join(rows) + "\n")
    bpy.context.view_layer.objects.active = head
    bpy.ops.pav.import_livelink(filepath=str(path))
    scene.frame_set(scene.frame_start)
    return head.data.shape_keys.key_blocks["jawOpen"].value


def refusals() -> list[str]:
    """The lines that wrong input gives."""
    said = []
    for call in (
        lambda: bpy.ops.pav.add_head(filepath=str(scratch / "nowhere.pav")),
        lambda: bpy.ops.pav.import_livelink(filepath=str(scratch / "nowhere.csv")),
        lambda: setattr(head.pav, "appearance", "bald"),
    ):
        try:
            call()
            said.append("")
        except (RuntimeError, TypeError) as error:
            said.append(str(error))
    return said


def main() -> None:
    answer = {"alone": off("morning"), "depth": depth_off()}
    head.pav.appearance = "evening"
    answer["chosen"] = off("evening")
    head.pav.appearance = "morning"
    layer = head.pav.layers.add()
    layer.appearance, layer.weight = "evening", 0.5
    answer["blend"] = off({"morning": 0.5, "evening": 0.5})
    mask = builtin_head().template[:, 0] > 0
    group = head.vertex_groups.new(name="left")
    group.add(np.flatnonzero(mask).tolist(), 1.0, "REPLACE")
    layer.region, layer.weight = "left", 1.0
    share = mask.astype(np.float32)
    answer["region"] = off({"morning": 1 - share, "evening": share})
    answer["region_from_alone"] = 255 * float(
        np.abs(core({"morning": 1 - share, "evening": share}).rgba - core("morning").rgba).max()
    )
    answer["rig"] = rig_off()
    answer["recorded"] = recorded()
    answer["refusals"] = refusals()
    Path(sys.argv[-1]).write_text(json.dumps(answer))


main()
