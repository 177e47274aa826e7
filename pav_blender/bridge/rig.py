"""A head model as Blender objects: a mesh with shape keys and groups, skinned by an armature.

Every bone points up with its local axes along the core's, so a pose's axis-angle is the bone's
own rotation and the head's translation is the root bone's location. Shape keys can turn joints too,
see `pose_keys`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core.head import HeadModel
from . import materials, pose_keys
from .axes import points_to_blender
from .mesh import add_group

REGION_PREFIX = "region."
CORRECTIVE_PREFIX = "corrective."
KEY_LIMIT = 10.0  # the widest range that Blender allows a shape key
_BONE_LENGTH = 0.05


@dataclass
class Rig:
    """The objects of one head. `mesh` is a child of `armature`."""

    mesh: Any
    armature: Any


def build_rig(head: HeadModel, betas: np.ndarray, name: str, collection: Any) -> Rig:
    """Builds the head of identity `betas` [B] and links its objects to a Blender `collection`.

    The evaluated mesh equals `head.pose(betas, expression, pose, translation)`.
    """
    mesh = _build_mesh(head, betas, name, collection)
    armature = _build_armature(head, betas, f"{name} armature", collection)
    modifier = mesh.modifiers.new("Armature", "ARMATURE")
    modifier.object = armature
    modifier.use_deform_preserve_volume = False
    mesh.parent = armature
    for joint, weights in zip(head.joint_names, head.skinning_weights.T, strict=True):
        add_group(mesh, joint, weights)
    for region, members in head.regions.items():
        add_group(mesh, REGION_PREFIX + region, members.astype(np.float32))
    pose_keys.connect(head, mesh, armature)
    _drive_correctives(head, mesh, armature)
    materials.paint(head, mesh)
    return Rig(mesh, armature)


def find_armature(mesh: Any) -> Any | None:
    """The armature that deforms a head's mesh object, or None."""
    for modifier in mesh.modifiers:
        if modifier.type == "ARMATURE" and modifier.object is not None:
            return modifier.object
    return None


def mesh_object(head: HeadModel, shaped: np.ndarray, name: str, collection: Any) -> Any:
    """A mesh object with the head's triangles and UVs and vertices [V, 3] (core axes), linked to a
    Blender `collection`."""
    import bpy

    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(points_to_blender(shaped).tolist(), [], head.triangles.tolist())
    corners = head.uvs[head.uv_triangles.reshape(-1)]
    layer = mesh.uv_layers.new(name="UVMap")
    layer.data.foreach_set("uv", np.ascontiguousarray(corners, np.float32).ravel())
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), bool))
    mesh.update()
    object_ = bpy.data.objects.new(name, mesh)
    collection.objects.link(object_)
    return object_


def _build_mesh(head: HeadModel, betas: np.ndarray, name: str, collection: Any) -> Any:
    shaped = np.asarray(head.shaped(betas), np.float32)
    object_ = mesh_object(head, shaped, name, collection)
    object_.shape_key_add(name="Basis", from_mix=False)
    for key_name, offsets in zip(head.expression_names, head.expression_basis, strict=True):
        _add_key(object_, key_name, shaped + offsets)
    for index, offsets in enumerate(head.pose_basis):
        _add_key(object_, f"{CORRECTIVE_PREFIX}{index:03d}", shaped + offsets)
    return object_


def _add_key(object_: Any, name: str, points: np.ndarray) -> None:
    key = object_.shape_key_add(name=name, from_mix=False)
    key.slider_min, key.slider_max = -KEY_LIMIT, KEY_LIMIT
    key.value = 0.0  # Blender 5 starts keys at 1
    flat = np.ascontiguousarray(points_to_blender(points), np.float32).ravel()
    key.data.foreach_set("co", flat)


def _build_armature(head: HeadModel, betas: np.ndarray, name: str, collection: Any) -> Any:
    import bpy

    data = bpy.data.armatures.new(name)
    object_ = bpy.data.objects.new(name, data)
    collection.objects.link(object_)
    joints = points_to_blender(np.asarray(head.joints(betas), np.float64))
    view_layer = bpy.context.view_layer
    before = view_layer.objects.active
    view_layer.objects.active = object_
    bpy.ops.object.mode_set(mode="EDIT")
    bones = []
    for joint, position in zip(head.joint_names, joints, strict=True):
        bone = data.edit_bones.new(joint)
        bone.head = position
        bone.tail = position + np.array([0, 0, _BONE_LENGTH])
        bone.roll = 0.0
        bones.append(bone)
    for bone, parent in zip(bones, head.joint_parents, strict=True):
        if parent >= 0:
            bone.parent = bones[parent]
    pose_keys.add_bones(head, data)
    bpy.ops.object.mode_set(mode="OBJECT")
    view_layer.objects.active = before
    for bone in object_.pose.bones:
        bone.rotation_mode = "QUATERNION"
    data.display_type = "STICK"  # hides the least of the face
    object_.show_in_front = True
    return object_


# R - I of a unit quaternion (w, x, y, z), row by row
_ROTATION_TERMS = (
    "-2*(y*y+z*z)",
    "2*(x*y-w*z)",
    "2*(x*z+w*y)",
    "2*(x*y+w*z)",
    "-2*(x*x+z*z)",
    "2*(y*z-w*x)",
    "2*(x*z-w*y)",
    "2*(y*z+w*x)",
    "-2*(x*x+y*y)",
)


def _drive_correctives(head: HeadModel, mesh: Any, armature: Any) -> None:
    """Pose correctives (FLAME's) follow the bones' rotations, pose keys and all, by drivers."""
    for index in range(len(head.pose_basis)):
        key = mesh.data.shape_keys.key_blocks[f"{CORRECTIVE_PREFIX}{index:03d}"]
        driver = pose_keys.add_driver(key, "value")
        for axis in "wxyz":
            variable = driver.variables.new()
            variable.name, variable.type = axis, "TRANSFORMS"
            target = variable.targets[0]
            target.id, target.bone_target = armature, head.joint_names[1 + index // 9]
            target.rotation_mode = "QUATERNION"
            target.transform_type = f"ROT_{axis.upper()}"
            target.transform_space = "LOCAL_SPACE"  # with constraints, without the parent's turn
        driver.expression = _ROTATION_TERMS[index % 9]
