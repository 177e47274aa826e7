"""Moving a head by a track."""

from __future__ import annotations

from typing import Any

import bpy

from .shared import Sidebar


class PAV_PT_track(Sidebar, bpy.types.Panel):
    bl_idname = "PAV_PT_track"
    bl_label = "Track"

    def draw(self, context: Any) -> None:
        column = self.layout.column()
        column.use_property_split = True
        column.prop(context.scene.pav, "collection")
        column.prop(context.scene.pav, "clip")
        column.operator("pav.import_track", icon="ANIM_DATA")
        column.operator("pav.import_livelink", icon="IMPORT")


classes = (PAV_PT_track,)
register, unregister = bpy.utils.register_classes_factory(classes)
