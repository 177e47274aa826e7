"""The paper's quadrature in float64: maps, field and compositing in plain torch, nothing skipped.

Which triangle is nearest is asked of the compiled search, at billions of places (`rounding`
compares it with trying every triangle); all that follows from that, the nearest point included, is
computed anew in float64. Pixels' rays are taken as they are.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import torch

from ...core import kernels
from ...core.deformation import vertex_maps
from ...core.deformation.rigid import stance
from ...core.field.avatar import Avatar
from ...core.field.field import Field, Samples, Worn, condition
from ...core.field.identities import code
from ...core.kernels import cpu, reference
from ...core.kernels.structures import Clearance, PosedMesh
from ...core.rendering.rays import TILE, RayBatch, camera_rays
from ...core.rendering.wearing import deformer_of, space_of
from ...core.training.frames import Frame

_PLACES = 1 << 18  # looked at at once


@dataclass(eq=False)
class Exact:
    """An avatar in the pose of a frame, wearing that frame's appearance, in float64."""

    avatar: Avatar
    field: Field
    worn: Worn
    mesh: PosedMesh
    posed: PosedMesh  # the compiled search's
    space: Clearance
    frame: Frame

    @classmethod
    def of(cls, avatar: Avatar, frame: Frame) -> Exact:
        field = copy.deepcopy(avatar.field).double()
        posed = deformer_of(avatar).pose(frame.vertices)
        space = space_of(avatar, frame.appearance)
        places = torch.from_numpy(frame.vertices).double()
        triangles = posed.triangles
        canonical = torch.from_numpy(avatar.canonical_vertices).double()
        maps = vertex_maps(canonical, places, triangles)
        mesh = PosedMesh("smooth", None, triangles, places, vertex_maps=maps)
        space = Clearance(space.grid, space.box_min.double(), 1 / avatar.box_size)
        worn = field.wearing([frame.appearance])
        return cls(avatar, field, worn, mesh, posed, space, frame)

    def samples(
        self, rays: RayBatch, ray: torch.Tensor, t: torch.Tensor
    ) -> tuple[Samples, torch.Tensor]:
        """What the field needs of places t [N] of rays [N] (sorted), and which of the places count;
        those that lie in no filled cell, or too far from the mesh, are left out."""
        origins, directions = rays.origins.double(), rays.directions.double()
        points = origins[ray] + t[:, None] * directions[ray]
        triangle = cpu.nearest.nearest(self.posed.search, points.float())[0]
        corners = self.mesh.vertices[self.mesh.triangles.long()[triangle.long()]]
        weights, squared = reference.nearest.closest_on_triangle(points, *corners.unbind(1))
        canonical = reference.marching.canonicalise(points, triangle, weights, self.mesh)
        distance = squared.sqrt()
        kept = distance <= self.avatar.config.reach
        kept &= reference.marching.occupied(canonical, self.space)
        stands = stance(
            self.avatar.canonical_vertices, self.frame.vertices, self.avatar.rigid_weights
        )
        turned = directions @ torch.from_numpy(stands.rotation).double()
        shoulders, offset = (
            torch.from_numpy(v).double() for v in (stands.shoulders, stands.offset)
        )
        unit, scale = self.space.box_min, self.space.box_scale
        zeros = torch.zeros(int(kept.sum()), dtype=torch.int32)
        person = code(self.avatar, self.frame.appearance)
        seen = condition(self.avatar.config, self.frame.expression, stands.turn, person).double()
        samples = Samples(
            (canonical[kept] - unit) * scale,
            (points[kept] @ shoulders + offset - unit) * scale,
            triangle[kept],
            weights[kept],
            distance[kept],
            zeros,
            zeros,
            ray[kept].int(),
            seen[None],
            turned,
        )
        return samples, kept

    def shown(self, rays: RayBatch, step: float) -> np.ndarray:
        """Colours of rays [R, 3] before white, float64: a sample every `step` metres."""
        ops = cpu.marching
        half = torch.full((len(rays),), 0.5)
        around = ops.bounds(
            self.posed.vertices, self.avatar.config.reach, rays.origins, rays.directions
        )
        first, last = ops.lattice(*around, half, step)
        counts = (last - first + 1).clamp(min=0)
        found = torch.ones(len(rays), 3, dtype=torch.float64)
        at_once = max(1, _PLACES // max(int(counts.max()), 1))
        with torch.inference_mode(), kernels.plain_torch():
            for rows in torch.arange(len(rays)).split(at_once):
                found[rows] = self._part(rays.pick(rows), first[rows], counts[rows], step)
        return found.numpy()

    def _part(
        self, rays: RayBatch, first: torch.Tensor, counts: torch.Tensor, step: float
    ) -> torch.Tensor:
        ray = torch.arange(len(rays)).repeat_interleave(counts)
        place = torch.arange(len(ray)) - (counts.cumsum(0) - counts)[ray]
        t = (first[ray].double() + place + 0.5) * step
        samples, kept = self.samples(rays, ray, t)
        sigma, rgb = self.field(samples, self.worn)
        colour, opacity, _, _ = reference.marching.composite(
            sigma, rgb, t[kept], step, samples.ray, len(rays)
        )
        return colour + 1 - opacity[:, None]


def some_rays(frame: Frame, size: int, tiles: int) -> RayBatch:
    """Rays of pixels of the frame at `size` pixels a side: `tiles` squares of neighbours drawn of
    those that show the person, so that they share what neighbours share in a picture."""
    camera = frame.camera.resized(size, size)
    height, width = frame.rgba.shape[:2]
    steps = size // TILE
    middle = (np.arange(steps) + 0.5) / steps
    solid = frame.rgba[..., 3][np.ix_((middle * height).astype(int), (middle * width).astype(int))]
    corners = np.argwhere(solid > 0) * TILE
    random = np.random.default_rng(0)
    corners = corners[random.choice(len(corners), min(tiles, len(corners)), replace=False)]
    inner = np.argwhere(np.ones((TILE, TILE)))
    rows, columns = (corners[:, None] + inner).reshape(-1, 2).T
    return camera_rays(camera, columns, rows)
