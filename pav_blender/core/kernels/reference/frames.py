"""Maps from a posed mesh to its canonical one, a triangle or a vertex at a time.

"rigid" is INSTA's: an orthonormal frame a triangle, `M_canonical inv(M_posed)` (Zielonka et al.
2023); it keeps lengths, so the images of two neighbours do not meet at their common edge. "affine"
uses the frame [ab, ac, n] with n of unit length: neighbours agree on the common edge, and only
off the surface do they part. "smooth" averages the affine linear parts at the vertices and blends
them by the barycentrics of the nearest point, so that it is continuous wherever that point is.
"""

from __future__ import annotations

import torch

# A triangle lower than this fraction of its longest edge counts as degenerate.
FLATNESS = 1e-5


def _corners(vertices: torch.Tensor, triangles: torch.Tensor) -> torch.Tensor:
    return vertices.double()[..., triangles.long(), :]


def _normals(corners: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Unit normals [...,T,3], twice the areas [...,T], and which triangles are usable [...,T]."""
    a, b, c = corners.unbind(-2)
    cross = torch.linalg.cross(b - a, c - a)
    area = cross.norm(dim=-1)
    longest = torch.stack([b - a, c - b, a - c], -1).square().sum(-2).amax(-1)
    usable = area > FLATNESS * longest
    safe = torch.where(usable, area, 1.0)
    return torch.where(usable[..., None], cross / safe[..., None], 0.0), area, usable


def _frames(corners: torch.Tensor, normals: torch.Tensor, mode: str) -> torch.Tensor:
    """[...,T,3,3], axes in the columns."""
    a, b, c = corners.unbind(-2)
    if mode == "affine":
        return torch.stack([b - a, c - a, normals], -1)
    bitangent = torch.nn.functional.normalize(torch.linalg.cross(b - a, normals), dim=-1)
    tangent = torch.nn.functional.normalize(torch.linalg.cross(bitangent, normals), dim=-1)
    return torch.stack([tangent, bitangent, normals], -1)


def _linear_parts(
    canonical: torch.Tensor, posed: torch.Tensor, mode: str
) -> tuple[torch.Tensor, torch.Tensor]:
    """Linear parts [...,T,3,3] and a weight [...,T]: the posed area, 0 where degenerate."""
    normals_c, _, usable_c = _normals(canonical)
    normals_p, area, usable_p = _normals(posed)
    usable = usable_c & usable_p
    identity = torch.eye(3, dtype=torch.float64, device=posed.device)
    frames_p = torch.where(usable[..., None, None], _frames(posed, normals_p, mode), identity)
    frames_c = torch.where(usable[..., None, None], _frames(canonical, normals_c, mode), identity)
    inverse = frames_p.mT if mode == "rigid" else _inverse(frames_p)
    return frames_c @ inverse, torch.where(usable, area, 0.0)


def _inverse(frames: torch.Tensor) -> torch.Tensor:
    """Inverse of [ab, ac, n] by its cofactors: four times faster than LAPACK on small matrices."""
    x, y, z = frames.unbind(-1)
    rows = torch.stack([torch.linalg.cross(y, z), torch.linalg.cross(z, x)], -2)
    determinant = (rows[..., 0, :] * x).sum(-1)[..., None, None]
    last = torch.linalg.cross(x, y)[..., None, :]
    return torch.cat([rows, last], -2) / determinant


def triangle_maps(
    canonical_vertices: torch.Tensor, vertices: torch.Tensor, triangles: torch.Tensor, mode: str
) -> torch.Tensor:
    """Maps [...,T,3,4] from posed [...,V,3] to canonical [V,3] space; mode "rigid" or "affine".

    A triangle degenerate in either mesh gets the translation between its centroids.
    """
    if mode not in ("rigid", "affine"):
        raise ValueError(f"triangle maps are 'rigid' or 'affine', not {mode!r}")
    canonical, posed = _corners(canonical_vertices, triangles), _corners(vertices, triangles)
    linear, weight = _linear_parts(canonical, posed, mode)
    shift_a = canonical[..., 0, :] - (linear @ posed[..., 0, :, None])[..., 0]
    shift_centroid = canonical.mean(-2) - posed.mean(-2)
    shift = torch.where((weight > 0)[..., None], shift_a, shift_centroid)
    return torch.cat([linear, shift[..., None]], -1).nan_to_num().to(vertices.dtype)


def vertex_maps(
    canonical_vertices: torch.Tensor, vertices: torch.Tensor, triangles: torch.Tensor
) -> torch.Tensor:
    """Mode "smooth": [...,V,3,4] = [L | c], L averaged over the triangles about a vertex by area.

    A vertex without a usable triangle gets the identity.
    """
    canonical, posed = _corners(canonical_vertices, triangles), _corners(vertices, triangles)
    linear, weight = _linear_parts(canonical, posed, "affine")
    batch, count = vertices.shape[:-2], vertices.shape[-2]
    weight = weight.nan_to_num()
    weighted = (linear.nan_to_num() * weight[..., None, None]).flatten(-2)
    sums = torch.zeros((*batch, count, 10), dtype=torch.float64, device=vertices.device)
    values = torch.cat([weighted, weight[..., None]], -1)
    for corner in range(3):
        sums.index_add_(-2, triangles[:, corner].long(), values)
    total = sums[..., 9:]
    mean = sums[..., :9] / torch.where(total > 0, total, 1.0)
    identity = torch.eye(3, dtype=torch.float64, device=vertices.device).flatten()
    mean = torch.where(total > 0, mean, identity).unflatten(-1, (3, 3))
    places = canonical_vertices.double().expand(*batch, count, 3)[..., None]
    return torch.cat([mean, places], -1).to(vertices.dtype)
