"""Training beside Blender's window."""

from __future__ import annotations

import shlex
from typing import Any

import bpy

from ..bridge import avatars, jobs, requirements
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


classes = (PAV_OT_train,)
register, unregister = bpy.utils.register_classes_factory(classes)
