"""What tests of files do over and over: a head added, drawn, saved, and opened again."""

from __future__ import annotations

import bpy

from pav_blender.bridge import mesh, render, shot


def picture(scene, frame=4):
    """What the engine draws of the scene, [H, W, 4]; also proves that the avatar is found."""
    scene.pav.quality = "PREVIEW"
    scene.update_tag()
    scene.frame_set(frame)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    return render.draw(shot.read_shot(None, depsgraph)).display


def add(scene, folder, track=None):
    bpy.ops.pav.add_head(filepath=str(folder / "small.pav"))
    head = bpy.context.object
    if track is not None:
        scene.pav.collection = str(track / "collection")
        bpy.ops.pav.import_track()
    return head


def evaluated(object_):
    found = object_.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return mesh.evaluated_vertices(found)


def contents():
    return {
        name: len(getattr(bpy.data, name))
        for name in (
            "objects", "meshes", "armatures", "shape_keys", "actions", "cameras", "materials",
            "images", "texts",
        )
    }  # fmt: skip


def save(path):
    bpy.ops.wm.save_as_mainfile(filepath=str(path))


def reopen(path):
    bpy.ops.wm.open_mainfile(filepath=str(path))
    return bpy.context.scene


def heads():
    return [object_ for object_ in bpy.context.scene.objects if object_.pav.avatar]
