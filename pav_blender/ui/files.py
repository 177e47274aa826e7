"""Where a head's avatar file is kept."""

from __future__ import annotations

from typing import Any, ClassVar

import bpy

from ..operators.context import find_head
from .shared import Sidebar


class PAV_PT_files(Sidebar, bpy.types.Panel):
    bl_idname = "PAV_PT_files"
    bl_label = "Files"
    bl_parent_id = "PAV_PT_avatar"
    bl_options: ClassVar = {"DEFAULT_CLOSED"}

    def draw(self, context: Any) -> None:
        column = self.layout.column()
        head = find_head(context)
        if head is not None and head.pav.pack.text is not None:
            column.label(text=f"Packed: {head.pav.pack.text.name}", icon="PACKAGE")
            column.operator("pav.unpack_avatar", icon="EXPORT")
        else:
            column.operator("pav.pack_avatar", icon="PACKAGE")
        column.operator("pav.relink_avatars", icon="FILE_REFRESH")
        column.operator("pav.override_head", icon="LIBRARY_DATA_OVERRIDE")


classes = (PAV_PT_files,)
register, unregister = bpy.utils.register_classes_factory(classes)
