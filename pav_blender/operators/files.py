"""Avatar files: packed into the .blend, unpacked, found again."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..bridge import avatars, links, overrides, packing, requirements
from .context import ChoosesFile, chosen_head, find_head, object_mode, select
from .reporting import reporting


class PAV_OT_pack_avatar(bpy.types.Operator):
    """Store the head's avatar file in this .blend"""

    bl_idname = "pav.pack_avatar"
    bl_label = "Pack Avatar"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        head = find_head(context)
        return head is not None and head.pav.pack.text is None

    @reporting
    def execute(self, context: Any) -> set[str]:
        requirements.check()
        head = chosen_head(context)
        path = avatars.path_of(head.pav)
        avatars.header(path)  # what is no avatar is not packed
        packing.pack(head, path)
        self.report({"INFO"}, f"{path.name} is in this file once it is saved")
        return {"FINISHED"}


class PAV_OT_unpack_avatar(bpy.types.Operator):
    """Write the head's packed avatar file beside this .blend, and use that"""

    bl_idname = "pav.unpack_avatar"
    bl_label = "Unpack Avatar"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        head = find_head(context)
        return head is not None and head.pav.pack.text is not None

    @reporting
    def execute(self, context: Any) -> set[str]:
        path = packing.unpack(chosen_head(context))
        self.report({"INFO"}, f"Wrote {path}")
        return {"FINISHED"}


class PAV_OT_relink_avatars(ChoosesFile, bpy.types.Operator):
    """Find the avatar files that are missing, in a folder and those below it"""

    bl_idname = "pav.relink_avatars"
    bl_label = "Relink Missing Avatars"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    directory: bpy.props.StringProperty(subtype="DIR_PATH")  # type: ignore[valid-type]

    @reporting
    def execute(self, context: Any) -> set[str]:
        requirements.check()
        mended, missing = links.relink(Path(bpy.path.abspath(self.directory)))
        for line in missing:
            self.report({"WARNING"}, f"Not found: {line}")
        if mended or not missing:
            self.report({"INFO"}, f"{len(mended)} found: {', '.join(mended) or 'none was missing'}")
        return {"FINISHED"}


class PAV_OT_override_head(bpy.types.Operator):
    """Make a head that is linked from another file editable here, shape keys and all"""

    bl_idname = "pav.override_head"
    bl_label = "Override Linked Head"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        return context.active_object is not None

    @reporting
    def execute(self, context: Any) -> set[str]:
        object_mode(context)
        head = overrides.override_head(context, context.active_object)
        select(context, head)
        return {"FINISHED"}


classes = (PAV_OT_pack_avatar, PAV_OT_unpack_avatar, PAV_OT_relink_avatars, PAV_OT_override_head)
register, unregister = bpy.utils.register_classes_factory(classes)
