"""Writing frames without the render pipeline."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ..bridge import jobs, sequence
from .context import StartsJob
from .reporting import reporting


class PAV_OT_write_sequence(StartsJob, bpy.types.Operator):
    """Write the scene's frames into the output folder; keep those whose inputs did not change"""

    bl_idname = "pav.write_sequence"
    bl_label = "Write Frames"

    @reporting
    def execute(self, context: Any) -> set[str]:
        scene = context.scene
        folder = Path(bpy.path.abspath(scene.render.filepath))
        jobs.start(jobs.WRITING, lambda: sequence.begin(scene, folder), f"Frames are in {folder}")
        return {"FINISHED"}


classes = (PAV_OT_write_sequence,)
register, unregister = bpy.utils.register_classes_factory(classes)
