"""Blender meshes as arrays."""

from __future__ import annotations

from typing import Any

import numpy as np

from .axes import matrix_to_core, points_to_core


def vertices(mesh: Any) -> np.ndarray:
    """Vertices of a mesh in its object's own space, core axes, [V, 3] float32."""
    flat = np.empty(len(mesh.vertices) * 3, np.float32)
    mesh.vertices.foreach_get("co", flat)
    return points_to_core(flat.reshape(-1, 3))


def triangles(mesh: Any) -> np.ndarray:
    """Faces of a mesh of triangles, [T, 3] int32; other polygons come as Blender splits them."""
    corners = np.empty(len(mesh.loops), np.int32)
    if len(mesh.loops) == 3 * len(mesh.polygons):
        mesh.loops.foreach_get("vertex_index", corners)
        return corners.reshape(-1, 3)
    mesh.calc_loop_triangles()
    split = np.empty(len(mesh.loop_triangles) * 3, np.int32)
    mesh.loop_triangles.foreach_get("vertices", split)
    return split.reshape(-1, 3)


def evaluated_vertices(evaluated: Any) -> np.ndarray:
    """Vertices of an evaluated object with its modifiers and shape keys applied, as `vertices`."""
    return vertices(evaluated.data)


def group_weights(object_: Any) -> np.ndarray:
    """Weights [V, groups] float32 of all vertex groups of a mesh object; one column at least."""
    weights = np.zeros((len(object_.data.vertices), max(1, len(object_.vertex_groups))), np.float32)
    for vertex in object_.data.vertices:
        for member in vertex.groups:
            weights[vertex.index, member.group] = member.weight
    return weights


def add_group(object_: Any, name: str, weights: np.ndarray) -> None:
    """Adds a vertex group with weights [V]; vertices of weight 0 stay outside."""
    group = object_.vertex_groups.new(name=name)
    members = np.flatnonzero(weights > 0)
    for weight in np.unique(weights[members]):
        chosen = members[weights[members] == weight]
        group.add(chosen.tolist(), float(weight), "REPLACE")


def placement(matrix_world: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Splits an object's `matrix_world` [4, 4] into what an avatar is rendered with.

    Returns (rigid [4, 4], stretch [3, 3], scale) in core axes: a vertex v of the object lies in
    the world at rigid . scale . (stretch v). A rigid move or a uniform scale of the object is the
    opposite change of the camera, so the picture keeps its quality; only what is left, a stretch
    of volume 1 (or a mirror), changes the shape that the avatar sees.
    """
    matrix = matrix_to_core(np.asarray(matrix_world, np.float64))
    linear = matrix[:3, :3]
    left, sizes, right = np.linalg.svd(linear)
    if sizes[-1] <= 1e-9 * max(sizes[0], 1e-12):
        raise ValueError("the object's scale is zero along an axis")
    rotation = left @ right
    if np.linalg.det(rotation) < 0:
        left[:, -1] *= -1
        rotation = left @ right
    scale = float(np.prod(sizes) ** (1 / 3))
    rigid = np.eye(4)
    rigid[:3, :3] = rotation
    rigid[:3, 3] = matrix[:3, 3]
    return rigid, rotation.T @ linear / scale, scale
