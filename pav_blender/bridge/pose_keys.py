"""Shape keys that turn joints: an animator keys `jaw_open` as any expression.

A pose key moves no vertex. Its value turns a hidden bone beside the joint's own (`jaw.pose`), and a
constraint turns the joint's bone by that after its own turn. So tracks key the joint's bone,
animators the pose key, and the head is posed by both: R = R(pose keys) . R(bone).

FLAME's joints also follow the expression: a joint moves by d before it turns. There the hidden
bone is moved by d too, and a second one (`jaw.back`) by -d, so that the joint's bone ends at
T(d) . R(pose keys) . R(bone) . T(-d).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:  # it needs torch
    from ..core.head import HeadModel

CONTROL_SUFFIX, BACK_SUFFIX = ".pose", ".back"
_COLLECTION = "Pose keys"  # of bones, hidden
_ORDER = "ZXY"  # R = Ry . Rx . Rz: the turn about the upright is outermost, as in looking round


@dataclass(frozen=True)
class PoseKey:
    """At 1, the key turns each of `joints` by `degrees` about `axis` (0, 1, 2: the core's x, y,
    z); it goes from `lowest` to 1."""

    joints: tuple[str, ...]
    axis: int
    degrees: float
    lowest: float = -1.0


# left is the person's own; turns have the signs of core.head.model
POSE_KEYS = {
    "jaw_open": PoseKey(("jaw",), 0, 30.0, 0.0),
    "jaw_left": PoseKey(("jaw",), 1, 15.0),
    "neck_turn": PoseKey(("neck",), 1, 60.0),
    "neck_nod": PoseKey(("neck",), 0, 40.0),
    "neck_tilt": PoseKey(("neck",), 2, -30.0),
    "eyes_left": PoseKey(("left_eye", "right_eye"), 1, 35.0),
    "eyes_up": PoseKey(("left_eye", "right_eye"), 0, -25.0),
}


def keys_of(head: HeadModel) -> dict[str, PoseKey]:
    """The pose keys that a head can have: it has their joint, and no expression of their name."""
    joints = set(head.joint_names)
    return {
        name: key
        for name, key in POSE_KEYS.items()
        if joints & set(key.joints) and name not in head.expression_names
    }


def helpers(head: HeadModel) -> list[tuple[str, str]]:
    """The hidden bones that a head's rig has: name, and the joint that each stands beside."""
    if head.joints_follow_expression:
        suffixes = (CONTROL_SUFFIX, BACK_SUFFIX)
        return [(joint + suffix, joint) for joint in head.joint_names for suffix in suffixes]
    return [(joint + CONTROL_SUFFIX, joint) for joint in _turned(head)]


def _turned(head: HeadModel) -> list[str]:
    turned = {joint for key in keys_of(head).values() for joint in key.joints}
    return [joint for joint in head.joint_names if joint in turned]


def add_bones(head: HeadModel, armature_data: Any) -> None:
    """Adds, in edit mode, a head's hidden bones beside those of its joints."""
    hidden = armature_data.collections.new(_COLLECTION)
    hidden.is_visible = False
    for name, joint in helpers(head):
        beside = armature_data.edit_bones[joint]
        bone = armature_data.edit_bones.new(name)
        bone.head, bone.tail, bone.roll = beside.head, beside.tail, beside.roll
        bone.parent = beside.parent
        bone.use_deform = False
        hidden.assign(bone)


def connect(head: HeadModel, mesh: Any, armature: Any) -> None:
    """Adds a head's pose keys to its mesh, and lets them, and where a head's joints follow them
    its expressions, move the bones of its armature."""
    keys = keys_of(head)
    for name, key in keys.items():
        block = mesh.shape_key_add(name=name, from_mix=False)
        block.slider_min, block.slider_max, block.value = key.lowest, 1.0, 0.0
    bones = armature.pose.bones
    for joint in _turned(head):
        control = bones[joint + CONTROL_SUFFIX]
        control.rotation_mode = _ORDER
        for name, key in keys.items():
            if joint in key.joints:
                driver = add_driver(control, "rotation_euler", key.axis)
                _read(driver, "value", "KEY", mesh.data.shape_keys, _path(name))
                driver.expression = f"value * {math.radians(key.degrees)!r}"
    for name, joint in helpers(head):
        constraint = bones[joint].constraints.new("COPY_TRANSFORMS")
        constraint.target, constraint.subtarget = armature, name
        constraint.owner_space = constraint.target_space = "LOCAL"
        constraint.mix_mode = "AFTER_FULL" if name.endswith(BACK_SUFFIX) else "BEFORE_FULL"
    if head.joints_follow_expression:
        _follow(head, mesh, armature)


_TERMS = 16  # of a sum: a driver's expression ends at 255 characters


def _follow(head: HeadModel, mesh: Any, armature: Any) -> None:
    """Drives the hidden bones' places by the expressions. A driver holds no sum as long as FLAME's,
    so properties of the armature hold its parts."""
    moves = np.einsum("jv,evx->jxe", head.joint_regressor, head.expression_basis).astype(float)
    for joint, axes in zip(head.joint_names, moves, strict=True):
        for axis, factors in enumerate(axes):
            parts = []
            for start in range(0, len(factors), _TERMS):
                parts.append(f"{joint} moved {'xyz'[axis]}{start // _TERMS}")
                armature[parts[-1]] = 0.0
                driver = add_driver(armature, f'["{parts[-1]}"]')
                terms: list[str] = []
                for name, factor in zip(
                    head.expression_names[start:], factors[start : start + _TERMS], strict=False
                ):
                    variable = f"v{len(terms)}"
                    _read(driver, variable, "KEY", mesh.data.shape_keys, _path(name))
                    terms.append(f"{variable}*{1e6 * factor:.2f}")
                driver.expression = f"({'+'.join(terms)})*1e-6"
            for suffix, sign in ((CONTROL_SUFFIX, ""), (BACK_SUFFIX, "-")):
                bone = armature.pose.bones[joint + suffix]
                driver = add_driver(bone, "location", axis)
                for index, part in enumerate(parts):
                    _read(driver, f"p{index}", "OBJECT", armature, f'["{part}"]')
                driver.expression = f"{sign}({'+'.join(f'p{i}' for i in range(len(parts)))})"


def pose_keys(mesh: Any, armature: Any | None) -> list[str]:
    """Names of a mesh's keys that turn bones of its armature; none in files older than them."""
    animation = armature.animation_data if armature is not None else None
    keys = mesh.data.shape_keys
    if animation is None or keys is None:
        return []
    paths = {
        variable.targets[0].data_path
        for curve in animation.drivers
        if curve.data_path.endswith(f'{CONTROL_SUFFIX}"].rotation_euler')
        for variable in curve.driver.variables
    }
    return [name for name in POSE_KEYS if _path(name) in paths and name in keys.key_blocks]


def _path(name: str) -> str:
    return f'key_blocks["{name}"].value'


def add_driver(owner: Any, path: str, index: int = -1) -> Any:
    """A scripted driver of a property, whose value is the expression's as it is: Blender 5 gives
    its curve two keys, and takes what lies close above the first, at 0, for 0."""
    curve = owner.driver_add(path, index)
    for point in reversed(curve.keyframe_points):
        curve.keyframe_points.remove(point)
    for modifier in reversed(curve.modifiers):
        curve.modifiers.remove(modifier)
    curve.driver.type = "SCRIPTED"
    return curve.driver


def _read(driver: Any, name: str, kind: str, id_: Any, path: str) -> None:
    """Adds a variable to a driver: a property of an ID."""
    variable = driver.variables.new()
    variable.name = name
    target = variable.targets[0]
    target.id_type = kind
    target.id = id_
    target.data_path = path
