"""Nearest point on a mesh by trying every triangle, in float64 where the device has it."""

from __future__ import annotations

from dataclasses import dataclass

import torch

# A triangle lower than this fraction of its longest edge has no usable plane: never chosen.
FLATNESS = 1e-5
# Distances closer than this count as equal and go to the lowest triangle index.
TIE_RELATIVE, TIE_METRES = 1e-6, 1e-9
_PAIRS = 1 << 16  # point-triangle pairs at a time: what a cache holds


class Topology:
    """Triangles [T,3] of a mesh; `rest_vertices` [V,3] gives the vertex count here."""

    def __init__(self, triangles: torch.Tensor, rest_vertices: torch.Tensor) -> None:
        self.triangles = triangles
        self.vertex_count = len(rest_vertices)


@dataclass(frozen=True, eq=False)
class Posed:
    topology: Topology
    vertices: torch.Tensor  # [V,3] float32
    usable: torch.Tensor  # [T] bool: not degenerate


def usable_triangles(corners: torch.Tensor) -> torch.Tensor:
    """[T,3,3] corners -> [T] bool: finite, and higher than FLATNESS of the longest edge."""
    a, b, c = corners.unbind(1)
    longest = torch.stack([b - a, c - b, a - c], 1).square().sum(-1).amax(1)
    area = torch.linalg.cross(b - a, c - a).square().sum(-1).sqrt()
    return area > FLATNESS * longest  # false for NaN and for zero


def _precise(x: torch.Tensor) -> torch.Tensor:
    return x.float() if x.device.type == "mps" else x.double()


def refit(topology: Topology, vertices: torch.Tensor) -> Posed:
    """The mesh with its vertices [V,3] at these places."""
    corners = _precise(vertices)[topology.triangles.long()]
    return Posed(topology, vertices, usable_triangles(corners))


def closest_on_triangle(
    points: torch.Tensor, a: torch.Tensor, b: torch.Tensor, c: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Barycentrics [...,3] and squared distance [...] of the nearest point of each triangle.

    The plane's foot point where it lies inside, else the nearest of the three clamped segments.
    """
    ab, ac, ap = b - a, c - a, points - a
    g00, g01, g11 = (ab * ab).sum(-1), (ab * ac).sum(-1), (ac * ac).sum(-1)
    h0, h1 = (ap * ab).sum(-1), (ap * ac).sum(-1)
    determinant = g00 * g11 - g01 * g01
    v = (g11 * h0 - g01 * h1) / determinant
    w = (g00 * h1 - g01 * h0) / determinant
    inside = (v >= 0) & (w >= 0) & (v + w <= 1)
    s = (h0 / g00).clamp(0, 1)
    t = (h1 / g11).clamp(0, 1)
    bc, bp = c - b, points - b
    u = ((bp * bc).sum(-1) / (bc * bc).sum(-1)).clamp(0, 1)
    zero = torch.zeros_like(s)
    choices = torch.stack(
        [
            torch.stack([1 - v - w, v, w], -1),
            torch.stack([1 - s, s, zero], -1),
            torch.stack([1 - t, zero, t], -1),
            torch.stack([zero, 1 - u, u], -1),
        ]
    )
    offsets = choices[..., 1:2] * ab + choices[..., 2:3] * ac - ap
    squared = offsets.square().sum(-1)
    squared[0] = torch.where(inside, squared[0], torch.inf)
    best, which = squared.min(0)
    index = which[None, ..., None].expand(1, *choices.shape[1:])
    return choices.gather(0, index)[0], best


def nearest(posed: Posed, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Triangle [N] int32, barycentrics [N,3] and distance [N] (metres) of the closest point.

    Degenerate triangles are never chosen; distances equal to one millionth go to the lowest index.
    A point that is not finite, or a mesh of degenerate triangles only, gives -1, zeros, infinity.
    """
    count, device = len(points), points.device
    triangle = torch.full((count,), -1, dtype=torch.int32, device=device)
    barycentric = torch.zeros((count, 3), dtype=torch.float32, device=device)
    distance = torch.full((count,), torch.inf, dtype=torch.float32, device=device)
    candidates = posed.usable.nonzero()[:, 0]
    if count == 0 or len(candidates) == 0:
        return triangle, barycentric, distance
    corners = _precise(posed.vertices)[posed.topology.triangles.long()[candidates]]
    valid = points.isfinite().all(-1).nonzero()[:, 0]
    order = torch.arange(len(candidates), device=device)
    for rows in valid.split(max(1, _PAIRS // len(candidates))):
        x = _precise(points[rows])
        _, squared = closest_on_triangle(x[:, None], *corners.unbind(1))
        found = squared.sqrt()
        limit = found.amin(1, keepdim=True) * (1 + TIE_RELATIVE) + TIE_METRES
        chosen = torch.where(found <= limit, order, len(candidates)).amin(1)
        bary, squared_chosen = closest_on_triangle(x, *corners[chosen].unbind(1))
        triangle[rows] = candidates[chosen].to(torch.int32)
        barycentric[rows] = bary.float()
        distance[rows] = squared_chosen.sqrt().float()
    return triangle, barycentric, distance
