"""The surface that a field shows, as a mesh.

The field's depth is looked at from all round and averaged into a grid of signed distances (Curless
and Levoy 1996, "A volumetric method for building complex models from range images"), of which
marching cubes take the zero. That gives what pictures show: hair that stands ten centimetres off
the tracked mesh is there, what lies inside the head is not, and fog that is seen through is not.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ..errors import InputError, PavError
from ..head.geometry import vertex_normals
from ..progress import Report
from ..rendering.cameras import Camera
from ..rendering.rays import RayBatch
from ..rendering.render import RenderSettings, Scene, trace_rays
from .views import camera_at, field_picture

# rays end where this is left: hair is seen where it begins, not at its mean depth, and fog that
# leaves more is no surface
_LEFT = 0.7
_SOLID = 1 - _LEFT
_PITCHES = (-35, -5, 25, 60)  # degrees, each a ring of cameras
_RING = 8
_PIXELS = 448
_CUT = 3.2  # spacings behind a surface that a picture still tells of
_CRUMB = 0.01  # of the largest piece: smaller ones are left out
_OUTSIDE = 0.005  # metres before the surface where it is looked for again
_SETTLING = 2
_BLUR = 1.0  # spacings: strands and noise thinner than these become one surface
_RIM = 0.0015  # metres: a soft outline shows further out than the same softness seen straight on
_NOTHING = "the avatar has no opaque part in this appearance; there is nothing to bake"
_SMOOTHING = 8  # steps; each shrinks and swells again (Taubin 1995)


def surface(
    scene: Scene, spacing: float, triangles: int, *, progress: Report | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and about so many triangles [T, 3] of what the field shows, metres.

    spacing: metres between the places of the grid. Raises InputError where nothing is opaque,
    PavError where a package is missing.
    """
    try:
        import fast_simplification
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise PavError(
            f"baking needs {error.name}: pip install scikit-image fast-simplification"
        ) from error
    corner, held = _lattice(scene, spacing)
    if not held.any():
        raise InputError(_NOTHING)
    places = np.argwhere(held)
    points = (corner + places * spacing).astype(np.float32)
    distance, looks = _fuse(scene, points, _CUT * spacing, progress)
    grid = np.zeros(held.shape, np.float32)
    # what no picture ever saw before the surface lies behind it: without this, holes
    grid[held] = np.where(looks > 0, distance, -1)
    share = ndimage.gaussian_filter(held.astype(np.float32), _BLUR)
    grid = ndimage.gaussian_filter(grid, _BLUR) / np.maximum(share, 1e-6)
    if not (grid[held] < 0).any() or not (grid[held] > 0).any():
        raise InputError(_NOTHING)
    vertices, faces, _, _ = marching_cubes(grid, 0.0, mask=held)
    vertices, faces = _large_pieces(vertices * spacing + corner, faces)
    vertices = _smoothed(vertices, faces)
    if len(faces) > triangles:
        vertices, faces = fast_simplification.simplify(
            vertices.astype(np.float32), faces.astype(np.int32), target_count=triangles
        )
    faces = np.ascontiguousarray(faces, np.int32)
    for _ in range(_SETTLING):
        vertices = _settle(scene, vertices, faces)
    vertices = vertices + _RIM * vertex_normals(vertices, faces)
    return vertices.astype(np.float32), faces


def _lattice(scene: Scene, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """The corner [3] of a grid over the pose, and which places [N, N, N] are near filled voxels."""
    bricks, cells = scene.voxels.bricks.numpy(), scene.voxels.cells.numpy() >= 0
    count, side = len(bricks), cells.shape[1]
    filled = np.zeros((count, count, count, side, side, side), bool)
    own = np.argwhere(bricks >= 0)
    filled[tuple(own.T)] = cells[bricks[tuple(own.T)]]
    filled = filled.transpose(0, 3, 1, 4, 2, 5).reshape((count * side,) * 3)
    voxel, margin = 1 / (scene.voxels.scale * side), 3
    filled = ndimage.binary_dilation(np.pad(filled, margin), iterations=2)
    steps = int(len(filled) * voxel / spacing)
    at = ((np.arange(steps) + 0.5) * spacing / voxel).astype(int)
    corner = scene.origin + scene.voxels.box_min.numpy() - margin * voxel + spacing / 2
    return corner, filled[np.ix_(at, at, at)]


def _fuse(
    scene: Scene, points: np.ndarray, cut: float, progress: Report | None
) -> tuple[np.ndarray, np.ndarray]:
    """Mean signed distance of points [N, 3] to the surface that pictures show, in units of `cut`
    and no more than 1 before it, and how much pictures tell of each [N]."""
    low, high = points.min(0), points.max(0)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    total, looks = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
    settings = replace(RenderSettings.preset("preview"), transmittance=_LEFT)
    views = [
        (2 * np.pi * (turn + 0.5 * (ring % 2)) / _RING, np.radians(pitch))
        for ring, pitch in enumerate(_PITCHES)
        for turn in range(_RING)
    ]
    for done, (yaw, pitch) in enumerate(views):
        camera = camera_at(middle, yaw, pitch, radius, _PIXELS)
        depth, trust = _seen(*field_picture(scene, camera, settings), camera)
        pixels, along = camera.project(points)
        at = np.clip(pixels.astype(np.int32), 0, _PIXELS - 1)
        signed = (depth[at[:, 1], at[:, 0]] - along) / cut
        weight = np.where(signed > -1, trust[at[:, 1], at[:, 0]], 0)
        total += weight * np.clip(signed, -1, 1)
        looks += weight
        if progress:
            progress((done + 1) / len(views), step="surface")
    return total / np.maximum(looks, 1e-6), looks


def _seen(rgba: np.ndarray, depth: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Depth [H, W] of what is solid, inf elsewhere, and how far it is to be trusted: by how
    straight the surface is looked at; not at all beside an outline."""
    solid = rgba[..., 3] >= _SOLID
    depth = np.where(solid, depth, np.inf)
    slope_y, slope_x = np.gradient(np.where(solid, depth, 0))
    focal = camera.intrinsics[0, 0]
    steep = (slope_x**2 + slope_y**2) * (focal / np.where(solid, depth, 1)) ** 2
    inner = ndimage.binary_erosion(solid, np.ones((3, 3)))
    outer = ~ndimage.binary_dilation(solid, np.ones((3, 3)))
    return depth, np.where(inner, 1 / (1 + steep), outer).astype(np.float32)


def _settle(scene: Scene, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Vertices moved along their normals to where a ray from outside ends."""
    normals = vertex_normals(vertices, faces)
    rays = RayBatch(
        torch.from_numpy((vertices + _OUTSIDE * normals).astype(np.float32)),
        torch.from_numpy(-normals),
        torch.ones(len(vertices)),
    )
    rgba, along = trace_rays(scene, rays, replace(RenderSettings(), transmittance=_LEFT))
    step = np.where(rgba[:, 3] >= _SOLID, _OUTSIDE - along, 0)
    step = np.where(np.abs(step) < _OUTSIDE, step, 0)  # further off is another surface
    matrix = _edges(faces, len(vertices)).tocsr()
    matrix.data[:] = 1
    mean = (matrix @ step + step) / (np.asarray(matrix.sum(1))[:, 0] + 1)
    return vertices + mean[:, None] * normals


def _large_pieces(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    piece = connected_components(_edges(faces, len(vertices)), directed=False)[1][faces[:, 0]]
    sizes = np.bincount(piece)
    kept = faces[sizes[piece] >= _CRUMB * sizes.max()]
    used, renumbered = np.unique(kept, return_inverse=True)
    return vertices[used], renumbered.reshape(-1, 3)


def _edges(faces: np.ndarray, count: int) -> coo_matrix:
    rows = faces[:, [0, 1, 2, 1, 2, 0]].ravel()
    columns = faces[:, [1, 2, 0, 0, 1, 2]].ravel()
    return coo_matrix((np.ones(len(rows), np.float32), (rows, columns)), (count, count))


def _smoothed(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    matrix = _edges(faces, len(vertices)).tocsr()
    neighbours = np.asarray(matrix.sum(1))
    for _ in range(_SMOOTHING):
        for step in (0.5, -0.53):
            vertices = vertices + step * (matrix @ vertices / neighbours - vertices)
    return vertices
