"""Cameras round a head, and the field's pictures in them."""

from __future__ import annotations

import numpy as np

from ..rendering.cameras import Camera
from ..rendering.rays import camera_rays, tiled
from ..rendering.render import RenderSettings, Scene, trace_rays

_DISTANCE = 1.5  # metres from the head's middle: about what heads are filmed from


def camera_at(middle: np.ndarray, yaw: float, pitch: float, radius: float, size: int) -> Camera:
    """A camera that looks at `middle` [3] and has a ball of `radius` metres about it in its square
    picture. Radians: yaw to the head's left, pitch from above; 0, 0 looks into its face."""
    sine, cosine = np.sin([yaw, pitch]), np.cos([yaw, pitch])
    forward = -np.array([sine[0] * cosine[1], sine[1], cosine[0] * cosine[1]])
    right = np.array([cosine[0], 0.0, -sine[0]])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = middle - _DISTANCE * forward
    focal = size / 2 * np.sqrt(_DISTANCE**2 - radius**2) / radius
    lens = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return Camera(size, size, lens, pose)


def field_picture(
    scene: Scene, camera: Camera, settings: RenderSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Straight sRGB with alpha [H, W, 4] and depth along the camera's axis [H, W]."""
    pixels = tiled(camera.width, camera.height)
    rays = camera_rays(camera, pixels % camera.width, pixels // camera.width)
    colours, distances = trace_rays(scene, rays, settings)
    rgba = np.empty((camera.height * camera.width, 4), np.float32)
    depth = np.empty(len(rgba), np.float32)
    rgba[pixels], depth[pixels] = colours, distances
    shape = (camera.height, camera.width)
    return rgba.reshape(*shape, 4), depth.reshape(shape)
