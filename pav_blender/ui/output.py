"""Writing frames, and the engine's settings in the render properties."""

from __future__ import annotations

from typing import Any, ClassVar

import bpy

from ..bridge import compositing, jobs, view
from .shared import Sidebar, draw_job, draw_missing


class PAV_PT_frames(Sidebar, bpy.types.Panel):
    bl_idname = "PAV_PT_frames"
    bl_label = "Frames"

    def draw(self, context: Any) -> None:
        column = self.layout.column()
        column.use_property_split = True
        column.prop(context.scene.pav, "quality")
        column.prop(context.scene.pav.frames, "format")
        column.prop(context.scene.pav.frames, "appearances")
        column.prop(context.scene.render, "filepath", text="Folder")
        column.operator("pav.write_sequence", icon="RENDER_ANIMATION")
        draw_job(column, jobs.WRITING)
        _draw_compositing(column, context.scene)


def _draw_compositing(layout: Any, scene: Any) -> None:
    outer = scene.pav.frames.shown_in
    if outer is not None:
        layout.label(text=f"Heads of the scene {outer.name}", icon="NODE_COMPOSITING")
        return
    layout.operator("pav.composite", icon="NODE_COMPOSITING")
    if compositing.head_scene(scene) is not None:
        layout.operator("pav.separate", icon="X")


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
        if not view.is_standard(context.scene):
            layout.label(text="The view changes colours", icon="ERROR")
            layout.operator("pav.use_standard_view")


classes = (
    PAV_PT_frames,
    PAV_PT_render,
)
register, unregister = bpy.utils.register_classes_factory(classes)
