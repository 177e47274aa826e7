"""Light of one appearance: area lights round the head and a gradient sky."""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Matrix

from .nodes import Graph


@dataclass(frozen=True)
class AreaLight:
    """Placed by azimuth (0: in front, + to the person's left) and elevation in degrees."""

    azimuth: float
    elevation: float
    power: float
    size: float = 0.6
    distance: float = 1.4
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Lighting:
    lights: tuple[AreaLight, ...]
    zenith: tuple[float, float, float] = (0.5, 0.55, 0.62)
    ground: tuple[float, float, float] = (0.18, 0.16, 0.15)
    sky: float = 0.5


def light_object(number: int, light: AreaLight):
    data = bpy.data.lights.new(f"studio light {number}", "AREA")
    data.energy, data.color = light.power, light.colour
    data.shape, data.size = "DISK", light.size
    azimuth, elevation = np.radians([light.azimuth, light.elevation])
    level = np.cos(elevation)
    away = np.array([np.sin(azimuth) * level, np.sin(elevation), np.cos(azimuth) * level])
    item = bpy.data.objects.new(data.name, data)
    right = np.cross([0.0, 1.0, 0.0], away)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(away, right), away], axis=1)
    matrix[:3, 3] = light.distance * away + [0, -0.03, -0.06]
    item.matrix_world = Matrix(matrix.tolist())
    return item


def new_world(lighting: Lighting):
    """A sky that fades from the ground colour to the zenith's along +y."""
    world = bpy.data.worlds.new("studio sky")
    world.use_nodes = True
    graph = Graph(world.node_tree)
    direction = graph.add("TexCoord").outputs["Generated"]
    height = graph.add("SeparateXYZ", Vector=direction).outputs[1]
    colour = graph.mix(graph.smooth(height, -0.6, 0.8), lighting.ground, lighting.zenith)
    background = graph.add("Background", Color=colour, Strength=lighting.sky)
    out = graph.add("OutputWorld")
    graph.tree.links.new(background.outputs[0], out.inputs[0])
    world.cycles.sampling_method = "NONE"
    return world
