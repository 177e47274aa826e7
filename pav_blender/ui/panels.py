"""The PAV tab of the 3D view's sidebar, and the engine's settings in the render properties."""

from __future__ import annotations

from typing import Any, ClassVar

import bpy

from ..bridge import jobs, requirements
from ..operators.avatar import find_head


class _Sidebar:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PAV"


class PAV_PT_avatar(_Sidebar, bpy.types.Panel):
    bl_idname = "PAV_PT_avatar"
    bl_label = "Avatar"

    def draw(self, context: Any) -> None:
        layout = self.layout
        _draw_missing(layout)
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


class PAV_PT_track(_Sidebar, bpy.types.Panel):
    bl_idname = "PAV_PT_track"
    bl_label = "Track"

    def draw(self, context: Any) -> None:
        column = self.layout.column()
        column.use_property_split = True
        column.prop(context.scene.pav, "collection")
        column.prop(context.scene.pav, "clip")
        column.operator("pav.import_track", icon="ANIM_DATA")


class PAV_PT_train(_Sidebar, bpy.types.Panel):
    bl_idname = "PAV_PT_train"
    bl_label = "Training"

    def draw(self, context: Any) -> None:
        column = self.layout.column()
        column.use_property_split = True
        column.prop(context.scene.pav, "collection")
        column.prop(context.scene.pav, "output")
        column.prop(context.scene.pav, "arguments")
        column.operator("pav.train", icon="PLAY")
        _draw_job(column, jobs.TRAINING)


class PAV_PT_frames(_Sidebar, bpy.types.Panel):
    bl_idname = "PAV_PT_frames"
    bl_label = "Frames"

    def draw(self, context: Any) -> None:
        column = self.layout.column()
        column.use_property_split = True
        column.prop(context.scene.pav, "quality")
        column.prop(context.scene.render, "filepath", text="Folder")
        column.operator("pav.write_sequence", icon="RENDER_ANIMATION")
        _draw_job(column, jobs.WRITING)


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
        _draw_missing(layout)
        layout.prop(context.scene.pav, "quality")
        layout.prop(context.scene.render, "film_transparent")
        if context.scene.view_settings.view_transform != "Standard":
            layout.label(text="Set the view transform to Standard,", icon="ERROR")
            layout.label(text="or the avatar's colours change", icon="BLANK1")


def _draw_missing(layout: Any) -> None:
    names = requirements.missing()
    if not names:
        return
    box = layout.box()
    box.label(text=f"Missing: {', '.join(names)}", icon="ERROR")
    box.label(text="Install them in Blender's Python,")
    box.label(text="or start Blender with PYTHONPATH set")


def _draw_job(layout: Any, name: str) -> None:
    job = jobs.current()
    if job is None or job.name != name:
        return
    if job.running:
        layout.progress(factor=job.work.fraction, text=job.status)
        layout.operator("pav.cancel_job", icon="CANCEL")
    else:
        layout.label(text=job.status, icon="ERROR" if job.work.error else "CHECKMARK")


classes = (PAV_PT_avatar, PAV_PT_track, PAV_PT_train, PAV_PT_frames, PAV_PT_render)
register, unregister = bpy.utils.register_classes_factory(classes)
