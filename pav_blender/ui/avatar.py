"""The head chosen, and what it wears."""

from __future__ import annotations

from typing import Any

import bpy

from ..operators.context import find_head
from .shared import Sidebar, draw_missing


class PAV_PT_avatar(Sidebar, bpy.types.Panel):
    bl_idname = "PAV_PT_avatar"
    bl_label = "Avatar"

    def draw(self, context: Any) -> None:
        layout = self.layout
        draw_missing(layout)
        head = find_head(context)
        layout.operator("pav.add_head", icon="IMPORT")
        layout.operator("pav.save_head", icon="EXPORT")
        active = context.active_object
        if head is None and active is not None and active.type == "MESH":
            head = active
        if head is None:
            layout.label(text="Select a head to choose its avatar", icon="INFO")
            return
        column = layout.column()
        column.use_property_split = True
        column.label(text=head.name, icon="MESH_DATA")
        column.prop(head.pav, "avatar", text="File")
        if head.pav.avatar:
            column.prop(head.pav, "appearance")


classes = (PAV_PT_avatar,)
register, unregister = bpy.utils.register_classes_factory(classes)
