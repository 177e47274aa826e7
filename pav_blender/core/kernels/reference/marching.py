"""Sampling rays against a posed mesh, and compositing: every lattice point, no leaps.

Samples of ray r lie at `t_k = (k + jitter[r]) * step`, k an integer; directions are unit vectors.
"""

from __future__ import annotations

import torch

from ..structures import Clearance, PosedMesh, Wave
from .nearest import nearest


def canonicalise(
    points: torch.Tensor,
    triangle: torch.Tensor,
    barycentric: torch.Tensor,
    mesh: PosedMesh,
) -> torch.Tensor:
    """Posed points [N,3] with nearest triangle [N] and barycentrics [N,3] -> canonical [N,3].

    Points without a triangle (-1) keep their place.
    """
    index = triangle.long().clamp(min=0)
    if mesh.triangle_maps is not None:
        maps = mesh.triangle_maps[index]
        mapped = (maps[..., :3] @ points[..., None])[..., 0] + maps[..., 3]
    else:
        assert mesh.vertex_maps is not None
        corners = mesh.triangles.long()[index]
        foot = (mesh.vertices[corners] * barycentric[..., None]).sum(-2)
        maps = (mesh.vertex_maps[corners] * barycentric[..., None, None]).sum(-3)
        mapped = (maps[..., :3] @ (points - foot)[..., None])[..., 0] + maps[..., 3]
    return torch.where((triangle >= 0)[..., None], mapped, points)


def bounds(
    vertices: torch.Tensor, margin: float, origins: torch.Tensor, directions: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Where rays [R,3] are inside the mesh's box widened by `margin` metres: near, far [R].

    `near` is at least 0; a ray that misses has far < near.
    """
    low, high = vertices.amin(0) - margin, vertices.amax(0) + margin
    # A direction of 0 gives infinities of the right sign; 0 * inf (on a face) is no bound.
    inverse = 1.0 / directions
    a, b = (low - origins) * inverse, (high - origins) * inverse
    near = torch.minimum(a, b).nan_to_num(-torch.inf, torch.inf, -torch.inf).amax(-1)
    far = torch.maximum(a, b).nan_to_num(torch.inf, torch.inf, -torch.inf).amin(-1)
    near = near.clamp(min=0)
    missed = ~(near <= far) | ~torch.isfinite(far)
    return torch.where(missed, 0.0, near), torch.where(missed, -1.0, far)


def lattice(
    near: torch.Tensor, far: torch.Tensor, jitter: torch.Tensor, step: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """First and last lattice index [R] int32 within [near, far]; last = first - 1 for none."""
    first = torch.ceil(near / step - jitter).clamp(min=0).to(torch.int32)
    last = torch.floor(far / step - jitter).clamp(min=-1).to(torch.int32)
    return first, torch.maximum(last, first - 1)


def occupied(canonical: torch.Tensor, clearance: Clearance) -> torch.Tensor:
    """Which canonical points [N,3] lie in an occupied cell, [N] bool."""
    size = clearance.grid.shape[0]
    cell = torch.floor((canonical - clearance.box_min) * (clearance.box_scale * size))
    within = ((cell >= 0) & (cell < size)).all(-1)
    x, y, z = torch.where(within[:, None], cell, 0.0).long().unbind(-1)
    return within & (clearance.grid[x, y, z] == 0)


def march(
    mesh: PosedMesh,
    origins: torch.Tensor,
    directions: torch.Tensor,
    first: torch.Tensor,
    last: torch.Tensor,
    jitter: torch.Tensor,
    step: float,
    *,
    wave: int,
    clearance: Clearance | None = None,
    band: float = torch.inf,
    leap_limit: float = 0.004,
) -> Wave:
    """Up to `wave` samples a ray among lattice indices first..last [R] int32, in order.

    A sample counts when it is within `band` metres of the posed mesh and, with a clearance, when
    its canonical cell is occupied. `leap_limit` is for the compiled kernel: here nothing is leapt.
    """
    del leap_limit
    rays, device = len(origins), origins.device
    counts = (last - first + 1).clamp(min=0).long()
    ray = torch.repeat_interleave(torch.arange(rays, device=device), counts)
    start = torch.cumsum(counts, 0) - counts
    k = first.long()[ray] + torch.arange(len(ray), device=device) - start[ray]
    t = (k.to(origins.dtype) + jitter[ray]) * step
    points = origins[ray] + t[:, None] * directions[ray]
    triangle, barycentric, distance = nearest(mesh.search, points)
    canonical = canonicalise(points, triangle, barycentric, mesh)
    keep = (triangle >= 0) & (distance <= band)
    if clearance is not None:
        keep &= occupied(canonical, clearance)
    ray, k = ray[keep], k[keep]
    found = torch.bincount(ray, minlength=rays)
    place = torch.arange(len(ray), device=device) - (torch.cumsum(found, 0) - found)[ray]
    fits = place < wave
    slot = (ray[fits], place[fits])

    def spread(values: torch.Tensor, empty: float) -> torch.Tensor:
        shape = (rays, wave, *values.shape[1:])
        out = torch.full(shape, empty, dtype=values.dtype, device=device)
        out[slot] = values[fits]
        return out

    k_out = spread(k.to(torch.int32), -1)
    count = found.clamp(max=wave).to(torch.int32)
    full = count == wave
    following = torch.where(full, k_out[:, -1] + 1, torch.maximum(last + 1, first))
    return Wave(
        count,
        following.to(torch.int32),
        k_out,
        spread(triangle[keep], -1),
        spread(barycentric[keep], 0.0),
        spread(canonical[keep], 0.0),
        spread(distance[keep], 0.0),
    )


def _weights(
    sigma: torch.Tensor,
    delta: float | torch.Tensor,
    ray_index: torch.Tensor,
    transmittance: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights [N] and the transmittance left [R], rays starting at `transmittance` [R].

    Optical depths are summed in a table of one row a ray: no ray sees the rounding of another.
    """
    rays, index = len(transmittance), ray_index.long()
    optical = sigma * delta
    counts = torch.bincount(index, minlength=rays)
    place = torch.arange(len(index), device=sigma.device)
    place = place - (torch.cumsum(counts, 0) - counts)[index]
    width = int(counts.max()) if len(index) else 0
    table = torch.zeros((rays, width), dtype=sigma.dtype, device=sigma.device)
    table = table.index_put((index, place), optical)
    # what lies before a solid sample is not got by taking its own large depth off again
    before = torch.nn.functional.pad(table.cumsum(1), (1, 0))[index, place]
    weights = transmittance[index] * torch.exp(-before) * -torch.expm1(-optical)
    return weights, transmittance * torch.exp(-table.sum(1))


def composite(
    sigma: torch.Tensor,
    rgb: torch.Tensor,
    t: torch.Tensor,
    delta: float | torch.Tensor,
    ray_index: torch.Tensor,
    rays: int,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Quadrature of the volume rendering integral with `alpha_i = 1 - exp(-sigma_i delta_i)`.

    sigma [N] (1/m), rgb [N,3], t [N] (m), delta (m, one number or [N]), ray_index [N] sorted ->
    premultiplied colour [R,3], opacity [R], depth [R] (the sum of w t), weights [N].
    Differentiable in sigma, rgb and t.
    """
    ones = torch.ones(rays, dtype=sigma.dtype, device=sigma.device)
    weights, _ = _weights(sigma, delta, ray_index, ones)
    values = torch.cat([weights[:, None] * rgb, weights[:, None], (weights * t)[:, None]], -1)
    sums = torch.zeros((rays, 5), dtype=sigma.dtype, device=sigma.device)
    sums = sums.index_add(0, ray_index.long(), values)
    return sums[:, :3], sums[:, 3], sums[:, 4], weights


def weigh(
    sigma: torch.Tensor,
    delta: float | torch.Tensor,
    ray_index: torch.Tensor,
    transmittance: torch.Tensor,
) -> torch.Tensor:
    """The weights [N] that `composite` gives one wave of samples.

    `transmittance` [R] is what the rays have left and is lowered in place. Not differentiable.
    """
    with torch.no_grad():
        weights, left = _weights(sigma, delta, ray_index, transmittance)
        transmittance.copy_(left)
    return weights
