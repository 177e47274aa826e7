"""A pinhole or parallel camera: intrinsics in pixels, camera-to-world with OpenCV axes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..errors import InputError

_RIGID = 0.1  # how far a rotation may be off: files hold rounded ones


@dataclass(frozen=True, eq=False)
class Camera:
    """width, height in pixels; intrinsics [3, 3]; camera_to_world [4, 4], metres.

    x right, y down, z forward; the centre of the first pixel is at (0.5, 0.5). A `parallel` camera
    (orthographic) has pixels a metre in place of focal lengths, and rays that begin in its plane.
    Raises InputError for values that are not finite or do not make a camera.
    """

    width: int
    height: int
    intrinsics: np.ndarray
    camera_to_world: np.ndarray
    parallel: bool = False

    def __post_init__(self) -> None:
        intrinsics = np.asarray(self.intrinsics, np.float64)
        pose = np.asarray(self.camera_to_world, np.float64)
        if intrinsics.shape != (3, 3) or pose.shape != (4, 4):
            raise InputError(
                f"camera: intrinsics {intrinsics.shape} and camera_to_world {pose.shape}; "
                "expected (3, 3) and (4, 4)"
            )
        if not (np.isfinite(intrinsics).all() and np.isfinite(pose).all()):
            raise InputError("camera: a value is not finite")
        if intrinsics[0, 0] <= 0 or intrinsics[1, 1] <= 0:
            raise InputError("camera: the focal lengths must be positive")
        if self.width < 1 or self.height < 1:
            raise InputError(f"camera: a picture of {self.width}x{self.height} pixels")
        turn = pose[:3, :3]
        if np.abs(turn.T @ turn - np.eye(3)).max() > _RIGID:
            raise InputError("camera: camera_to_world does not turn rigidly; it must not scale")
        object.__setattr__(self, "intrinsics", intrinsics)
        object.__setattr__(self, "camera_to_world", pose)

    @property
    def origin(self) -> np.ndarray:
        """The camera's centre in the world, [3]."""
        return self.camera_to_world[:3, 3]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World points [N, 3] -> pixels [N, 2] and depth along the camera's z [N], float64."""
        local = (np.asarray(points, np.float64) - self.origin) @ self.camera_to_world[:3, :3]
        depth = local[:, 2].copy()
        if self.parallel:
            local[:, 2] = 1.0
        safe = np.where(np.abs(local[:, 2]) < 1e-12, 1e-12, local[:, 2])
        homogeneous = local @ self.intrinsics.T
        return homogeneous[:, :2] / safe[:, None], depth

    def rays(
        self, x: np.ndarray, y: np.ndarray, start: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixel columns and rows [N] (integers: their centres) -> origins, `start` metres along,
        and unit directions [N, 3] in the world and the cosine to the camera's axis [N] (depth =
        distance * cosine), float32."""
        (fx, skew, cx), (_, fy, cy), _ = self.intrinsics
        v = (np.asarray(y, np.float64) + 0.5 - cy) / fy
        u = (np.asarray(x, np.float64) + 0.5 - cx - skew * v) / fx
        turn, ones = self.camera_to_world[:3, :3], np.ones_like(u)
        if self.parallel:
            length, world = ones, np.tile(turn[:, 2:], len(u))
            origins = self.origin[:, None] + turn[:, :2] @ np.stack([u, v])
        else:
            length = np.sqrt(u * u + v * v + 1)
            world = turn @ np.stack([u, v, ones]) / length
            origins = np.tile(self.origin[:, None], len(u))
        if start:
            origins = origins + start * world
        found = (np.ascontiguousarray(values.T, np.float32) for values in (origins, world))
        return *found, (1 / length).astype(np.float32)

    def resized(self, width: int, height: int) -> Camera:
        """The same view with another number of pixels."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return replace(self, width=width, height=height, intrinsics=scale @ self.intrinsics)

    def moved(self, shift: np.ndarray) -> Camera:
        """The camera carried off by `shift` [3], metres."""
        pose = self.camera_to_world.copy()
        pose[:3, 3] += shift
        return replace(self, camera_to_world=pose)

    def window(self, x0: int, y0: int, x1: int, y1: int) -> Camera:
        """The camera of the pixels [x0, x1) x [y0, y1), top-left origin."""
        intrinsics = self.intrinsics.copy()
        intrinsics[:2, 2] -= (x0, y0)
        return replace(self, width=x1 - x0, height=y1 - y0, intrinsics=intrinsics)
