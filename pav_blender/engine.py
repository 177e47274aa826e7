"""The render engine: a thin class over `bridge.final` (F12) and `bridge.viewport`."""

from __future__ import annotations

from typing import Any

import bpy

from .bridge import final, viewport


class PavRenderEngine(bpy.types.RenderEngine):
    """Renders the avatars of a scene."""

    bl_idname = "PAV"
    bl_label = "PAV"
    bl_use_preview = False
    bl_use_postprocess = True
    bl_use_eevee_viewport = True

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.view: viewport.View | None = None

    def update_render_passes(self, scene: Any, renderlayer: Any) -> None:
        self.register_pass(scene, renderlayer, "Combined", 4, "RGBA", "COLOR")
        if renderlayer.use_pass_z:
            self.register_pass(scene, renderlayer, "Depth", 1, "Z", "VALUE")

    def render(self, depsgraph: Any) -> None:
        final.render(self, depsgraph)

    def view_update(self, context: Any, depsgraph: Any) -> None:
        self.view = self.view or viewport.View()
        self.view.update(depsgraph, context.space_data)

    def view_draw(self, context: Any, depsgraph: Any) -> None:
        if self.view is not None:
            viewport.draw_view(self, self.view, context, depsgraph)


# Panels of Blender that mean nothing for this engine
_FOREIGN_PANELS = {
    "DATA_PT_falloff_curve",
    "DATA_PT_light",
    "DATA_PT_spot",
    "NODE_DATA_PT_light",
    "NODE_DATA_PT_spot",
    "RENDER_PT_freestyle",
    "RENDER_PT_simplify",
}


def _shared_panels() -> list[Any]:
    """Blender's own panels that every engine shows (output, camera, colour management, ...)."""
    panels = bpy.types.Panel.__subclasses__()
    return [
        panel
        for panel in panels
        if "BLENDER_RENDER" in getattr(panel, "COMPAT_ENGINES", ())
        and panel.__name__ not in _FOREIGN_PANELS
    ]


def register() -> None:
    final.register()
    viewport.register()
    bpy.utils.register_class(PavRenderEngine)
    for panel in _shared_panels():
        panel.COMPAT_ENGINES.add(PavRenderEngine.bl_idname)


def unregister() -> None:
    for panel in _shared_panels():
        panel.COMPAT_ENGINES.discard(PavRenderEngine.bl_idname)
    bpy.utils.unregister_class(PavRenderEngine)
    viewport.unregister()
    final.unregister()
