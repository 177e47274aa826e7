"""Starting and stopping what takes long."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import bpy

from ..bridge import avatars, jobs, requirements, sequence
from ..bridge.process import Process
from ..core.errors import InputError
from .reporting import reporting


class PAV_OT_train(bpy.types.Operator):
    """Train an avatar from the collection, in a process beside Blender"""

    bl_idname = "pav.train"
    bl_label = "Train"

    @classmethod
    def poll(cls, _context: Any) -> bool:
        return not jobs.running()

    @reporting
    def execute(self, context: Any) -> set[str]:
        requirements.check()
        settings = context.scene.pav
        if not (settings.collection and settings.output):
            raise InputError("choose the collection's folder and the avatar file to write")
        collection, output = avatars.resolve(settings.collection), avatars.resolve(settings.output)
        arguments = ["train", str(collection), "--out", str(output), "--json-progress"]
        arguments += shlex.split(settings.arguments)
        jobs.start(jobs.TRAINING, lambda: Process(arguments), f"Wrote {output}")
        return {"FINISHED"}


class PAV_OT_write_sequence(bpy.types.Operator):
    """Write the scene's frames as PNG into the output folder; frames already there are kept"""

    bl_idname = "pav.write_sequence"
    bl_label = "Write Frames"

    @classmethod
    def poll(cls, _context: Any) -> bool:
        return not jobs.running()

    @reporting
    def execute(self, context: Any) -> set[str]:
        scene = context.scene
        folder = Path(bpy.path.abspath(scene.render.filepath))
        jobs.start(jobs.WRITING, lambda: sequence.begin(scene, folder), f"Frames are in {folder}")
        return {"FINISHED"}


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


classes = (PAV_OT_train, PAV_OT_write_sequence, PAV_OT_cancel_job)
register, unregister = bpy.utils.register_classes_factory(classes)
