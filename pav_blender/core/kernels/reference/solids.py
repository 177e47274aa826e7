"""Meshes of a scene as shaded solids: every triangle held against every pixel, in float64.

A triangle's corners stay homogeneous, P = (X, Y, W) in pixels, and are never divided: at pixel
(x, y) the weight of corner a is (Pb x Pc) . (x, y, 1), up to a common factor, also where the
triangle passes through the camera's plane (Olano and Greer 1997, "Triangle scan conversion using
2D homogeneous coordinates").
"""

from __future__ import annotations

import numpy as np
import torch

from ..soup import Lights, Soup

_AT_ONCE = 64  # triangles


def draw(
    soup: Soup,
    matrices: np.ndarray,
    turns: np.ndarray,
    palette: np.ndarray,
    lights: Lights,
    size: tuple[int, int],
    near: float,
) -> tuple[np.ndarray, np.ndarray]:
    """What pixel centres of a picture of `size` (width, height) see of a soup.

    matrices [O, 4, 4] float64: from an object's own space to (X, Y, W, depth): pixel (X / W,
    Y / W), depth in metres along the camera's axis. turns [O, 3, 3]: its normals into the camera's
    axes, of any length. palette [M, 3] float32: colours. Surfaces nearer than `near` > 0 metres
    are not seen; both sides of the others are.

    Returns colour [H, W, 3] float32 (0 where nothing is) and depth [H, W] float32 (inf there).
    """
    width, height = size
    y, x = (values.reshape(-1).double() + 0.5 for values in torch.meshgrid(
        torch.arange(height), torch.arange(width), indexing="ij"))  # fmt: skip
    pixels = torch.stack([x, y, torch.ones_like(x)])
    best = torch.full((width * height,), torch.inf, dtype=torch.float32)
    colour = torch.zeros(width * height, 3, dtype=torch.float64)
    corners = torch.from_numpy(soup.triangles).long()
    points = _projected(soup, matrices)
    for start in range(0, len(corners), _AT_ONCE):
        part = corners[start : start + _AT_ONCE]
        a, b, c = points[part].unbind(1)  # each [T, 4]
        a3, b3, c3 = a[:, :3], b[:, :3], c[:, :3]
        edges = torch.stack(
            [torch.linalg.cross(b3, c3), torch.linalg.cross(c3, a3), torch.linalg.cross(a3, b3)], 1
        )
        volume = (edges[:, 0] * a3).sum(-1)
        weights = (edges * volume.sign()[:, None, None]) @ pixels  # [T, 3, P]
        total = weights.sum(1)
        inside = (weights >= 0).all(1) & (total > 0) & (volume != 0)[:, None]
        weights = weights / torch.where(inside, total, 1.0)[:, None]
        depth = torch.einsum("tcp,tc->tp", weights, points[part][..., 3]).float()
        depth = torch.where(inside & (depth > near), depth, torch.inf)
        nearest, which = depth.min(0)
        closer = (nearest < best).nonzero()[:, 0]
        best[closer] = nearest[closer]
        chosen = which[closer]
        shares = weights[chosen, :, closer]
        colour[closer] = _shaded(
            soup, start + chosen, shares, volume[chosen], turns, palette, lights
        )
    shape = (height, width)
    return colour.float().numpy().reshape(*shape, 3), best.numpy().reshape(shape)


def _projected(soup: Soup, matrices: np.ndarray) -> torch.Tensor:
    vertices = torch.from_numpy(soup.vertices).double()
    full = torch.cat([vertices, torch.ones(len(vertices), 1, dtype=torch.float64)], 1)
    own = torch.from_numpy(matrices).double()[torch.from_numpy(soup.owner).long()]
    return (own @ full[:, :, None])[..., 0]


def _shaded(
    soup: Soup,
    triangle: torch.Tensor,
    shares: torch.Tensor,
    volume: torch.Tensor,
    turns: np.ndarray,
    palette: np.ndarray,
    lights: Lights,
) -> torch.Tensor:
    """Colours [N, 3] of triangles [N] at weights [N, 3]; volume [N]: whose sign is their side."""
    rows = torch.from_numpy(soup.normal_of).long()[triangle]
    local = (torch.from_numpy(soup.normals).double()[rows] * shares[:, :, None]).sum(1)
    owner = torch.from_numpy(soup.owner).long()[
        torch.from_numpy(soup.triangles).long()[triangle, 0]
    ]
    turn = torch.from_numpy(turns).double()[owner]
    normal = (turn @ local[:, :, None])[..., 0]
    normal = normal / normal.norm(dim=1, keepdim=True).clamp(min=1e-30)
    # a mirrored object shows its outside where another would show its inside
    outside = (volume < 0) == (torch.linalg.det(turn) > 0)
    normal = torch.where(outside[:, None], normal, -normal)
    shade = torch.full((len(triangle),), lights.ambient, dtype=torch.float64)
    for direction in torch.from_numpy(lights.directions).double():
        shade = shade + (normal @ direction).clamp(min=0)
    material = torch.from_numpy(soup.material).long()[triangle]
    return torch.from_numpy(palette).double()[material] * shade[:, None]
