"""Stopping what takes long."""

from __future__ import annotations

from typing import Any

import bpy

from ..bridge import jobs


class PAV_OT_cancel_job(bpy.types.Operator):
    """Stop the running job"""

    bl_idname = "pav.cancel_job"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, _context: Any) -> bool:
        return jobs.running()

    def execute(self, _context: Any) -> set[str]:
        jobs.cancel()
        return {"FINISHED"}


classes = (PAV_OT_cancel_job,)
register, unregister = bpy.utils.register_classes_factory(classes)
