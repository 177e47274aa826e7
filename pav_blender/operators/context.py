"""What operators and panels ask of the window: the head meant, the mode, the selection."""

from __future__ import annotations

from typing import Any

import bpy

from ..bridge import jobs
from ..core.errors import InputError


class OfHead:
    """An operator that needs a head."""

    @classmethod
    def poll(cls, context: Any) -> bool:
        return find_head(context) is not None


class StartsJob:
    """An operator that starts a job, of which there is one at a time."""

    @classmethod
    def poll(cls, _context: Any) -> bool:
        return not jobs.running()


class ChoosesFile:
    """An operator that opens the file browser before it works."""

    def invoke(self, context: Any, _event: Any) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}


def find_head(context: Any) -> Any | None:
    """The active object if it is a head, else the head that the active object deforms or holds,
    else the scene's only head."""
    active = context.active_object
    if active is not None and active.pav.avatar:
        return active
    if active is not None:
        for child in active.children:
            if child.pav.avatar:
                return child
    heads = [object_ for object_ in context.scene.objects if object_.pav.avatar]
    return heads[0] if len(heads) == 1 else None


def chosen_head(context: Any) -> Any:
    """What `find_head` finds. InputError where there is none."""
    head = find_head(context)
    if head is None:
        raise InputError("no head to work on: select one that has an avatar")
    return head


def object_mode(context: Any) -> None:
    if context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")


def select(context: Any, object_: Any) -> None:
    for other in context.selected_objects:
        other.select_set(False)
    object_.select_set(True)
    context.view_layer.objects.active = object_
