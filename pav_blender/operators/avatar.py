"""Bringing avatars into the scene, and heads out of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import bpy
import numpy as np

from ..bridge import requirements
from ..bridge import scene as bridge_scene
from .context import ChoosesFile, object_mode, select
from .reporting import reporting


class PAV_OT_add_head(ChoosesFile, bpy.types.Operator):
    """Add the head of an avatar file, with its rig"""

    bl_idname = "pav.add_head"
    bl_label = "Add Avatar"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    filepath: bpy.props.StringProperty(subtype="FILE_PATH")  # type: ignore[valid-type]
    filter_glob: bpy.props.StringProperty(  # type: ignore[valid-type]
        default="*.pav", options={"HIDDEN"}
    )
    appearance: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Appearance",
        description="What the head wears, and so whose head it is where the avatar is of several "
        "people; the first if empty",
    )

    @reporting
    def execute(self, context: Any) -> set[str]:
        requirements.check()
        object_mode(context)
        rig = bridge_scene.build_head(Path(self.filepath), self.appearance or None)
        select(context, rig.mesh)
        bridge_scene.use_engine(context.scene)
        return {"FINISHED"}


class PAV_OT_add_rig(bpy.types.Operator):
    """Add a head with its rig and no avatar: the built-in one, or that of a file"""

    bl_idname = "pav.add_rig"
    bl_label = "Add Head Rig"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    filepath: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Head File",
        description="A head file (.npz), or FLAME's; empty for the built-in head",
        subtype="FILE_PATH",
    )

    @reporting
    def execute(self, context: Any) -> set[str]:
        from ..bridge.rig import build_rig
        from ..core.head import BUILTIN, remember_head

        head = remember_head(bpy.path.abspath(self.filepath) if self.filepath else BUILTIN)
        object_mode(context)
        betas = np.zeros(len(head.shape_basis), np.float32)
        name = Path(self.filepath).stem if self.filepath else "Head"
        rig = build_rig(head, betas, name, context.scene.collection)
        select(context, rig.mesh)
        return {"FINISHED"}


class PAV_OT_save_head(ChoosesFile, bpy.types.Operator):
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

    def invoke(self, context: Any, event: Any) -> set[str]:
        self.filepath = f"{context.active_object.name}.npz"
        return super().invoke(context, event)

    @reporting
    def execute(self, context: Any) -> set[str]:
        from ..bridge.heads import head_from_object
        from ..core.head import write_head

        head = head_from_object(context.active_object)
        write_head(Path(self.filepath), head)
        self.report({"INFO"}, f"{self.filepath}: {len(head.expression_names)} expressions")
        return {"FINISHED"}


classes = (PAV_OT_add_head, PAV_OT_add_rig, PAV_OT_save_head)
register, unregister = bpy.utils.register_classes_factory(classes)
