"""Meshes and hair curves from arrays, with their attributes."""

from __future__ import annotations

import bpy
import numpy as np


def mesh_object(
    name: str, vertices: np.ndarray, quads: np.ndarray, material, *, label=0, smooth=True, **points
):
    """A mesh object; `label`: a number or one a face; `points`: vertex attributes [V] or [V,3]."""
    mesh = bpy.data.meshes.new(name)
    faces = np.ascontiguousarray(quads, np.int32)
    mesh.vertices.add(len(vertices))
    mesh.loops.add(faces.size)
    mesh.polygons.add(len(faces))
    mesh.vertices.foreach_set("co", _flat(vertices))
    mesh.loops.foreach_set("vertex_index", faces.reshape(-1))
    mesh.polygons.foreach_set(
        "loop_start", np.arange(0, faces.size, faces.shape[1], dtype=np.int32)
    )
    mesh.polygons.foreach_set("use_smooth", np.full(len(faces), smooth))
    mesh.update(calc_edges=True)
    set_attribute(mesh, "label", np.broadcast_to(np.float32(label), len(faces)), "FACE")
    for key, values in points.items():
        set_attribute(mesh, key, values, "POINT")
    mesh.materials.append(material)
    return bpy.data.objects.new(name, mesh)


def move_mesh(item, vertices: np.ndarray) -> None:
    item.data.vertices.foreach_set("co", _flat(vertices))
    item.data.update()


def curve_object(
    name: str, points: np.ndarray, radius: np.ndarray, material, *, label=0, **strands
):
    """Hair curves: `points` [S,P,3], `radius` [P] or [S,P] metres, `strands` are attributes [S]."""
    count, length = points.shape[:2]
    curves = bpy.data.hair_curves.new(name)
    curves.add_curves([length] * count)
    move_curves_data(curves, points)
    set_attribute(curves, "radius", np.broadcast_to(radius, (count, length)).reshape(-1), "POINT")
    along = np.broadcast_to(np.linspace(0, 1, length, dtype=np.float32), (count, length))
    set_attribute(curves, "along", along.reshape(-1), "POINT")
    set_attribute(curves, "label", np.full(count, label, np.float32), "CURVE")
    for key, values in strands.items():
        set_attribute(curves, key, values, "CURVE")
    curves.materials.append(material)
    return bpy.data.objects.new(name, curves)


def move_curves(item, points: np.ndarray) -> None:
    move_curves_data(item.data, points)
    item.data.update_tag()


def move_curves_data(curves, points: np.ndarray) -> None:
    curves.position_data.foreach_set("vector", _flat(points))


def set_attribute(data, name: str, values: np.ndarray, domain: str) -> None:
    vector = np.ndim(values) == 2
    existing = data.attributes.get(name)
    attribute = existing or data.attributes.new(name, "FLOAT_VECTOR" if vector else "FLOAT", domain)
    attribute.data.foreach_set("vector" if vector else "value", _flat(values))


def _flat(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32).reshape(-1)


def delete(item) -> None:
    """Remove an object and its data."""
    data = item.data
    kind = {"MESH": bpy.data.meshes, "CURVES": bpy.data.hair_curves, "LIGHT": bpy.data.lights,
            "CAMERA": bpy.data.cameras}[item.type]  # fmt: skip
    bpy.data.objects.remove(item)
    if data.users == 0:
        kind.remove(data)
