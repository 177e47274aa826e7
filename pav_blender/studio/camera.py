"""Blender's camera from a core camera."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix

SENSOR = 36.0  # millimetres across


def camera_object():
    data = bpy.data.cameras.new("studio camera")
    data.sensor_fit, data.sensor_width = "HORIZONTAL", SENSOR
    data.clip_start, data.clip_end = 0.05, 20.0
    return bpy.data.objects.new("studio camera", data)


def aim_camera(item, intrinsics: np.ndarray, camera_to_world: np.ndarray, size: int) -> None:
    """Square pixels; the principal point becomes the lens shift."""
    data = item.data
    data.lens = float(intrinsics[0, 0]) * SENSOR / size
    data.shift_x = 0.5 - float(intrinsics[0, 2]) / size
    data.shift_y = float(intrinsics[1, 2]) / size - 0.5
    world = np.array(camera_to_world, float)
    world[:, 1:3] *= -1  # OpenCV looks along +z with y down, Blender along -z with y up
    item.matrix_world = Matrix(world.tolist())


def look_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """camera_to_world [4,4] (OpenCV axes) at `position`, upright, looking at `target`."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    out = np.eye(4)
    out[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    out[:3, 3] = position
    return out


def intrinsics_of(focal: float, size: int) -> np.ndarray:
    return np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
