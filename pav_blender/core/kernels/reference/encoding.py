"""Multi-resolution hash encoding and latent reads in plain torch: oracle, and path off the CPU.

The encoding is that of Instant-NGP (Mueller et al. 2022): every level is a grid over the unit cube
whose corners index a table of features, directly where the grid fits, by a spatial hash where not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ...errors import InputError
from .optimiser import adam_step

PRIMES = (1, 2654435761, 805459861)
FEATURES = 2
ALIGNMENT = 8  # entries: 8 x 2 floats are one cache line, so that no level begins inside one


def resolutions(levels: int, base: int, finest: int) -> list[int]:
    """Cells along an axis for every level, growing geometrically from `base` to `finest`."""
    if levels < 1 or base < 1 or finest < base:
        raise InputError(
            f"hash encoding: {levels} levels from {base} to {finest}: "
            "need at least one level and 1 <= base <= finest"
        )
    if levels == 1:
        return [base]
    growth = (finest / base) ** (1 / (levels - 1))
    # The small term keeps the last level at `finest` where the power rounds to just below it.
    return [int(base * growth**level + 1e-6) for level in range(levels)]


def table_sizes(levels: int, log2_entries: int, resolutions: list[int]) -> list[int]:
    """Entries of every level: (res + 1)^3, rounded up to 8, if that fits, else 2^log2_entries."""
    if len(resolutions) != levels:
        raise InputError(f"hash encoding: {levels} levels but {len(resolutions)} resolutions")
    if not 3 <= log2_entries <= 26:
        raise InputError(f"hash encoding: log2_entries is {log2_entries}, need 3 to 26")
    limit = 1 << log2_entries
    corners = [(res + 1) ** 3 for res in resolutions]
    return [-(-n // ALIGNMENT) * ALIGNMENT if n <= limit else limit for n in corners]


@dataclass(frozen=True)
class Layout:
    """Where the levels of an encoding lie in its table; equal settings give equal layouts."""

    levels: int = 16
    log2_entries: int = 18
    base: int = 16
    finest: int = 2048
    resolutions: tuple[int, ...] = field(init=False, repr=False, compare=False)
    sizes: tuple[int, ...] = field(init=False, repr=False, compare=False)
    offsets: tuple[int, ...] = field(init=False, repr=False, compare=False)
    hashed: tuple[bool, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        grid = resolutions(self.levels, self.base, self.finest)
        sizes = table_sizes(self.levels, self.log2_entries, grid)
        limit = 1 << self.log2_entries
        set_field = object.__setattr__
        set_field(self, "resolutions", tuple(grid))
        set_field(self, "sizes", tuple(sizes))
        set_field(self, "offsets", tuple(sum(sizes[:level]) for level in range(self.levels)))
        set_field(self, "hashed", tuple((res + 1) ** 3 > limit for res in grid))

    @property
    def entries(self) -> int:
        """Rows of the table of all levels."""
        return sum(self.sizes)

    @property
    def width(self) -> int:
        """Features of an encoded point."""
        return self.levels * FEATURES


def encode(points: Tensor, tables: Tensor, layout: Layout) -> Tensor:
    """Encode points [N,3] with tables [layout.entries, 2] -> [N, levels * 2].

    Points are clamped into the unit cube; a coordinate that is not a number counts as 0.
    Differentiable in points and tables.
    """
    check_encode(points, tables, layout)
    points = torch.nan_to_num(points, nan=0.0).clamp(0, 1)
    steps = torch.tensor([(i & 1, i >> 1 & 1, i >> 2) for i in range(8)], device=points.device)
    parts = []
    for res, offset, size, hashed in zip(
        layout.resolutions, layout.offsets, layout.sizes, layout.hashed, strict=True
    ):
        position = points * res
        cell = position.detach().floor().clamp(max=res - 1)
        fraction = position - cell
        x, y, z = (cell.long()[:, None] + steps).unbind(2)  # [N, 8]
        if hashed:
            index = (x * PRIMES[0] ^ y * PRIMES[1] ^ z * PRIMES[2]) & (size - 1)
        else:
            index = x + (res + 1) * (y + (res + 1) * z)
        share = fraction[:, None]
        weight = torch.where(steps.bool(), share, 1 - share).prod(2, keepdim=True)
        parts.append((weight * tables[offset + index]).sum(1))
    return torch.cat(parts, 1)


def encode_all(grids: Sequence[tuple[Tensor, Tensor, Layout]]) -> Tensor:
    """What several grids (points, tables, layout) encode, side by side: [N, their widths]."""
    return torch.cat([encode(*grid) for grid in grids], 1)


def encode_backward_into(
    points: Tensor, grad_out: Tensor, grad_tables: Tensor, layout: Layout
) -> None:
    """Add the gradient of `encode` with respect to the tables to grad_tables, in place."""
    with torch.enable_grad():
        tables = torch.zeros_like(grad_tables, requires_grad=True)
        out = encode(points.detach(), tables, layout)
    (grad,) = torch.autograd.grad(out, tables, grad_out)
    grad_tables += grad


def encode_adam_step(
    points: Tensor,
    grad_out: Tensor,
    tables: Tensor,
    m: Tensor,
    v: Tensor,
    layout: Layout,
    *,
    step: int,
    lr: float,
    beta1: float = 0.9,
    beta2: float = 0.99,
    eps: float = 1e-15,
    weight_decay: float = 0.0,
) -> None:
    """The tables' gradient from that of `encode`'s result [N, levels * 2], and Adam's step by it.

    The same as `encode_backward_into` and then `adam_step`, but the gradient is not kept.
    """
    check_encode(points, tables, layout)
    grad = torch.zeros_like(tables)
    encode_backward_into(points, grad_out, grad, layout)
    adam_step(
        tables,
        grad,
        m,
        v,
        step=step,
        lr=lr,
        beta1=beta1,
        beta2=beta2,
        eps=eps,
        weight_decay=weight_decay,
    )


def encode_adam_steps(
    grids: Sequence[tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Layout]], **settings: Any
) -> None:
    """`encode_adam_step` of several grids (its arguments up to the layout)."""
    for grid in grids:
        encode_adam_step(*grid, **settings)


def read_texture(latent: Tensor, appearance: Tensor, uv: Tensor) -> Tensor:
    """Read latent textures [A,S,S,C] bilinearly at uv [N,2] of appearance [N] -> [N,C].

    Texel (row, column) has its centre at v = (row + 0.5) / S, u = (column + 0.5) / S: row 0 is at
    v = 0, below. Reads beyond the outermost centres give the outermost texel. Differentiable in
    both.
    """
    check_texture(latent, appearance, uv)
    (row, column, below, right), (fu, fv) = _texels(latent.shape[1], uv)
    which = appearance.long()
    first = latent[which, row, column] * (1 - fu) + latent[which, row, right] * fu
    second = latent[which, below, column] * (1 - fu) + latent[which, below, right] * fu
    return first * (1 - fv) + second * fv


def _texels(size: int, uv: Tensor) -> tuple[tuple[Tensor, ...], tuple[Tensor, Tensor]]:
    """Row and column of the texel below uv, and of the next; how far uv lies between, [N,1]."""
    position = (torch.nan_to_num(uv, nan=0.0).clamp(0, 1) * size - 0.5).clamp(0, size - 1)
    low = position.detach().floor().clamp(max=max(size - 2, 0))
    fu, fv = (position - low).unsqueeze(2).unbind(1)
    column, row = low.long().unbind(1)
    right, below = (column + 1).clamp(max=size - 1), (row + 1).clamp(max=size - 1)
    return (row, column, below, right), (fu, fv)


def read_texture_backward_into(
    appearance: Tensor, uv: Tensor, grad_out: Tensor, grad_latent: Tensor
) -> None:
    """Add the gradient of `read_texture` with respect to the textures to grad_latent, in place."""
    with torch.enable_grad():
        latent = torch.zeros_like(grad_latent, requires_grad=True)
        out = read_texture(latent, appearance, uv.detach())
    (grad,) = torch.autograd.grad(out, latent, grad_out)
    grad_latent += grad


def read_vertices(
    latent: Tensor,
    appearance: Tensor,
    triangles: Tensor,
    triangle: Tensor,
    barycentric: Tensor,
) -> Tensor:
    """Read features of vertices [A,V,C] at points of a mesh -> [N,C].

    triangles [T,3] holds the vertices of every triangle; triangle [N] and barycentric [N,3] say
    where on the mesh each point lies. Differentiable in the features and the barycentrics.
    """
    check_vertices(latent, appearance, triangles, triangle, barycentric)
    corners = triangles.long()[triangle.long()]
    features = latent[appearance.long()[:, None], corners]
    return (features * barycentric.unsqueeze(2)).sum(1)


def read_vertices_backward_into(
    appearance: Tensor,
    triangles: Tensor,
    triangle: Tensor,
    barycentric: Tensor,
    grad_out: Tensor,
    grad_latent: Tensor,
) -> None:
    """Add the gradient of `read_vertices` with respect to the features to grad_latent, in place."""
    with torch.enable_grad():
        latent = torch.zeros_like(grad_latent, requires_grad=True)
        out = read_vertices(latent, appearance, triangles, triangle, barycentric.detach())
    (grad,) = torch.autograd.grad(out, latent, grad_out)
    grad_latent += grad


def check_encode(points: Tensor, tables: Tensor, layout: Layout) -> None:
    """Raise InputError where shapes do not fit the layout."""
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"encode: points have shape {tuple(points.shape)}, need [N,3]")
    if tuple(tables.shape) != (layout.entries, FEATURES):
        raise InputError(
            f"encode: tables have shape {tuple(tables.shape)}, "
            f"the layout needs [{layout.entries},{FEATURES}]"
        )


def check_texture(latent: Tensor, appearance: Tensor, uv: Tensor) -> None:
    """Raise InputError where shapes do not match or an appearance does not exist."""
    if latent.ndim != 4 or latent.shape[1] != latent.shape[2]:
        raise InputError(f"read_texture: latent has shape {tuple(latent.shape)}, need [A,S,S,C]")
    if uv.ndim != 2 or uv.shape[1] != 2:
        raise InputError(f"read_texture: uv has shape {tuple(uv.shape)}, need [N,2]")
    check_indices("read_texture: appearance", appearance, len(uv), latent.shape[0])


def check_vertices(
    latent: Tensor, appearance: Tensor, triangles: Tensor, triangle: Tensor, barycentric: Tensor
) -> None:
    """Raise InputError where shapes do not match or an index points nowhere."""
    if latent.ndim != 3:
        raise InputError(f"read_vertices: latent has shape {tuple(latent.shape)}, need [A,V,C]")
    if triangles.ndim != 2 or triangles.shape[1] != 3:
        raise InputError(
            f"read_vertices: triangles have shape {tuple(triangles.shape)}, need [T,3]"
        )
    if barycentric.ndim != 2 or barycentric.shape[1] != 3:
        raise InputError(
            f"read_vertices: barycentrics have shape {tuple(barycentric.shape)}, need [N,3]"
        )
    count = len(barycentric)
    check_indices("read_vertices: appearance", appearance, count, latent.shape[0])
    check_indices("read_vertices: triangle", triangle, count, len(triangles))
    check_indices(
        "read_vertices: triangles", triangles.reshape(-1), triangles.numel(), latent.shape[1]
    )


def check_indices(name: str, index: Tensor, count: int, limit: int) -> None:
    """Raise InputError unless index holds `count` values of 0 to limit - 1."""
    if tuple(index.shape) != (count,):
        raise InputError(f"{name} has shape {tuple(index.shape)}, need [{count}]")
    if count:
        low, high = (int(value) for value in torch.aminmax(index))
        if low < 0 or high >= limit:
            raise InputError(f"{name} holds {low} to {high}, need 0 to {limit - 1}")
