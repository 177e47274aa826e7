"""A layout that panels draw into where there is no window: it keeps what they said, and fails for
properties and operators that are not there."""

from __future__ import annotations

from types import SimpleNamespace

import bpy


class Layout:
    """`texts`: labels, and names of properties and operators, in order."""

    def __init__(self, root=None):
        self.root = root or self
        if root is None:
            self.texts = []
            self.icons = 0

    def _part(self, *_args, **_options):
        return Layout(self.root)

    row = column = box = split = grid_flow = _part

    def label(self, text="", **_options):
        self.root.texts.append(text)

    def prop(self, data, name, **_options):
        getattr(data, name)  # AttributeError where the panel asks for what is not there
        self.root.texts.append(name)

    def operator(self, name, text="", **_options):
        module, _, function = name.partition(".")
        getattr(getattr(bpy.ops, module), function).get_rna_type()
        self.root.texts.append(name)
        return SimpleNamespace()

    def progress(self, factor, text):
        assert 0 <= factor <= 1
        self.root.texts.append(text)

    def template_icon(self, icon_value, scale):
        assert scale > 0
        self.root.icons += 1

    def template_list(self, list_class, _id, data, name, active_data, active_name, **_options):
        assert hasattr(bpy.types, list_class)
        getattr(data, name), getattr(active_data, active_name)


def drawn(panel_class, **self_attributes):
    """What a panel (or preferences) class draws now."""
    layout = Layout()
    context = SimpleNamespace(
        scene=bpy.context.scene,
        active_object=bpy.context.view_layer.objects.active,
        engine=bpy.context.scene.render.engine,
        region=SimpleNamespace(width=320),
        preferences=SimpleNamespace(system=SimpleNamespace(ui_scale=1.0)),
    )
    panel_class.draw(SimpleNamespace(layout=layout, **self_attributes), context)
    return layout
