"""Plain materials by region, so that a head looks like one before any avatar is trained."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core.head import HeadModel

# scene-linear colour and roughness
_LOOKS = {
    "PAV skin": ((0.52, 0.27, 0.19), 0.5),
    "PAV lips": ((0.42, 0.13, 0.12), 0.4),
    "PAV mouth": ((0.25, 0.04, 0.04), 0.4),
    "PAV teeth": ((0.75, 0.70, 0.60), 0.25),
    "PAV eyes": ((0.85, 0.83, 0.80), 0.15),
    "PAV iris": ((0.10, 0.16, 0.20), 0.1),
    "PAV pupil": ((0.005, 0.005, 0.005), 0.1),
}
# FLAME's masks say left_eyeball, the built-in head eyeballs
_REGIONS = {
    "PAV lips": ("lips",),
    "PAV mouth": ("mouth_interior", "tongue"),
    "PAV teeth": ("teeth",),
    "PAV eyes": ("eyeballs", "left_eyeball", "right_eyeball"),
}
_IRIS, _PUPIL = 27.0, 12.0  # degrees off the way an eye looks
_EYE = 0.02  # metres from an eye's middle that are its own


def paint(head: HeadModel, mesh: Any) -> None:
    """Gives a head's mesh object the materials that its regions ask for."""
    names = _names(head)
    used = [name for name in _LOOKS if (names == name).any()]
    for name in used:
        mesh.data.materials.append(_material(name))
    slots = np.array([used.index(name) for name in names], np.int32)
    mesh.data.polygons.foreach_set("material_index", slots)


def _names(head: HeadModel) -> np.ndarray:
    """The material of each triangle, [T] of names."""
    names = np.full(len(head.triangles), "PAV skin", dtype=object)
    for name, regions in _REGIONS.items():
        for region in regions:
            if region in head.regions:
                names[head.regions[region][head.triangles].all(1)] = name
    eyes = names == "PAV eyes"
    middles = head.template[head.triangles].mean(1)
    joints = head.joint_regressor @ head.template
    for joint in ("left_eye", "right_eye"):
        if joint not in head.joint_names:
            continue
        x, y, z = (middles - joints[head.joint_names.index(joint)]).T
        mine = eyes & (np.abs(x) < _EYE)
        off = np.degrees(np.arctan2(np.hypot(x, y), z))
        names[mine & (off < _IRIS)] = "PAV iris"
        names[mine & (off < _PUPIL)] = "PAV pupil"
    return names


def _material(name: str) -> Any:
    """The file's own material of this name, made at its first use."""
    import bpy

    material = bpy.data.materials.get((name, None))
    if material is not None:
        return material
    colour, roughness = _LOOKS[name]
    material = bpy.data.materials.new(name)
    material.diffuse_color = (*colour, 1)  # what solid shading shows
    material.roughness = roughness
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    shader = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    shader.inputs["Base Color"].default_value = (*colour, 1)
    shader.inputs["Roughness"].default_value = roughness
    return material
