"""What a 3D view looks at: its camera in core axes, and the part of it that is drawn."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core.rendering.cameras import Camera
from .axes import camera_to_core
from .lens import from_projection

PARALLEL_DISTANCE = 100.0  # metres behind where a parallel view is said to be: it sees that too

Rectangle = tuple[int, int, int, int]


def view_camera(region: Any, region_data: Any) -> Camera:
    """The camera of a 3D view in core axes, with its zoom, offset and shift."""
    matrix = np.array(region_data.view_matrix.inverted())
    projection = np.array(region_data.window_matrix)
    width, height = region.width, region.height
    if region_data.is_perspective or abs(projection[3, 2] + 1) < 1e-6:
        intrinsics = from_projection(projection, width, height)
        return Camera(width, height, intrinsics, camera_to_core(matrix))
    intrinsics = np.array(
        [
            [projection[0, 0] * width / 2, 0, (1 + projection[0, 3]) * width / 2],
            [0, projection[1, 1] * height / 2, (1 - projection[1, 3]) * height / 2],
            [0, 0, 1],
        ]
    )
    matrix[:3, 3] += matrix[:3, 2] * PARALLEL_DISTANCE
    return Camera(width, height, intrinsics, camera_to_core(matrix), parallel=True)


def view_border(region: Any, region_data: Any, space: Any, scene: Any) -> Rectangle:
    """The pixels (x0, y0, x1, y1) of a 3D view that are drawn, top-left origin: all of them, or
    those in the render border, which in the camera's view is a part of the camera's frame."""
    whole = 0, 0, region.width, region.height
    if region_data.view_perspective == "CAMERA":
        if not scene.render.use_border or space.camera is None:
            return whole
        frame = _camera_frame(region, region_data, space.camera, scene)
        source = scene.render
        share = source.border_min_x, source.border_min_y, source.border_max_x, source.border_max_y
    else:
        if not space.use_render_border:
            return whole
        frame = (0.0, 0.0, float(region.width), float(region.height))
        source = space
        share = (
            source.render_border_min_x,
            source.render_border_min_y,
            source.render_border_max_x,
            source.render_border_max_y,
        )
    left, low, right, high = frame
    x0 = round(left + share[0] * (right - left))
    x1 = round(left + share[2] * (right - left))
    y0 = round(region.height - (low + share[3] * (high - low)))
    y1 = round(region.height - (low + share[1] * (high - low)))
    x0, x1 = max(x0, 0), min(x1, region.width)
    y0, y1 = max(y0, 0), min(y1, region.height)
    return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else (0, 0, 0, 0)


def _camera_frame(
    region: Any, region_data: Any, camera: Any, scene: Any
) -> tuple[float, float, float, float]:
    """Left, bottom, right and top of the camera's frame in a 3D view's pixels, from its bottom."""
    matrix = np.array(camera.matrix_world.normalized())
    corners = np.array([[*corner, 1.0] for corner in camera.data.view_frame(scene=scene)])
    clip = corners @ (np.array(region_data.perspective_matrix) @ matrix).T
    x = (clip[:, 0] / clip[:, 3] + 1) / 2 * region.width
    y = (clip[:, 1] / clip[:, 3] + 1) / 2 * region.height
    return float(x.min()), float(y.min()), float(x.max()), float(y.max())
