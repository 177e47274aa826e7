"""Writing frames, and the engine's settings in the render properties."""

from __future__ import annotations

from typing import Any, ClassVar

import bpy

from ..bridge import jobs
from .shared import Sidebar, draw_job, draw_missing


class PAV_PT_frames(Sidebar, bpy.types.Panel):
    bl_idname = "PAV_PT_frames"
    bl_label = "Frames"

    def draw(self, context: Any) -> None:
        column = self.layout.column()
        column.use_property_split = True
        column.prop(context.scene.pav, "quality")
        column.prop(context.scene.render, "filepath", text="Folder")
        column.operator("pav.write_sequence", icon="RENDER_ANIMATION")
        draw_job(column, jobs.WRITING)


class PAV_PT_render(bpy.types.Panel):
    bl_idname = "PAV_PT_render"
    bl_label = "PAV"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"
    COMPAT_ENGINES: ClassVar = {"PAV"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        return context.engine in cls.COMPAT_ENGINES

    def draw(self, context: Any) -> None:
        layout = self.layout
        layout.use_property_split = True
        draw_missing(layout)
        layout.prop(context.scene.pav, "quality")
        layout.prop(context.scene.render, "film_transparent")
        if context.scene.view_settings.view_transform != "Standard":
            layout.label(text="Set the view transform to Standard,", icon="ERROR")
            layout.label(text="or the avatar's colours change", icon="BLANK1")


classes = (
    PAV_PT_frames,
    PAV_PT_render,
)
register, unregister = bpy.utils.register_classes_factory(classes)
