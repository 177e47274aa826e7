"""A scene's settings of how its frames are written and put together."""

from __future__ import annotations

import bpy

FORMATS = (
    ("PNG8", "PNG 8", "8 bits a channel, straight alpha: what was trained, as a screen shows it"),
    ("PNG16", "PNG 16", "16 bits a channel, straight alpha: the same with finer steps"),
    ("EXR", "EXR", "Scene-linear half, premultiplied alpha, and depth in metres (Z)"),
)
APPEARANCES = (
    ("SCENE", "As in the Scene", "What each head wears in the scene"),
    ("ALL", "All", "The whole range once for each appearance, each in a folder of its name"),
)


class PavFrames(bpy.types.PropertyGroup):
    """How Write Frames writes, and what Composite with Scene made of a scene."""

    format: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Format", description="File format of written frames", items=FORMATS, default="PNG8"
    )
    appearances: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Appearances", description="What the heads wear in written frames", items=APPEARANCES
    )
    # set in the scene that renders the heads for another one, which shows them
    shown_in: bpy.props.PointerProperty(  # type: ignore[valid-type]
        name="Shown In",
        description="The scene that this scene's heads are composited into",
        type=bpy.types.Scene,
    )
