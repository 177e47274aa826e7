"""The formula head as Blender objects."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from . import shape

NAME = "Formula"
_BALL = 6  # subdivisions of an icosahedron: 20 480 triangles


def _blender(points: np.ndarray) -> np.ndarray:
    return points[:, [0, 2, 1]] * (1, -1, 1)


def directions(object_: Any) -> np.ndarray:
    """Where on the ball each vertex [V, 3] was, core axes."""
    flat = np.empty(3 * len(object_.data.vertices), np.float32)
    object_.data.attributes["ball"].data.foreach_get("vector", flat)
    return flat.reshape(-1, 3).astype(float)


def build() -> Any:
    """Adds the mesh, its keys, groups and armature to the scene; returns the mesh object.

    It has no UVs, and its bones have names of their own.
    """
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=_BALL, radius=1, calc_uvs=False)
    object_ = bpy.context.object
    object_.name = NAME
    flat = np.empty(3 * len(object_.data.vertices), np.float32)
    object_.data.vertices.foreach_get("co", flat)
    d = flat.reshape(-1, 3)[:, [0, 2, 1]] * (1, 1, -1)
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    object_.data.attributes.new("ball", "FLOAT_VECTOR", "POINT").data.foreach_set(
        "vector", d.astype(np.float32).ravel()
    )
    _set(object_.data.vertices, shape.rest(d))
    object_.shape_key_add(name="Basis", from_mix=False)
    for name, points in shape.keys(d).items():
        key = object_.shape_key_add(name=name, from_mix=False)
        key.value = 0
        _set(key.data, points)
    groups = shape.weights(d) | {f"region.{k}": v for k, v in shape.regions(d).items()}
    for name, values in groups.items():
        group = object_.vertex_groups.new(name=name)
        for index in np.flatnonzero(values > 1e-4).tolist():
            group.add([index], float(values[index]), "REPLACE")
    modifier = object_.modifiers.new("Armature", "ARMATURE")
    modifier.object = _armature()
    return object_


def _set(points: Any, values: np.ndarray) -> None:
    points.foreach_set("co", np.ascontiguousarray(_blender(values), np.float32).ravel())


def _armature() -> Any:
    data = bpy.data.armatures.new("Bones")
    object_ = bpy.data.objects.new("Bones", data)
    bpy.context.scene.collection.objects.link(object_)
    bpy.context.view_layer.objects.active = object_
    bpy.ops.object.mode_set(mode="EDIT")
    for name, (parent, place) in shape.BONES.items():
        bone = data.edit_bones.new(name)
        bone.head = _blender(place[None])[0]
        bone.tail = bone.head + bone.head.__class__((0, -0.03, 0.04))
        if parent:
            bone.parent = data.edit_bones[parent]
    bpy.ops.object.mode_set(mode="OBJECT")
    return object_
