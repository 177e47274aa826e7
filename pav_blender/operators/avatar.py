"""Bringing avatars into the scene, and heads out of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..bridge import requirements
from ..bridge import scene as bridge_scene
from .context import object_mode, select
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
        object_mode(context)
        rig = bridge_scene.build_head(Path(self.filepath))
        select(context, rig.mesh)
        bridge_scene.use_engine(context.scene)
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


classes = (PAV_OT_add_head, PAV_OT_save_head)
register, unregister = bpy.utils.register_classes_factory(classes)
