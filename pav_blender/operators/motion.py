"""Moving a head by what was tracked."""

from __future__ import annotations

from typing import Any, ClassVar

import bpy

from ..bridge import avatars, requirements
from ..bridge import scene as bridge_scene
from ..core.errors import InputError
from .context import find_head, object_mode
from .reporting import reporting


class PAV_OT_import_track(bpy.types.Operator):
    """Animate the active head, and the camera, as in a clip of a collection"""

    bl_idname = "pav.import_track"
    bl_label = "Import Track"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        return find_head(context) is not None

    @reporting
    def execute(self, context: Any) -> set[str]:
        requirements.check()
        from ..core.collection import read_collection

        settings = context.scene.pav
        if not settings.collection:
            raise InputError("choose the collection's folder first")
        object_mode(context)
        collection = read_collection(avatars.resolve(settings.collection))
        clip = settings.clip or collection.clips[0].name
        bridge_scene.import_track(find_head(context), collection, clip)
        bridge_scene.use_engine(context.scene)
        self.report({"INFO"}, f"{clip}: {len(collection.clip(clip))} frames")
        return {"FINISHED"}


classes = (PAV_OT_import_track,)
register, unregister = bpy.utils.register_classes_factory(classes)
