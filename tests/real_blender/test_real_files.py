"""Scenes that link, override and pack, rendered by `blender -b`."""

from __future__ import annotations

import shutil

import numpy as np
from places import ROOT, WORK

PACK = """
import os
import bpy
head = next(o for o in bpy.data.objects if o.pav.avatar)
bpy.context.view_layer.objects.active = head
bpy.ops.pav.pack_avatar()
bpy.ops.wm.save_as_mainfile(filepath=os.path.abspath({path!r}))
"""

OVERRIDE = """
import os
import bpy
with bpy.data.libraries.load(os.path.abspath({library!r}), link=True) as (_, target):
    target.collections = ["Ann"]
scene = bpy.context.scene
ann = target.collections[0].override_hierarchy_create(
    scene, bpy.context.view_layer, do_fully_editable=True
)
objects = ann.all_objects
next(o for o in objects if o.pav.avatar).pav.appearance = "evening"
scene.camera = next(o for o in objects if o.type == "CAMERA")
scene.frame_start, scene.frame_end = 3, 4
scene.render.resolution_x, scene.render.resolution_y = 48, 40
scene.render.resolution_percentage = 100
scene.render.film_transparent = True
scene.view_settings.view_transform = "Standard"
scene.render.dither_intensity = 0
scene.render.image_settings.color_mode = "RGBA"
bpy.ops.wm.save_as_mainfile(filepath=os.path.abspath({path!r}))
"""

GROUP = """
import os
import bpy
scene = bpy.context.scene
ann = bpy.data.collections.new("Ann")
scene.collection.children.link(ann)
for object_ in list(scene.collection.objects):
    ann.objects.link(object_)
    scene.collection.objects.unlink(object_)
bpy.ops.wm.save_as_mainfile(filepath=os.path.abspath({path!r}))
"""


def script(folder, name, text):
    (ROOT / folder / name).write_text(text, encoding="utf-8")
    return folder / name


def run(blender, *arguments):
    done = blender("-b", *arguments)
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    assert "Traceback" not in said
    return done


def pictures(folder):
    from pav_blender.core import images

    return {path.name: images.read_rgba(path) for path in sorted((ROOT / folder).glob("*.png"))}


def test_a_packed_avatar_renders_where_its_file_is_not(blender, files):
    folder, moved = WORK / "packing", WORK / "packed"
    for place in (folder, moved):
        (ROOT / place).mkdir()
    for name in ("walk.blend", "small.pav"):
        shutil.copy(ROOT / files / name, ROOT / folder / name)
    run(blender, folder / "walk.blend", "-E", "PAV", "-o", f"{folder}/f####", "-f", "3")
    code = PACK.format(path=str(folder / "packed.blend"))
    run(blender, folder / "walk.blend", "--python-exit-code", "3", "-P",
        script(folder, "pack.py", code))  # fmt: skip
    shutil.move(ROOT / folder / "packed.blend", ROOT / moved / "packed.blend")
    run(blender, moved / "packed.blend", "-E", "PAV", "-o", f"{moved}/f####", "-f", "3")
    (before,), (after,) = pictures(folder).values(), pictures(moved).values()
    np.testing.assert_array_equal(after, before)
    assert before[..., 3].max() > 200


def test_a_linked_head_with_an_overridden_appearance_renders(blender, files):
    library, shots = WORK / "library", WORK / "library" / "shots"
    (ROOT / shots).mkdir(parents=True)
    for name in ("walk.blend", "small.pav"):
        shutil.copy(ROOT / files / name, ROOT / library / name)
    run(blender, library / "walk.blend", "-E", "PAV", "-o", f"{library}/f####", "-f", "3")
    code = GROUP.format(path=str(library / "ann.blend"))
    run(blender, library / "walk.blend", "--python-exit-code", "3", "-P",
        script(library, "group.py", code))  # fmt: skip
    code = OVERRIDE.format(library=str(library / "ann.blend"), path=str(shots / "shot.blend"))
    run(blender, "--python-exit-code", "3", "-P", script(library, "override.py", code))
    # the shot lies elsewhere than the library: the avatar's path is the library's
    run(blender, shots / "shot.blend", "-E", "PAV", "-o", f"{shots}/f####", "-a")
    found = pictures(shots)
    assert list(found) == ["f0003.png", "f0004.png"]
    (morning,) = pictures(library).values()
    evening = found["f0003.png"]
    assert evening[..., 3].max() > 200
    assert np.abs(evening.astype(int) - morning).max() > 5
    assert np.abs(evening.astype(int) - found["f0004.png"]).max() > 5
