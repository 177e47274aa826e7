"""The heads together with the rest of the scene, and the view that shows their colours."""

from __future__ import annotations

from typing import Any, ClassVar

import bpy

from ..bridge import compositing, view
from .reporting import reporting

_EEVEE = "BLENDER_EEVEE" if bpy.app.version >= (5, 0, 0) else "BLENDER_EEVEE_NEXT"


class PAV_OT_composite(bpy.types.Operator):
    """Render the heads among the scene's other objects: Cycles or EEVEE renders those, PAV the \
heads, and the compositor shows of each pixel what is nearer"""

    bl_idname = "pav.composite"
    bl_label = "Composite with Scene"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    engine: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Engine",
        description="Renders the rest of the scene, where the scene's engine is PAV",
        items=(("CYCLES", "Cycles", ""), (_EEVEE, "EEVEE", "")),
        default="CYCLES",
    )

    @reporting
    def execute(self, context: Any) -> set[str]:
        inner = compositing.composite(context.scene, self.engine)
        self.report({"INFO"}, f"The heads are rendered by scene {inner.name!r}")
        return {"FINISHED"}


class PAV_OT_separate(bpy.types.Operator):
    """Undo Composite with Scene: the compositor shows what it did before, PAV's scene is removed"""

    bl_idname = "pav.separate"
    bl_label = "Remove Compositing"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    @reporting
    def execute(self, context: Any) -> set[str]:
        compositing.separate(context.scene)
        return {"FINISHED"}


class PAV_OT_use_standard_view(bpy.types.Operator):
    """Show colours as they were trained: view transform Standard, no look, exposure or gamma"""

    bl_idname = "pav.use_standard_view"
    bl_label = "Use Standard View"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    @reporting
    def execute(self, context: Any) -> set[str]:
        view.use_standard(context.scene)
        return {"FINISHED"}


classes = (PAV_OT_composite, PAV_OT_separate, PAV_OT_use_standard_view)
register, unregister = bpy.utils.register_classes_factory(classes)
