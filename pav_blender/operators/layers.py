"""What a head wears over its appearance: layers, and regions to paint."""

from __future__ import annotations

from typing import Any, ClassVar

import bpy

from ..bridge import looks
from ..core.errors import InputError
from .context import OfHead, chosen_head
from .reporting import reporting


class PAV_OT_add_layer(OfHead, bpy.types.Operator):
    """Wear another appearance over the head's own"""

    bl_idname = "pav.add_layer"
    bl_label = "Add Layer"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    area: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Region",
        description="Where; a vertex group with soft edges is made, to be painted over",
        items=[
            ("NONE", "Whole Head", "Blend with the appearance below"),
            *((name.upper(), name.title(), f"The {name} alone") for name in looks.AREAS),
        ],
    )

    @reporting
    def execute(self, context: Any) -> set[str]:
        head = chosen_head(context)
        if not head.pav.is_property_set("appearance"):
            raise InputError(f"object {head.name!r}: choose its appearance first")
        region = "" if self.area == "NONE" else looks.add_area(head, self.area.lower())
        others = looks.other_appearances(head)
        layer = head.pav.layers.add()
        layer.region = region
        if others:
            layer.appearance = others[0]
        head.pav.active_layer = len(head.pav.layers) - 1
        return {"FINISHED"}


class PAV_OT_remove_layer(OfHead, bpy.types.Operator):
    """Take the chosen layer off; its vertex group stays"""

    bl_idname = "pav.remove_layer"
    bl_label = "Remove Layer"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    @reporting
    def execute(self, context: Any) -> set[str]:
        head = chosen_head(context)
        _chosen(head)
        head.pav.layers.remove(head.pav.active_layer)
        head.pav.active_layer = max(0, min(head.pav.active_layer, len(head.pav.layers) - 1))
        head.update_tag()
        return {"FINISHED"}


class PAV_OT_move_layer(OfHead, bpy.types.Operator):
    """Move the chosen layer; what is lower in the list lies on top"""

    bl_idname = "pav.move_layer"
    bl_label = "Move Layer"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    down: bpy.props.BoolProperty(name="Down")  # type: ignore[valid-type]

    @reporting
    def execute(self, context: Any) -> set[str]:
        head = chosen_head(context)
        _chosen(head)
        target = head.pav.active_layer + (1 if self.down else -1)
        if 0 <= target < len(head.pav.layers):
            head.pav.layers.move(head.pav.active_layer, target)
            head.pav.active_layer = target
            head.update_tag()
        return {"FINISHED"}


class PAV_OT_paint_region(OfHead, bpy.types.Operator):
    """Paint the weights that say where the chosen layer shows"""

    bl_idname = "pav.paint_region"
    bl_label = "Paint Region"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    @reporting
    def execute(self, context: Any) -> set[str]:
        head = chosen_head(context)
        layer = _chosen(head)
        if not layer.region:
            layer.region = head.vertex_groups.new(name=looks.AREA_PREFIX + "painted").name
        group = head.vertex_groups.get(layer.region)
        if group is None:
            raise InputError(f"object {head.name!r} has no vertex group {layer.region!r}")
        head.vertex_groups.active_index = group.index
        context.view_layer.objects.active = head
        bpy.ops.object.mode_set(mode="WEIGHT_PAINT")
        return {"FINISHED"}


def _chosen(head: Any) -> Any:
    if not head.pav.active_layer < len(head.pav.layers):
        raise InputError(f"object {head.name!r} has no layer to work on; add one first")
    return head.pav.layers[head.pav.active_layer]


classes = (PAV_OT_add_layer, PAV_OT_remove_layer, PAV_OT_move_layer, PAV_OT_paint_region)
register, unregister = bpy.utils.register_classes_factory(classes)
