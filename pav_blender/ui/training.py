"""Training beside Blender: what to learn from, and how it is going."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ..bridge import jobs, monitor, requirements, training
from ..bridge.training_properties import output_of
from .shared import Sidebar, draw_missing

_UNIT = 20  # pixels of an icon at scale 1, where Blender's interface is not enlarged


class PAV_UL_clips(bpy.types.UIList):
    """The videos and the appearance that each shows."""

    bl_idname = "PAV_UL_clips"

    def draw_item(
        self,
        _context: Any,
        layout: Any,
        _data: Any,
        item: Any,
        _icon: int,
        _active_data: Any,
        _active_property: str,
        _index: int = 0,
        _flag: int = 0,
    ) -> None:
        split = layout.split(factor=0.5)
        split.label(text=Path(item.path).name, icon="FILE_MOVIE")
        split.prop(item, "appearance", text="", emboss=False, icon="USER")


class PAV_PT_train(Sidebar, bpy.types.Panel):
    bl_idname = "PAV_PT_train"
    bl_label = "Training"

    def draw(self, context: Any) -> None:
        layout, settings = self.layout, context.scene.pav.training
        job = jobs.current()
        job = job if job is not None and job.name == jobs.TRAINING else None
        if job is not None and job.running:
            _draw_running(context, layout, job)
            return
        draw_missing(layout)
        output = output_of(settings)
        if output is not None and training.unfinished(output):
            _draw_unfinished(layout, settings)
        else:
            _draw_setup(layout, settings)
        if job is not None:
            _draw_ended(context, layout, job)


def _draw_setup(layout: Any, settings: Any) -> None:
    layout.row().prop(settings, "source", expand=True)
    if settings.source == "VIDEOS":
        row = layout.row()
        row.template_list("PAV_UL_clips", "", settings, "clips", settings, "active_clip", rows=3)
        buttons = row.column(align=True)
        buttons.operator("pav.add_clips", text="", icon="ADD")
        buttons.operator("pav.remove_clip", text="", icon="REMOVE")
        if not settings.clips:
            layout.label(text="Add one video or more of one person", icon="INFO")
        lacking = requirements.missing(requirements.TRACKING)
        if lacking:
            layout.label(text=f"Tracking needs {', '.join(lacking)}: see preferences", icon="ERROR")
    column = layout.column()
    column.use_property_split = True
    column.use_property_decorate = False
    if settings.source == "COLLECTION":
        column.prop(settings, "collection")
    column.prop(settings, "output")
    column.prop(settings, "minutes")
    column.prop(settings, "options")
    if settings.source == "VIDEOS":
        column.prop(settings, "track_again")
    row = layout.row()
    row.scale_y = 1.4
    row.operator("pav.train", icon="PLAY")


def _draw_unfinished(layout: Any, settings: Any) -> None:
    column = layout.column()
    column.use_property_split = True
    column.use_property_decorate = False
    column.prop(settings, "output")
    box = layout.box()
    box.label(text="Unfinished training", icon="RECOVER_LAST")
    row = box.row(align=True)
    row.scale_y = 1.3
    row.operator("pav.resume_training", icon="PLAY")
    row.operator("pav.discard_training", icon="TRASH")


def _draw_running(context: Any, layout: Any, job: Any) -> None:
    watch = training.watched()
    pipeline = job.work
    if watch is not None:
        layout.label(text=watch.wanted.output.name, icon="OUTLINER_OB_ARMATURE")
    column = layout.column(align=True)
    for index, phase in enumerate(pipeline.phases):
        done, current = index < pipeline.index, index == pipeline.index
        icon = "CHECKMARK" if done else "PLAY" if current else "RADIOBUT_OFF"
        row = column.row()
        row.active = done or current
        row.label(text=phase.label, icon=icon)
        row.label(text=f"{100 * phase.fraction:.0f} %" if done or current else "")
    layout.progress(factor=pipeline.fraction, text=job.status)
    if watch is not None:
        _draw_watch(context, layout, watch)
    layout.operator("pav.cancel_job", icon="CANCEL", text="Cancel (can be resumed)")


def _draw_ended(context: Any, layout: Any, job: Any) -> None:
    failed = bool(job.work.error)
    icon = "ERROR" if failed else "CHECKMARK"
    for line in wrapped(job.status, context):
        layout.label(text=line, icon=icon)
        icon = "BLANK1"
    watch = training.watched()
    if watch is None:
        return
    if not failed:
        row = layout.row()
        row.operator_context = "EXEC_DEFAULT"  # the file is known: no file browser
        add = row.operator("pav.add_head", icon="IMPORT", text="Add It to the Scene")
        add.filepath = str(watch.wanted.output)
    _draw_watch(context, layout, watch)


def _draw_watch(context: Any, layout: Any, watch: training.Watch) -> None:
    """The curve with its numbers, and filmed pictures above the avatar's."""
    icons = monitor.icons(watch)
    room = context.region.width / (_UNIT * context.preferences.system.ui_scale)
    if len(watch.curve) > 1:
        first, last = watch.curve[0], watch.curve[-1]
        split = layout.split(factor=0.6)
        split.template_icon(icon_value=icons.curve, scale=0.6 * (room - 3))
        column = split.column(align=True)
        column.label(text=f"{last[3]:.1f} dB", icon_value=icons.blue)
        column.label(text=f"from {first[3]:.1f}", icon="BLANK1")
        column.label(text=f"loss {last[2]:.2g}", icon_value=icons.orange)
        column.label(text=f"from {first[2]:.2g}", icon="BLANK1")
        column.label(text=f"{last[0]:,.0f} steps", icon="BLANK1")
    if icons.pictures:
        layout.label(text="Filmed above, avatar below:")
        scale = min(8.0, (room - 2.5) / len(icons.pictures))
        column = layout.column(align=True)
        for which in (0, 1):
            row = column.row(align=True)
            for pair in icons.pictures:
                row.template_icon(icon_value=pair[which], scale=scale)


def wrapped(text: str, context: Any) -> list[str]:
    """A text in lines that the panel is wide enough for."""
    import textwrap

    letters = int(context.region.width / (7 * context.preferences.system.ui_scale)) - 5
    return textwrap.wrap(text, max(20, letters)) or [""]


classes = (PAV_UL_clips, PAV_PT_train)
_register, _unregister = bpy.utils.register_classes_factory(classes)


def register() -> None:
    _register()


def unregister() -> None:
    _unregister()
    monitor.forget()
