"""Intrinsics in pixels <-> Blender's lens, sensor, shift, pixel aspect and resolution.

Blender's rule (its camera_params code): the sensor's fitted side spans the picture's fitted side,
whose length is counted in widths of a pixel; shifts are fractions of that length.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core.errors import InputError

MAX_PIXEL_ASPECT = 200.0  # Blender's own limits
MIN_LENS = 1.0


@dataclass(frozen=True)
class Lens:
    """What Blender's camera data and render settings say about a perspective picture.

    lens and sensor sizes in millimetres; width, height in pixels after the resolution percentage.
    """

    width: int
    height: int
    lens: float
    shift_x: float = 0.0
    shift_y: float = 0.0
    sensor_width: float = 36.0
    sensor_height: float = 24.0
    sensor_fit: str = "AUTO"
    aspect_x: float = 1.0
    aspect_y: float = 1.0

    @property
    def fit(self) -> tuple[float, float]:
        """Size of the fitted sensor side in mm, and the length it spans in widths of a pixel."""
        horizontal = self.sensor_fit == "HORIZONTAL" or (
            self.sensor_fit == "AUTO" and self.width * self.aspect_x >= self.height * self.aspect_y
        )
        sensor = self.sensor_height if self.sensor_fit == "VERTICAL" else self.sensor_width
        span = self.width if horizontal else self.height * self.aspect_y / self.aspect_x
        return sensor, float(span)


def frame_size(render: Any) -> tuple[int, int]:
    """Pixels of the picture that `render` settings ask for, truncated as Blender does."""
    percentage = render.resolution_percentage
    return (
        max(1, render.resolution_x * percentage // 100),
        max(1, render.resolution_y * percentage // 100),
    )


def read_lens(camera: Any, render: Any) -> Lens:
    """The lens of Blender camera data under `render` settings; InputError if not perspective."""
    if camera.type != "PERSP":
        raise InputError(
            f"camera {camera.name!r} is of type {camera.type}; PAV renders perspective cameras"
        )
    width, height = frame_size(render)
    return Lens(
        width,
        height,
        camera.lens,
        camera.shift_x,
        camera.shift_y,
        camera.sensor_width,
        camera.sensor_height,
        camera.sensor_fit,
        render.pixel_aspect_x,
        render.pixel_aspect_y,
    )


def to_intrinsics(lens: Lens) -> np.ndarray:
    """[3, 3] float64, pixels, y down."""
    sensor, span = lens.fit
    aspect = lens.aspect_y / lens.aspect_x
    focal = lens.lens / sensor * span
    return np.array(
        [
            [focal, 0.0, lens.width / 2 - lens.shift_x * span],
            [0.0, focal / aspect, lens.height / 2 + lens.shift_y * span / aspect],
            [0.0, 0.0, 1.0],
        ]
    )


def from_intrinsics(
    intrinsics: np.ndarray,
    width: int,
    height: int,
    *,
    sensor_fit: str = "AUTO",
    sensor_width: float = 36.0,
    sensor_height: float = 24.0,
) -> Lens:
    """The lens that gives `intrinsics` [3, 3] on width x height pixels.

    Raises InputError where Blender has no such camera (skew, extreme focal lengths).
    """
    matrix = np.asarray(intrinsics, np.float64)
    focal_x, focal_y = matrix[0, 0], matrix[1, 1]
    if abs(matrix[0, 1]) > 1e-6 * focal_x:
        raise InputError(
            f"the intrinsics have a skew of {matrix[0, 1]:g} pixels; Blender's camera has none"
        )
    ratio = focal_x / focal_y
    if abs(ratio - 1) < 1e-6:
        ratio = 1.0
    aspect_x, aspect_y = (1.0, ratio) if ratio >= 1 else (1 / ratio, 1.0)
    if max(aspect_x, aspect_y) > MAX_PIXEL_ASPECT:
        raise InputError(f"focal lengths {focal_x:g} and {focal_y:g} make no usable pixel aspect")
    frame = Lens(
        width,
        height,
        0.0,
        sensor_width=sensor_width,
        sensor_height=sensor_height,
        sensor_fit=sensor_fit,
        aspect_x=aspect_x,
        aspect_y=aspect_y,
    )
    sensor, span = frame.fit
    lens = focal_x * sensor / span
    if lens < MIN_LENS:
        raise InputError(
            f"a focal length of {focal_x:g} pixels on {width}x{height} is wider than Blender allows"
        )
    return Lens(
        width,
        height,
        lens,
        shift_x=(width / 2 - matrix[0, 2]) / span,
        shift_y=(matrix[1, 2] - height / 2) * ratio / span,
        sensor_width=sensor_width,
        sensor_height=sensor_height,
        sensor_fit=sensor_fit,
        aspect_x=aspect_x,
        aspect_y=aspect_y,
    )


def from_projection(projection: np.ndarray, width: int, height: int) -> np.ndarray:
    """Intrinsics [3, 3] of an OpenGL projection matrix [4, 4] (as `calc_matrix_camera` gives)."""
    if abs(projection[3, 2] + 1) > 1e-6:
        raise InputError("the camera is not a perspective one; PAV renders perspective cameras")
    return np.array(
        [
            [projection[0, 0] * width / 2, 0.0, (1 - projection[0, 2]) * width / 2],
            [0.0, projection[1, 1] * height / 2, (1 + projection[1, 2]) * height / 2],
            [0.0, 0.0, 1.0],
        ]
    )
