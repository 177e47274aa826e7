"""An atlas of a baked surface, and the field's colours on it."""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage

from ..errors import PavError
from ..progress import Report
from ..rendering.rasterise import cover
from ..rendering.rays import RayBatch
from ..rendering.render import RenderSettings, Scene, trace_rays

_PACKED = 1024  # cells a side that charts are packed on: finer is slower and hardly denser
_PADDING = 2  # of them between charts
_OUTSIDE = 0.006  # metres before the surface that a texel's ray starts
_TRUSTED = 0.3  # opacity below which a ray's colour is taken from its neighbours
_AT_ONCE = 1 << 18  # rays


def unwrap(
    vertices: np.ndarray, triangles: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An atlas by xatlas: which vertex each of the new ones is [U], triangles [T, 3] of the new
    ones, and their UVs [U, 2] in [0, 1], v up."""
    try:
        import xatlas
    except ImportError as error:
        raise PavError("baking needs xatlas: pip install xatlas") from error
    atlas = xatlas.Atlas()
    atlas.add_mesh(np.ascontiguousarray(vertices, np.float32), triangles.astype(np.uint32))
    charts, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    charts.max_iterations, charts.max_cost = 1, 8.0  # hair would come apart into single triangles
    packing.resolution, packing.padding, packing.bilinear = min(size, _PACKED), _PADDING, True
    atlas.generate(charts, packing)
    source, corners, uvs = atlas[0]
    return source.astype(np.int64), corners.astype(np.int32), uvs.astype(np.float32)


def paint(
    scene: Scene,
    vertices: np.ndarray,
    normals: np.ndarray,
    triangles: np.ndarray,
    uvs: np.ndarray,
    size: int,
    *,
    progress: Report | None = None,
) -> np.ndarray:
    """The texture [size, size, 3] in [0, 1] sRGB, row 0 at v = 1: what a ray sees that looks at the
    surface straight on. Texels beside a chart repeat its border."""
    triangle, barycentric = cover((uvs * (1, -1) + (0, 1)) * size, triangles, size)
    rows, columns = np.nonzero(triangle >= 0)
    corners = triangles[triangle[rows, columns]]
    weights = barycentric[rows, columns, :, None]
    colour = np.zeros((size, size, 3), np.float32)
    known = np.zeros((size, size), bool)
    for start in range(0, len(rows), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        points = (vertices[corners[part]] * weights[part]).sum(1)
        outward = (normals[corners[part]] * weights[part]).sum(1)
        outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12)
        rays = RayBatch(
            torch.from_numpy((points + _OUTSIDE * outward).astype(np.float32)),
            torch.from_numpy(-outward.astype(np.float32)),
            torch.ones(len(points)),
        )
        rgba, _ = trace_rays(scene, rays, RenderSettings())
        colour[rows[part], columns[part]] = rgba[:, :3]
        known[rows[part], columns[part]] = rgba[:, 3] >= _TRUSTED
        if progress:
            progress(min(1.0, (start + _AT_ONCE) / len(rows)), step="texture")
    if not known.any():
        return colour
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return colour[tuple(nearest)]


def sample(texture: np.ndarray, uvs: np.ndarray) -> np.ndarray:
    """Bilinear colours [N, 3] of a texture [S, S, 3] at UVs [N, 2], v up."""
    size = len(texture)
    at = np.clip((uvs * (1, -1) + (0, 1)) * size - 0.5, 0, size - 1 - 1e-4)
    low = at.astype(int)
    part = (at - low)[:, :, None]
    x, y = low[:, 0], low[:, 1]
    upper = texture[y, x] * (1 - part[:, 0]) + texture[y, x + 1] * part[:, 0]
    lower = texture[y + 1, x] * (1 - part[:, 0]) + texture[y + 1, x + 1] * part[:, 0]
    return upper * (1 - part[:, 1]) + lower * part[:, 1]
