"""Training beside Blender."""

from __future__ import annotations

from typing import Any

import bpy

from ..bridge import jobs
from .shared import Sidebar, draw_job


class PAV_PT_train(Sidebar, bpy.types.Panel):
    bl_idname = "PAV_PT_train"
    bl_label = "Training"

    def draw(self, context: Any) -> None:
        column = self.layout.column()
        column.use_property_split = True
        column.prop(context.scene.pav, "collection")
        column.prop(context.scene.pav, "output")
        column.prop(context.scene.pav, "arguments")
        column.operator("pav.train", icon="PLAY")
        draw_job(column, jobs.TRAINING)


classes = (PAV_PT_train,)
register, unregister = bpy.utils.register_classes_factory(classes)
