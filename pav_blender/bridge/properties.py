"""The add-on's data on objects and scenes."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.errors import PavError
from ..core.reading import read_json
from . import avatars, thumbnails, training_properties
from .frame_settings import PavFrames
from .training_properties import PavTraining

QUALITIES = (
    ("PREVIEW", "Preview", "Coarse and fast"),
    ("FINAL", "Final", "For pictures you keep"),
    ("REFERENCE", "Reference", "As fine as training; slow"),
)

# Blender 4.5 and later ask which paths may begin with "//"; earlier ones do not know the option
_RELATIVE = {"ANIMATABLE"}
if bpy.app.version >= (4, 5):
    _RELATIVE.add("PATH_SUPPORTS_BLEND_RELATIVE")

# Blender keeps pointers to the strings of a dynamic enum: they must stay alive here
_items: dict[tuple[Any, Any], list[tuple[str, str, str, int, int]]] = {}


def appearance_items(self: Any, _context: Any) -> list[tuple[str, str, str, int, int]]:
    """Menu of the appearances of an object's avatar; empty when the file cannot be read."""
    head = self.id_data.pav  # self may be one of its layers
    try:
        path = avatars.path_of(head) if head.avatar else None
        names = tuple(avatars.looks(path, head.identity)) if path else ()
    except (PavError, ImportError):
        path, names = None, ()
    icons = tuple(thumbnails.icons(path, names)) if path else ()
    key = names, icons
    if key not in _items:
        _items[key] = [
            (name, name, f"Render the avatar as in {name}", icon, avatars.number(name))
            for name, icon in zip(names, icons, strict=True)
        ]
    return _items[key]


def clip_names(self: Any, _context: Any, edit_text: str) -> list[str]:
    """Clips of the chosen collection whose name contains what was typed."""
    try:
        folder = avatars.resolve(self.collection)
        known = read_json(folder / "collection.json")["clips"]
        names = [str(clip["name"]) for clip in known]
    except (PavError, KeyError, TypeError):
        return []
    return [name for name in names if edit_text.lower() in name.lower()]


def _avatar_chosen(self: Any, context: Any) -> None:
    if not self.is_property_set("appearance"):
        items = appearance_items(self, context)
        if items:
            self.appearance = items[0][0]
    _redraw(self, context)


def _redraw(self: Any, _context: Any) -> None:
    self.id_data.update_tag()


class PavLayer(bpy.types.PropertyGroup):
    """An appearance worn over the head's own, everywhere or in a region."""

    appearance: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Appearance",
        description="The appearance that this layer shows",
        items=appearance_items,
        override={"LIBRARY_OVERRIDABLE"},
        update=_redraw,
    )
    weight: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Weight",
        description="How much the layer hides what lies below it",
        min=0.0,
        max=1.0,
        default=1.0,
        subtype="FACTOR",
        override={"LIBRARY_OVERRIDABLE"},
        update=_redraw,
    )
    region: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Region",
        description="Vertex group whose weights say where; the whole head if empty",
        override={"LIBRARY_OVERRIDABLE"},
        update=_redraw,
    )


class PavPack(bpy.types.PropertyGroup):
    """An avatar file inside the .blend, see `packing`."""

    text: bpy.props.PointerProperty(  # type: ignore[valid-type]
        name="Packed",
        description="The text that holds the packed avatar file; it is used in place of the path",
        type=bpy.types.Text,
        override={"LIBRARY_OVERRIDABLE"},
        update=_redraw,
    )


class PavObject(bpy.types.PropertyGroup):
    """An object with an avatar file is rendered as that avatar."""

    avatar: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Avatar",
        description="Avatar file (.pav) that this head is rendered as",
        subtype="FILE_PATH",
        options=_RELATIVE,
        override={"LIBRARY_OVERRIDABLE"},
        update=_avatar_chosen,
    )
    identity: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Identity",
        description="Of an avatar of several people, whose head this is; it wears that person's "
        "appearances",
        override={"LIBRARY_OVERRIDABLE"},
        update=_redraw,
    )
    appearance: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Appearance",
        description="Which of the learned appearances to render",
        items=appearance_items,
        override={"LIBRARY_OVERRIDABLE"},
        update=_redraw,
    )

    layers: bpy.props.CollectionProperty(  # type: ignore[valid-type]
        name="Layers",
        description="Appearances over the head's own, the last on top",
        type=PavLayer,
        override={"LIBRARY_OVERRIDABLE", "USE_INSERTION"},
    )
    active_layer: bpy.props.IntProperty(  # type: ignore[valid-type]
        name="Active Layer", min=0, override={"LIBRARY_OVERRIDABLE"}, options=set()
    )
    pack: bpy.props.PointerProperty(  # type: ignore[valid-type]
        type=PavPack, override={"LIBRARY_OVERRIDABLE"}
    )
    camera: bpy.props.PointerProperty(  # type: ignore[valid-type]
        name="Camera",
        description="The camera of the imported track",
        type=bpy.types.Object,
        override={"LIBRARY_OVERRIDABLE"},
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
        name="Clip",
        description="Clip of the collection whose track to import; its first if empty",
        search=clip_names,
    )
    frames: bpy.props.PointerProperty(type=PavFrames)  # type: ignore[valid-type]
    training: bpy.props.PointerProperty(type=PavTraining)  # type: ignore[valid-type]


classes = (*training_properties.classes, PavLayer, PavFrames, PavPack, PavObject, PavScene)


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
    thumbnails.forget()
    _items.clear()
    avatars.forget()
