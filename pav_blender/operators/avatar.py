"""Bringing avatars and tracks into the scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..bridge import avatars, requirements
from ..bridge import scene as bridge_scene
from ..core.errors import InputError
from .reporting import reporting


class PAV_OT_add_head(bpy.types.Operator):
    """Add the head of an avatar file, with its rig"""

    bl_idname = "pav.add_head"
    bl_label = "Add Avatar"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    filepath: bpy.props.StringProperty(subtype="FILE_PATH")  # type: ignore[valid-type]
    filter_glob: bpy.props.StringProperty(  # type: ignore[valid-type]
        default="*.pav", options={"HIDDEN"}
    )

    def invoke(self, context: Any, _event: Any) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @reporting
    def execute(self, context: Any) -> set[str]:
        requirements.check()
        _object_mode(context)
        rig = bridge_scene.build_head(Path(self.filepath))
        _select(context, rig.mesh)
        bridge_scene.use_engine(context.scene)
        return {"FINISHED"}


class PAV_OT_import_track(bpy.types.Operator):
    """Animate the active head, and the camera, as in a clip of a collection"""

    bl_idname = "pav.import_track"
    bl_label = "Import Track"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        return find_head(context) is not None

    @reporting
    def execute(self, context: Any) -> set[str]:
        requirements.check()
        from ..core.collection import read_collection

        settings = context.scene.pav
        if not settings.collection:
            raise InputError("choose the collection's folder first")
        _object_mode(context)
        collection = read_collection(avatars.resolve(settings.collection))
        clip = settings.clip or collection.clips[0].name
        bridge_scene.import_track(find_head(context), collection, clip)
        bridge_scene.use_engine(context.scene)
        self.report({"INFO"}, f"{clip}: {len(collection.clip(clip))} frames")
        return {"FINISHED"}


class PAV_OT_save_head(bpy.types.Operator):
    """Write the active mesh, its shape keys and its armature as a head file"""

    bl_idname = "pav.save_head"
    bl_label = "Save Head File"

    filepath: bpy.props.StringProperty(subtype="FILE_PATH")  # type: ignore[valid-type]
    filter_glob: bpy.props.StringProperty(  # type: ignore[valid-type]
        default="*.npz", options={"HIDDEN"}
    )

    @classmethod
    def poll(cls, context: Any) -> bool:
        return context.active_object is not None and context.active_object.type == "MESH"

    def invoke(self, context: Any, _event: Any) -> set[str]:
        self.filepath = f"{context.active_object.name}.npz"
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @reporting
    def execute(self, context: Any) -> set[str]:
        requirements.check()
        from ..bridge.heads import head_from_object
        from ..core.head import write_head

        head = head_from_object(context.active_object)
        write_head(Path(self.filepath), head)
        self.report({"INFO"}, f"{self.filepath}: {len(head.expression_names)} expressions")
        return {"FINISHED"}


def find_head(context: Any) -> Any | None:
    """The active object if it is a head, else the head that the active object deforms or holds,
    else the scene's only head."""
    active = context.active_object
    if active is not None and active.pav.avatar:
        return active
    if active is not None:
        for child in active.children:
            if child.pav.avatar:
                return child
    heads = [object_ for object_ in context.scene.objects if object_.pav.avatar]
    return heads[0] if len(heads) == 1 else None


def _object_mode(context: Any) -> None:
    if context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")


def _select(context: Any, object_: Any) -> None:
    for other in context.selected_objects:
        other.select_set(False)
    object_.select_set(True)
    context.view_layer.objects.active = object_


classes = (PAV_OT_add_head, PAV_OT_import_track, PAV_OT_save_head)
register, unregister = bpy.utils.register_classes_factory(classes)
