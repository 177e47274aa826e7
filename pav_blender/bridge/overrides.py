"""Heads linked from another file, made editable as library overrides.

Blender's own *Library Override* leaves a mesh linked, and with it its shape keys: what is keyed
there is gone when the file is opened again. So the mesh is overridden too.
"""

from __future__ import annotations

from typing import Any

from ..core.errors import InputError
from .avatars import heads_of


def override_head(context: Any, object_: Any) -> Any:
    """Overrides a linked head object, or the linked collection that an empty shows, with all that
    belongs to it; returns the (first) head. InputError where there is no linked head."""
    import bpy

    shown = object_.instance_collection
    linked = shown if shown is not None and shown.library else object_
    if linked.library is None and not any(_is_linked(head) for head in heads_of([object_])):
        raise InputError(f"object {object_.name!r} is not linked from another file")
    if linked.library is not None:
        before = set(bpy.data.objects)
        made = linked.override_hierarchy_create(
            context.scene, context.view_layer, reference=object_, do_fully_editable=True
        )
        if made is None:
            raise InputError(f"Blender could not override {linked.name!r}")
        heads = heads_of(set(bpy.data.objects) - before)
        if linked == shown and heads:
            bpy.data.objects.remove(object_)
    else:
        heads = heads_of([object_])
    if not heads:
        raise InputError(f"{linked.name!r} holds no head with an avatar")
    for head in heads:
        if head.data.library is not None:
            head.data.override_create(remap_local_usages=True)
    return heads[0]


def check_editable(mesh: Any, armature: Any | None) -> None:
    """InputError where keyframes on a head would be lost with the file."""
    if _is_linked(mesh) or (armature is not None and armature.library is not None):
        raise InputError(
            f"object {mesh.name!r} is linked from another file: use Override Linked Head first"
        )


def _is_linked(mesh: Any) -> bool:
    return mesh.library is not None or mesh.data.library is not None
