"""A picture of the heads among other objects: what *Composite with Scene* makes.

    python -m tools.show_compositing out/demo/avatar.blend --out docs/pictures/compositing.png

In a Python with bpy. Around the head of the first frame: a ring that passes before and behind it, a
box that reaches into it, a wall and a floor, lit by a lamp; Cycles renders those.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

import numpy as np


def surround(scene, head) -> None:
    """Adds ring, box, wall and lamp about an evaluated head (as the demo's: about 20 cm wide)."""
    import bpy

    centre = face_centre(head)
    x, y, z = centre
    objects = bpy.ops.mesh
    objects.primitive_torus_add(
        location=(x, y + 0.02, z - 0.03),
        rotation=(0.35, 0.25, 0),
        major_radius=0.15,
        minor_radius=0.012,
        major_segments=96,
        minor_segments=24,
    )
    paint("ring", (0.9, 0.5, 0.05))
    objects.primitive_cube_add(
        size=0.1, location=(x + 0.13, y - 0.06, z - 0.2), rotation=(0.3, 0.2, 0.5)
    )
    paint("box", (0.05, 0.35, 0.7))
    objects.primitive_plane_add(size=3, location=(x, y + 0.35, z), rotation=(np.pi / 2, 0, 0))
    paint("wall", (0.35, 0.4, 0.38))
    bpy.ops.object.light_add(type="AREA", location=(x - 0.7, y - 0.8, z + 0.9))
    lamp = bpy.context.object
    lamp.data.energy, lamp.data.size = 25.0, 0.4
    lamp.rotation_euler = (0.75, 0.0, -0.7)
    scene.world = bpy.data.worlds.new("grey")
    scene.world.color = 0.3, 0.3, 0.3
    if bpy.app.version < (5, 0, 0):
        scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = 0.3, 0.3, 0.3, 1


def face_centre(head) -> np.ndarray:
    """The middle of what is less than 20 cm below the crown."""
    import bpy

    evaluated = head.evaluated_get(bpy.context.evaluated_depsgraph_get())
    points = np.empty(3 * len(evaluated.data.vertices), np.float32)
    evaluated.data.vertices.foreach_get("co", points)
    matrix = np.array(evaluated.matrix_world)
    world = points.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
    top = world[:, 2].max()
    skull = world[world[:, 2] > top - 0.2]
    return (skull.min(0) + skull.max(0)) / 2


def paint(name: str, colour: tuple[float, float, float]) -> None:
    """A plain material and smooth shading for the active object."""
    import bpy

    thing = bpy.context.object
    thing.name = name
    material = bpy.data.materials.new(name)
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (*colour, 1)
    thing.data.materials.append(material)
    for polygon in thing.data.polygons:
        polygon.use_smooth = name == "ring"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("blend", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--size", type=int, default=320)
    parser.add_argument("--samples", type=int, default=24)
    args = parser.parse_args()
    import bpy

    import pav_blender

    pav_blender.register()
    bpy.ops.wm.open_mainfile(filepath=str(args.blend.resolve()))
    scene = bpy.context.scene
    scene.frame_set(scene.frame_start)
    head = next(thing for thing in scene.objects if thing.pav.avatar)
    surround(scene, head)
    scene.render.film_transparent = False
    longer = max(scene.render.resolution_x, scene.render.resolution_y)
    scene.render.resolution_percentage = round(100 * args.size / longer)
    bpy.ops.pav.composite()
    scene.cycles.samples, scene.cycles.use_denoising = args.samples, False
    scene.render.image_settings.color_mode = "RGB"
    scene.render.filepath = str(args.out.resolve())
    bpy.ops.render.render(write_still=True)
    print(args.out)
    return 0


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # the wheel hangs at exit while classes are registered
