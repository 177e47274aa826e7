"""The add-on's data on objects and scenes."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.errors import PavError
from . import avatars

QUALITIES = (
    ("PREVIEW", "Preview", "Coarse and fast"),
    ("FINAL", "Final", "For pictures you keep"),
    ("REFERENCE", "Reference", "As fine as training; slow"),
)

# Blender keeps pointers to the strings of a dynamic enum: they must stay alive here
_items: dict[tuple[str, ...], list[tuple[str, str, str, int]]] = {}


def appearance_items(self: Any, _context: Any) -> list[tuple[str, str, str, int]]:
    """Menu of the appearances of an object's avatar; empty when the file cannot be read."""
    try:
        path = avatars.resolve(self.avatar, self.id_data.library) if self.avatar else None
        names = tuple(avatars.header(path)["appearances"]) if path else ()
    except (PavError, ImportError):
        names = ()
    if names not in _items:
        _items[names] = [
            (name, name, f"Render the avatar as in {name}", avatars.number(name)) for name in names
        ]
    return _items[names]


def _avatar_chosen(self: Any, context: Any) -> None:
    if not self.is_property_set("appearance"):
        items = appearance_items(self, context)
        if items:
            self.appearance = items[0][0]
    _redraw(self, context)


def _redraw(self: Any, _context: Any) -> None:
    self.id_data.update_tag()


class PavObject(bpy.types.PropertyGroup):
    """An object with an avatar file is rendered as that avatar."""

    avatar: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Avatar",
        description="Avatar file (.pav) that this head is rendered as",
        subtype="FILE_PATH",
        override={"LIBRARY_OVERRIDABLE"},
        update=_avatar_chosen,
    )
    appearance: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Appearance",
        description="Which of the learned appearances to render",
        items=appearance_items,
        override={"LIBRARY_OVERRIDABLE"},
        update=_redraw,
    )


class PavScene(bpy.types.PropertyGroup):
    """Settings of rendering and of the jobs started from the panels."""

    quality: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Quality", description="Render quality", items=QUALITIES, default="FINAL"
    )
    collection: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Collection",
        description="Folder of tracked clips (collection.json)",
        subtype="DIR_PATH",
    )
    clip: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Clip", description="Clip of the collection whose track to import"
    )
    output: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Avatar",
        description="Avatar file (.pav) to import, or to write by training",
        subtype="FILE_PATH",
    )
    arguments: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Options",
        description="Further options of `pav train`, as on a command line",
    )


classes = (PavObject, PavScene)


def register() -> None:
    for class_ in classes:
        bpy.utils.register_class(class_)
    bpy.types.Object.pav = bpy.props.PointerProperty(
        type=PavObject, override={"LIBRARY_OVERRIDABLE"}
    )
    bpy.types.Scene.pav = bpy.props.PointerProperty(type=PavScene)


def unregister() -> None:
    del bpy.types.Scene.pav
    del bpy.types.Object.pav
    for class_ in reversed(classes):
        bpy.utils.unregister_class(class_)
    _items.clear()
    avatars.forget()
