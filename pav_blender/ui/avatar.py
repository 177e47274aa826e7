"""The head chosen, and what it wears."""

from __future__ import annotations

from typing import Any

import bpy

from ..bridge import looks
from ..operators.context import find_head
from .shared import Sidebar, draw_missing


class PAV_PT_avatar(Sidebar, bpy.types.Panel):
    bl_idname = "PAV_PT_avatar"
    bl_label = "Avatar"

    def draw(self, context: Any) -> None:
        layout = self.layout
        draw_missing(layout)
        head = find_head(context)
        row = layout.row(align=True)
        row.operator("pav.add_head", icon="IMPORT")
        row.operator("pav.save_head", icon="EXPORT")
        layout.operator("pav.add_rig", icon="ARMATURE_DATA")
        active = context.active_object
        if head is None and active is not None and active.type == "MESH":
            head = active
        if head is None:
            layout.label(text="Select a head to choose its avatar", icon="INFO")
            return
        column = layout.column()
        column.use_property_split = True
        column.label(text=head.name, icon="MESH_DATA")
        column.prop(head.pav, "avatar", text="File")
        if head.pav.avatar:
            column.template_icon_view(head.pav, "appearance", show_labels=True, scale_popup=5.0)
            column.prop(head.pav, "appearance")


class PAV_UL_layers(bpy.types.UIList):
    bl_idname = "PAV_UL_layers"

    def draw_item(
        self,
        _context: Any,
        layout: Any,
        _data: Any,
        item: Any,
        _icon: int,
        _active_data: Any,
        _active_property: str,
        _index: int = 0,
        _flag: int = 0,
    ) -> None:
        row = layout.row(align=True)
        row.prop(item, "appearance", text="", emboss=False)
        region = item.region.removeprefix(looks.AREA_PREFIX) or "whole head"
        row.label(text=region)
        row.prop(item, "weight", text="", slider=True)


class PAV_PT_layers(Sidebar, bpy.types.Panel):
    bl_idname = "PAV_PT_layers"
    bl_label = "Layers"
    bl_parent_id = "PAV_PT_avatar"

    @classmethod
    def poll(cls, context: Any) -> bool:
        return find_head(context) is not None

    def draw(self, context: Any) -> None:
        head: Any = find_head(context)
        row = self.layout.row()
        row.template_list("PAV_UL_layers", "", head.pav, "layers", head.pav, "active_layer", rows=3)
        side = row.column(align=True)
        side.operator_menu_enum("pav.add_layer", "area", text="", icon="ADD")
        side.operator("pav.remove_layer", text="", icon="REMOVE")
        side.separator()
        side.operator("pav.move_layer", text="", icon="TRIA_UP").down = False
        side.operator("pav.move_layer", text="", icon="TRIA_DOWN").down = True
        if not head.pav.active_layer < len(head.pav.layers):
            return
        layer = head.pav.layers[head.pav.active_layer]
        column = self.layout.column()
        column.use_property_split = True
        column.prop(layer, "appearance")
        column.prop_search(layer, "region", head, "vertex_groups")
        column.prop(layer, "weight")
        column.operator("pav.paint_region", icon="BRUSH_DATA")


classes = (PAV_PT_avatar, PAV_UL_layers, PAV_PT_layers)
register, unregister = bpy.utils.register_classes_factory(classes)
