"""Where the field may be: the visual hull of each appearance, carved in canonical space.

Long hair stands ten centimetres off the mesh and a bald forehead nothing, so no one band round
the mesh would do. A canonical cell stays if, carried by the tracked mesh into the training frames
of an appearance, it falls inside the mattes. Where pictures end the person does not: beyond what
they show, cells near the mesh stay, for another pose or camera brings them in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import cKDTree

from ..deformation import Deformer, triangle_maps
from ..rendering.rasterise import rasterise
from .frames import Frame

_MISSES = 0.3  # part of the pictures that may disagree: mattes and tracks are not exact
_INSIDE = 0.010  # metres below the skin where nothing is ever seen
_REACH = {  # metres; regions that are not named may be covered by long hair
    "torso": 0.08,
    "face": 0.035,
    "lips": 0.03,
    "left_eye_region": 0.035,
    "right_eye_region": 0.035,
    "eyeballs": 0.03,
    "mouth_interior": 0.02,
}
_OUTLINES = 16  # frames an appearance in which the outline is measured
_NEARBY = 0.05  # metres along which what an outline tells holds
_MARGIN = 0.008
_SOFTNESS = 2  # pixels the mattes are grown by
_LARGEST_STRETCH = 3.0
UNSEEN_REACH = 0.015  # metres from the mesh within which cells that nothing shows stay
_BEYOND = 0.04  # metres from what pictures show within which they stay where pictures end


def reach_of(
    canonical: np.ndarray,
    triangles: np.ndarray,
    regions: dict[str, np.ndarray],
    frames: list[Frame],
    farthest: float,
) -> np.ndarray:
    """Metres from each vertex [V] that an appearance may stand off the mesh.

    Measured where the mesh's outline shows: how far the matte goes beyond it. Vertices near an
    outline take what was seen there, others what was seen most anywhere on hair. Beards and glasses
    keep to the face and clothes to the torso, for what lies before those no matte can tell.
    """
    seen = np.full(len(canonical), -1.0, np.float32)
    for frame in frames[:: max(1, -(-len(frames) // _OUTLINES))]:
        _outline(frame, triangles, seen)
    known = np.flatnonzero(seen >= 0)
    limit = np.full(len(canonical), farthest, np.float32)
    for name, distance in _REACH.items():
        if name in regions:
            limit[regions[name]] = min(distance, farthest)
    if len(known) == 0:
        return limit
    tree = cKDTree(canonical[known])
    found = tree.query_ball_point(canonical, _NEARBY)
    free = known[limit[known] == farthest]
    rest = seen[free].max() if len(free) else seen[known].max()
    reach = np.array([seen[known[near]].max() if near else rest for near in found], np.float32)
    return np.minimum(reach + _MARGIN, limit)


def _outline(frame: Frame, triangles: np.ndarray, seen: np.ndarray) -> None:
    """Raises `seen` [V] at the mesh's outline to how far the matte goes beyond it, metres."""
    depth, triangle, _ = rasterise(frame.vertices, triangles, frame.camera)
    covered = triangle >= 0
    if not covered.any():
        return
    inner = covered & ~ndimage.binary_erosion(covered, border_value=1)
    np.maximum.at(seen, triangles[triangle[inner]].reshape(-1), 0.0)
    pixels, at = ndimage.distance_transform_edt(~covered, return_indices=True)
    beyond = ~covered & (frame.rgba[..., 3] > 64)
    foot = at[0][beyond], at[1][beyond]
    metres = pixels[beyond] * depth[foot] / frame.camera.intrinsics[0, 0]
    for corner in range(3):
        np.maximum.at(seen, triangles[triangle[foot], corner], metres.astype(np.float32))


def _centres(cells: int, box_min: np.ndarray, box_size: float) -> np.ndarray:
    grid = np.indices((cells,) * 3).reshape(3, -1).T
    return ((grid + 0.5) * (box_size / cells) + box_min).astype(np.float32)


def hull_box(
    canonical: np.ndarray, triangles: np.ndarray, frames: list[Frame], reach: np.ndarray
) -> tuple[np.ndarray, float]:
    """Corner [3] and side, metres, of the cube that holds what `carve` leaves: shoulders far below
    the pictures need no cells."""
    low, high = canonical.min(0) - reach.max(), canonical.max(0) + reach.max()
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
    reach: np.ndarray,
    box_min: np.ndarray,
    box_size: float,
    cells: int,
    *,
    most_frames: int = 24,
) -> np.ndarray:
    """Cells [G, G, G] bool that the mattes of `frames` (one appearance) leave.

    reach [V]: metres from each vertex that anything may be.

    A cell that no frame has in its picture stays near the mesh and near what is seen: the field
    goes on there as it was begun, in the colours of what is beside it. Farther off it goes.
    """
    side = box_size / cells
    band = _band(canonical, triangles, _centres(cells, box_min, box_size), reach + side / 2)
    chosen = frames[:: max(1, -(-len(frames) // most_frames))]
    seen = np.zeros(len(band.row), np.int32)
    missed = np.zeros(len(band.row), np.int32)
    for frame in chosen:
        _count(frame, _carry(canonical, frame, triangles, band), side, seen, missed)
    kept = np.zeros((cells,) * 3, bool)
    kept.flat[band.row] = (seen > 0) & (missed <= _MISSES * seen)
    if kept.any():
        unseen = band.row[(seen == 0) & (band.distance <= UNSEEN_REACH + side / 2)]
        apart = ndimage.distance_transform_edt(~kept, sampling=side)
        kept.flat[unseen[apart.flat[unseen] <= _BEYOND]] = True
    return kept


@dataclass(eq=False)
class _Band:
    """Cells near the mesh and not deep inside it: flat row, centre, nearest triangle, metres from
    that."""

    row: np.ndarray
    points: np.ndarray
    triangle: np.ndarray
    distance: np.ndarray


def _band(
    canonical: np.ndarray, triangles: np.ndarray, points: np.ndarray, reach: np.ndarray
) -> _Band:
    deformer = Deformer(canonical, triangles, "affine")
    nearest = deformer.nearest(deformer.pose(canonical), torch.from_numpy(points))
    triangle, barycentric, distance = (values.numpy() for values in nearest)
    corners = canonical[triangles[triangle]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    foot = (corners * barycentric[:, :, None]).sum(1)
    inside = ((points - foot) * normal).sum(1) < 0
    allowed = (reach[triangles[triangle]] * barycentric).sum(1)
    row = np.flatnonzero(distance <= np.where(inside, _INSIDE, allowed))
    return _Band(row, points[row], triangle[row], distance[row])


def _carry(canonical: np.ndarray, frame: Frame, triangles: np.ndarray, band: _Band) -> np.ndarray:
    """Canonical points into a frame's pose: the canonicalisation with the meshes changed over.

    nan where a nearly flat triangle throws a point far off: that says nothing.
    """
    maps = triangle_maps(
        torch.from_numpy(frame.vertices),
        torch.from_numpy(canonical),
        torch.tensor(triangles),
        "affine",
    ).numpy()
    scale = np.linalg.norm(maps[:, :, :3], axis=1).max(1)
    maps[scale > _LARGEST_STRETCH] = np.nan
    chosen = maps[band.triangle]
    return np.einsum("nij,nj->ni", chosen[:, :, :3], band.points) + chosen[:, :, 3]


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
