"""A track as keyframes: expressions on shape keys, poses on bones, the camera's lens and place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core.errors import InputError
from .axes import camera_to_blender
from .lens import Lens
from .pose_keys import pose_keys
from .rig import KEY_LIMIT


@dataclass(frozen=True, eq=False)
class Motion:
    """F tracked frames: expression [F, E], pose [F, J, 3] axis-angle, translation [F, 3] metres,
    and the scene frame of each [F], rising."""

    expression: np.ndarray
    pose: np.ndarray
    translation: np.ndarray
    frames: np.ndarray


def apply_motion(
    mesh: Any,
    armature: Any,
    expression_names: tuple[str, ...],
    joint_names: tuple[str, ...],
    motion: Motion,
) -> None:
    """Replaces the animation of a head's shape keys and bones by `motion`; pose keys rest at 0."""
    keys = mesh.data.shape_keys
    largest = float(np.abs(motion.expression).max(initial=0.0))
    if largest > KEY_LIMIT:
        raise InputError(
            f"an expression coefficient of {largest:.1f}; Blender's shape keys end at "
            f"{KEY_LIMIT:g}: scale the track"
        )
    # a new action; a driver of a corrective key stays where it is
    _forget_action(keys)
    for name in pose_keys(mesh, armature):
        keys.key_blocks[name].value = 0.0
    for name, values in zip(expression_names, motion.expression.T, strict=True):
        _key(keys.key_blocks[name], "value", motion.frames, values[:, None])
    _forget_action(armature)
    for index, name in enumerate(joint_names):
        bone = armature.pose.bones[name]
        bone.rotation_mode = "QUATERNION"
        quaternions = to_quaternions(motion.pose[:, index])
        _key(bone, "rotation_quaternion", motion.frames, quaternions)
    _key(armature.pose.bones[joint_names[0]], "location", motion.frames, motion.translation)


def apply_camera(
    camera: Any, frames: np.ndarray, camera_to_world: np.ndarray, lenses: list[Lens]
) -> None:
    """Keys a camera object: camera_to_world [F, 4, 4] (core) and a lens a frame."""
    _forget_action(camera)
    _forget_action(camera.data)
    matrices = np.stack([camera_to_blender(matrix) for matrix in camera_to_world])
    camera.rotation_mode = "QUATERNION"
    _key(camera, "location", frames, matrices[:, :3, 3])
    _key(camera, "rotation_quaternion", frames, _continuous(_matrix_quaternions(matrices)))
    for field in ("lens", "shift_x", "shift_y"):
        values = np.array([[getattr(lens, field)] for lens in lenses])
        _key(camera.data, field, frames, values)


def to_quaternions(axis_angles: np.ndarray) -> np.ndarray:
    """[F, 3] axis-angle -> [F, 4] unit quaternions (w, x, y, z) without jumps of sign."""
    axis_angles = np.asarray(axis_angles, np.float64)
    angle = np.linalg.norm(axis_angles, axis=1, keepdims=True)
    # sin(a/2)/a is sinc, which has no hole at zero
    factor = 0.5 * np.sinc(angle / (2 * np.pi))
    return _continuous(np.concatenate([np.cos(angle / 2), axis_angles * factor], axis=1))


def _continuous(quaternions: np.ndarray) -> np.ndarray:
    """Negates quaternions so that neighbours lie in one half sphere and interpolate shortly."""
    dots = np.sum(quaternions[1:] * quaternions[:-1], axis=1)
    signs = np.cumprod(np.concatenate([[1.0], np.where(dots < 0, -1.0, 1.0)]))
    return quaternions * signs[:, None]


def _matrix_quaternions(matrices: np.ndarray) -> np.ndarray:
    from mathutils import Matrix

    return np.array([Matrix(matrix[:3, :3]).to_quaternion()[:] for matrix in matrices])


def _forget_action(id_: Any) -> None:
    if id_.animation_data is not None:
        id_.animation_data.action = None


def _key(owner: Any, path: str, frames: np.ndarray, values: np.ndarray) -> None:
    """Keys property `path` with values [F, C], linear between frames; a channel that never
    changes gets one key."""
    constant = bool((values == values[0]).all())
    if constant:
        frames, values = frames[:1], values[:1]
    first = values[0].tolist()
    setattr(owner, path, first if len(first) > 1 else first[0])
    owner.keyframe_insert(path, frame=float(frames[0]))
    id_ = owner.id_data
    full_path = path if owner == id_ else owner.path_from_id(path)
    for channel, column in enumerate(values.T):
        curve = _find_curve(id_, full_path, channel)
        points = curve.keyframe_points
        points.add(len(frames) - len(points))
        flat = np.stack([frames, column], axis=1).astype(np.float32).ravel()
        points.foreach_set("co", flat)
        for point in points:
            point.interpolation = "LINEAR"
        curve.update()


def curves(id_: Any) -> Any:
    """F-curves of an ID's action, in the layered actions of 4.4+ and in the flat ones before."""
    action = id_.animation_data.action
    slot = getattr(id_.animation_data, "action_slot", None)
    if slot is None:
        return action.fcurves
    return action.layers[0].strips[0].channelbag(slot).fcurves


def _find_curve(id_: Any, path: str, channel: int) -> Any:
    curve = curves(id_).find(path, index=channel)
    assert curve is not None, f"keyframe_insert made no curve for {path}[{channel}]"
    return curve
