"""Where the field may be: the visual hull of each appearance, carved in canonical space.

Long hair stands ten centimetres off the mesh and a bald forehead nothing, so no one band round
the mesh would do. A canonical cell stays if, carried by the tracked mesh into the training frames
of an appearance, it falls inside the mattes.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage

from ..deformation import Deformer, canonicalise
from ..kernels.structures import PosedMesh
from .frames import Frame

_MISSES = 0.12  # part of the pictures that may disagree: mattes and tracks are not exact
_INSIDE = 0.010  # metres below the skin where nothing is ever seen
_SOFTNESS = 2  # pixels the mattes are grown by
_LARGEST_STRETCH = 3.0


def hull_box(
    canonical: np.ndarray, triangles: np.ndarray, frames: list[Frame], reach: float
) -> tuple[np.ndarray, float]:
    """Corner [3] and side, metres, of the cube that holds what the pictures show of the head.

    Shoulders that no camera sees need no cells.
    """
    low, high = canonical.min(0) - reach, canonical.max(0) + reach
    cells = 48
    size = float((high - low).max())
    corner = (low + high) / 2 - size / 2
    kept = carve(canonical, triangles, frames, reach, corner, size, cells)
    if not kept.any():
        return corner.astype(np.float32), size
    found = np.argwhere(kept)
    margin = 1.0  # a cell each way, since cells here are coarse
    low = corner + (found.min(0) - margin) * size / cells
    high = corner + (found.max(0) + 1 + margin) * size / cells
    size = float((high - low).max())
    return ((low + high) / 2 - size / 2).astype(np.float32), size


def carve(
    canonical: np.ndarray,
    triangles: np.ndarray,
    frames: list[Frame],
    reach: float,
    box_min: np.ndarray,
    box_size: float,
    cells: int,
    *,
    most_frames: int = 32,
) -> np.ndarray:
    """Cells [G, G, G] bool that the mattes of `frames` (one appearance) leave.

    A cell that no frame has in its picture goes too: nothing there could be learned.
    """
    side = box_size / cells
    centres = (np.indices((cells,) * 3).reshape(3, -1).T + 0.5) * side + box_min
    points = torch.from_numpy(centres.astype(np.float32))
    rest = Deformer(canonical, triangles, "affine")
    near, triangle, barycentric = _band(rest, canonical, triangles, points, reach + side)
    chosen = frames[:: max(1, len(frames) // most_frames)]
    seen = np.zeros(len(near), np.int32)
    missed = np.zeros(len(near), np.int32)
    for frame in chosen:
        posed = _carry(canonical, frame.vertices, rest, points[near], triangle, barycentric)
        _count(frame, posed, side, seen, missed)
    kept = np.zeros(cells**3, bool)
    kept[near.numpy()] = (seen > 0) & (missed <= _MISSES * seen)
    return ndimage.binary_dilation(kept.reshape((cells,) * 3))


def _band(
    rest: Deformer,
    canonical: np.ndarray,
    triangles: np.ndarray,
    points: torch.Tensor,
    reach: float,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rows of the points near the mesh and not deep inside it, their triangle and barycentrics."""
    mesh = rest.pose(canonical)
    triangle, barycentric, distance = rest.nearest(mesh, points)
    corners = canonical[triangles[triangle.numpy()]].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    foot = (corners * barycentric.numpy()[:, :, None]).sum(1)
    inside = ((points.numpy() - foot) * normal).sum(1) < 0
    far = distance.numpy() > np.where(inside, _INSIDE, reach)
    near = torch.from_numpy(np.flatnonzero(~far))
    return near, triangle[near], barycentric[near]


def _carry(
    canonical: np.ndarray,
    vertices: np.ndarray,
    rest: Deformer,
    points: torch.Tensor,
    triangle: torch.Tensor,
    barycentric: torch.Tensor,
) -> np.ndarray:
    """Canonical points into a pose: the canonicalisation with the two meshes changed over."""
    back = Deformer(vertices, rest.triangles, "affine")
    mesh: PosedMesh = back.pose(canonical)
    moved = canonicalise(points, triangle, barycentric, mesh).numpy()
    # a nearly flat triangle may throw points far off: those say nothing
    foot = (
        vertices[rest.triangles.numpy()[triangle.numpy()]] * barycentric.numpy()[:, :, None]
    ).sum(1)
    rest_foot = (
        canonical[rest.triangles.numpy()[triangle.numpy()]] * barycentric.numpy()[:, :, None]
    ).sum(1)
    reach = np.linalg.norm(moved - foot, axis=1)
    before = np.linalg.norm(points.numpy() - rest_foot, axis=1)
    moved[reach > _LARGEST_STRETCH * before + 1e-3] = np.nan
    return moved


def _count(
    frame: Frame, posed: np.ndarray, side: float, seen: np.ndarray, missed: np.ndarray
) -> None:
    camera = frame.camera
    pixels, depth = camera.project(np.nan_to_num(posed))
    good = np.isfinite(posed).all(1) & (depth > 0.02)
    column = np.floor(np.where(good, pixels[:, 0], -1)).astype(np.int64)
    row = np.floor(np.where(good, pixels[:, 1], -1)).astype(np.int64)
    good &= (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    # a cell's own half diagonal, as it appears, so that thin things between centres stay
    typical = float(np.median(depth[good])) if good.any() else 1.0
    radius = _SOFTNESS + round(0.87 * side * camera.intrinsics[0, 0] / typical)
    matte = ndimage.maximum_filter(frame.rgba[..., 3], 2 * radius + 1) > 8
    rows = np.flatnonzero(good)
    seen[rows] += 1
    missed[rows] += ~matte[row[rows], column[rows]]
