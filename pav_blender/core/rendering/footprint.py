"""Which pixels of a picture may show anything of a pose, and how far away: rays beside it are not
followed, and others begin and end where there may be something."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .. import kernels
from ..kernels.structures import Voxels
from .cameras import Camera

_TILE, _GRID = 4, 256  # pixels a side of a tile, at least; tiles a side of a picture, at most


@dataclass(frozen=True, eq=False)
class Footprint:
    """near, far [rows, columns] float32: metres along the rays of each tile of pixels between which
    bricks lie, near > far where none do; tile: its side in pixels."""

    near: np.ndarray
    far: np.ndarray
    tile: int

    def covered(self, height: int, width: int) -> np.ndarray:
        """The pixels [height, width] of tiles that hold anything."""
        some = self.near <= self.far
        return some.repeat(self.tile, 0).repeat(self.tile, 1)[:height, :width]

    def between(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """near and far of pixels [R]."""
        at = rows // self.tile, columns // self.tile
        return self.near[at], self.far[at]


def footprint(voxels: Voxels, camera: Camera, start: float = 0.0) -> Footprint:
    """Where a camera sees the balls about bricks; everything, where a brick is about the camera.

    start: metres along the rays from which near and far are counted.
    """
    tile = max(_TILE, -(-max(camera.height, camera.width) // _GRID))
    shape = -(-camera.height // tile), -(-camera.width // tile)
    held = np.argwhere(voxels.bricks.numpy() >= 0)
    middles = voxels.box_min.numpy() + (held + 0.5) / voxels.scale
    back = np.linalg.inv(camera.camera_to_world[:3, :3])  # a rotation from a file is a rounded one
    radius = np.sqrt(3) / 2 / voxels.scale * np.linalg.norm(back, 2)
    local = (middles - camera.origin) @ back.T
    if camera.parallel:
        along, spread = local[:, 2], np.full((len(local), 2), radius)
    else:
        local = local[local[:, 2] > -radius]
        depth, along = local[:, 2:], np.sqrt(np.einsum("ij,ij->i", local, local))
        if not (depth > 2 * radius).all():
            return Footprint(np.zeros(shape, np.float32), np.full(shape, np.inf, np.float32), tile)
        local = local / depth
        # how far off the middle of a ball its outline may lie in the plane at a distance of one
        spread = radius * (1 + np.abs(local[:, :2])) / (depth - radius)
    (fx, skew, cx), (_, fy, cy), _ = camera.intrinsics
    middle = np.stack([fx * local[:, 0] + skew * local[:, 1] + cx, fy * local[:, 1] + cy], 1)
    spread = np.stack([fx * spread[:, 0] + abs(skew) * spread[:, 1], fy * spread[:, 1]], 1)
    most = np.array(shape[::-1])
    low = np.floor((middle - spread) / tile).clip(0, most).astype(np.int64)
    high = (np.floor((middle + spread) / tile) + 1).clip(low, most).astype(np.int64)
    reach = radius * 1.001  # and a little for the rounding of rays
    corners, along = np.concatenate([low, high], 1), along - start
    cover = kernels.select("cpu").sparing.cover
    near, far = cover(corners, along - reach, along + reach, shape)
    return Footprint(near, far, tile)
