"""The deformer: knows the canonical mesh, and takes a pose to a `PosedMesh`."""

from __future__ import annotations

import numpy as np
import torch

from ..errors import InputError
from ..kernels import select
from ..kernels.structures import MODES, PosedMesh


class Deformer:
    """From posed to canonical space by the nearest triangle of one mesh.

    >>> deformer = Deformer(canonical_vertices, triangles, "affine")  # doctest: +SKIP
    >>> mesh = deformer.pose(vertices)  # doctest: +SKIP
    >>> triangle, barycentric, distance = deformer.nearest(mesh, points)  # doctest: +SKIP
    >>> canonical = canonicalise(points, triangle, barycentric, mesh)  # doctest: +SKIP
    """

    def __init__(
        self,
        canonical_vertices: np.ndarray | torch.Tensor,
        triangles: np.ndarray | torch.Tensor,
        mode: str = "affine",
        *,
        device: str = "cpu",
        reference: bool = False,
    ) -> None:
        if mode not in MODES:
            raise InputError(f"deformation mode {mode!r} is none of {', '.join(MODES)}")
        self.mode = mode
        self.device = device
        self.canonical_vertices = self._floats(canonical_vertices)
        self.triangles = torch.as_tensor(np.array(triangles), dtype=torch.int32, device=device)
        count = len(self.canonical_vertices)
        if (
            len(self.triangles)
            and not 0 <= int(self.triangles.min()) <= int(self.triangles.max()) < count
        ):
            raise InputError(f"triangles index vertices outside 0..{count - 1}")
        # [V] bool: vertices of some triangle; others may lie anywhere
        self.referenced = torch.zeros(count, dtype=torch.bool, device=device)
        self.referenced[self.triangles.long().reshape(-1)] = True
        self._loose = (~self.referenced).nonzero()[:, 0]
        self.kernels = select(device, reference=reference)
        self.topology = self.kernels.nearest.Topology(self.triangles, self.canonical_vertices)

    def _floats(self, values: np.ndarray | torch.Tensor) -> torch.Tensor:
        return torch.as_tensor(values).detach().to(self.device, torch.float32).contiguous()

    def pose(self, vertices: np.ndarray | torch.Tensor) -> PosedMesh:
        """The mesh with its vertices [V,3] (metres) in a pose: search structure and maps."""
        posed = self._floats(vertices)
        if posed.shape != self.canonical_vertices.shape:
            raise InputError(
                f"a pose has shape {tuple(posed.shape)}, the canonical mesh "
                f"{tuple(self.canonical_vertices.shape)}: they must be the same mesh"
            )
        if len(self._loose) and len(self.triangles):  # they must not widen the mesh
            posed = posed.index_copy(
                0, self._loose, posed[self.triangles[0, :1].long()].expand(len(self._loose), 3)
            )
        search = self.kernels.nearest.refit(self.topology, posed)
        if self.mode == "smooth":
            maps = self.kernels.frames.vertex_maps(self.canonical_vertices, posed, self.triangles)
            return PosedMesh(self.mode, search, self.triangles, posed, vertex_maps=maps)
        maps = self.kernels.frames.triangle_maps(
            self.canonical_vertices, posed, self.triangles, self.mode
        )
        return PosedMesh(self.mode, search, self.triangles, posed, triangle_maps=maps)

    def nearest(
        self, mesh: PosedMesh, points: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Nearest triangle [N], barycentrics [N,3] and distance [N] of points [N,3]."""
        return self.kernels.nearest.nearest(mesh.search, points)
