"""One batch: pixels of a few frames, and the samples of their rays that matter."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
import torch

from .. import kernels
from ..deformation import Clearance, Deformer, PosedMesh
from ..deformation.rigid import head_rotation
from ..field.field import Field, Samples
from ..rendering.rays import Packed, RayBatch, camera_rays, pack
from .frames import TILE, Frame

_UNIFORM = 0.05  # part of the tiles drawn from anywhere in the picture
_KEPT_POSES = 512
_WAVE = 16
_ENDED = 1e-3  # transmittance at which a ray teaches nothing more
_NEGLIGIBLE = 1e-4  # weight below which a sample has no gradient worth its time


@dataclass(eq=False)
class Pixels:
    """R pixels of B frames: colour [R, 3] and alpha [R] in [0, 1], depth [R] (0: no target)."""

    rays: RayBatch
    frame: torch.Tensor
    colour: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor
    frames: list[Frame]
    starts: list[int]


@dataclass(eq=False)
class Picked:
    """The samples kept for the backward pass, sorted by ray, and what the search saw.

    cells [M] flat indices into the occupancy, seen [M] transmittance there, weights [M]: of all
    samples that were looked at.
    """

    samples: Samples
    t: torch.Tensor
    cells: torch.Tensor
    transmittance: torch.Tensor
    weights: torch.Tensor


class Poses:
    """Posed meshes and head rotations of frames, the most recently used ones kept."""

    def __init__(self, deformer: Deformer, canonical: np.ndarray, weights: np.ndarray) -> None:
        self._deformer, self._canonical, self._weights = deformer, canonical, weights
        self._kept: OrderedDict[str, tuple[PosedMesh, np.ndarray]] = OrderedDict()

    def __call__(self, frame: Frame) -> tuple[PosedMesh, np.ndarray]:
        if frame.name in self._kept:
            self._kept.move_to_end(frame.name)
            return self._kept[frame.name]
        mesh = self._deformer.pose(frame.vertices)
        rotation = head_rotation(self._canonical, frame.vertices, self._weights)
        self._kept[frame.name] = mesh, rotation
        if len(self._kept) > _KEPT_POSES:
            self._kept.popitem(last=False)
        return mesh, rotation


def draw_pixels(frames: list[Frame], rays: int, random: np.random.Generator) -> Pixels:
    """Tiles of pixels, mostly near the matte, an equal number from each frame."""
    per_frame = max(1, rays // len(frames) // TILE**2)
    parts: list[tuple[RayBatch, np.ndarray, np.ndarray]] = []
    starts, total = [], 0
    for frame in frames:
        columns, rows = _draw_tiles(frame, per_frame, random)
        starts.append(total)
        total += len(columns)
        parts.append(
            (
                camera_rays(frame.camera, columns, rows),
                frame.rgba[rows, columns],
                frame.depth[rows, columns],
            )
        )
    rgba = torch.from_numpy(np.concatenate([p[1] for p in parts]).astype(np.float32) / 255)
    counts = [len(p[0]) for p in parts]
    batch = RayBatch(
        torch.cat([p[0].origins for p in parts]),
        torch.cat([p[0].directions for p in parts]),
        torch.cat([p[0].cosine for p in parts]),
    )
    return Pixels(
        batch,
        torch.repeat_interleave(torch.arange(len(frames)), torch.tensor(counts)).int(),
        rgba[:, :3],
        rgba[:, 3],
        torch.from_numpy(np.concatenate([p[2] for p in parts]).astype(np.float32)),
        frames,
        starts,
    )


def _draw_tiles(
    frame: Frame, count: int, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    height, width = frame.rgba.shape[:2]
    anywhere = round(count * _UNIFORM)
    chosen = frame.tiles[random.integers(len(frame.tiles), size=count - anywhere)]
    limit = (-(-height // TILE), -(-width // TILE))
    free = random.integers((0, 0), limit, size=(anywhere, 2))
    corner = np.concatenate([chosen, free]).astype(np.int64) * TILE
    inner = np.arange(TILE)
    rows = (corner[:, 0, None, None] + inner[:, None]).repeat(TILE, 2).reshape(-1)
    columns = (corner[:, 1, None, None] + inner[None, :]).repeat(TILE, 1).reshape(-1)
    inside = (rows < height) & (columns < width)
    return columns[inside], rows[inside]


def pick_samples(
    field: Field,
    poses: Poses,
    pixels: Pixels,
    spaces: list[Clearance],
    reach: float,
    step: float,
    jitter: torch.Tensor,
) -> Picked:
    """Marches all rays in waves, without gradients, and keeps the samples that matter."""
    ops = kernels.select("cpu")
    count = len(pixels.rays)
    stops = [*pixels.starts[1:], count]
    posed = [poses(frame) for frame in pixels.frames]
    expression = torch.from_numpy(np.stack([f.expression for f in pixels.frames]))
    appearance = torch.tensor([f.appearance for f in pixels.frames], dtype=torch.int32)
    direction = torch.cat(
        [
            pixels.rays.directions[a:b] @ torch.from_numpy(rotation)
            for a, b, (_, rotation) in zip(pixels.starts, stops, posed, strict=True)
        ]
    )
    first = torch.zeros(count, dtype=torch.int32)
    last = torch.full((count,), -1, dtype=torch.int32)
    for a, b, (mesh, _) in zip(pixels.starts, stops, posed, strict=True):
        part = pixels.rays.origins[a:b], pixels.rays.directions[a:b]
        near, far = ops.marching.bounds(mesh.vertices, reach, *part)
        first[a:b], last[a:b] = ops.marching.lattice(near, far, jitter[a:b], step)
    left = torch.ones(count)
    sums = torch.zeros(count, 3), torch.zeros(count), torch.zeros(count)
    alive = last >= first
    kept: list[tuple[torch.Tensor, ...]] = []
    looked: list[tuple[torch.Tensor, ...]] = []
    while bool(alive.any()):
        packed, rows = _march_frames(
            pixels, posed, spaces, stops, first, last, jitter, step, reach, alive
        )
        if len(packed):
            frame = pixels.frame[packed.ray.long()]
            samples = _samples(
                packed, packed.ray, frame, appearance, expression, direction, spaces[0]
            )
            sigma = field.densities(samples)
            before = left.clone()
            weights = ops.marching.composite_step(
                sigma, torch.zeros(len(packed), 3), packed.t, step, packed.ray, left, *sums
            )
            # at the sample itself, from the weight: T = w / alpha
            alpha = -torch.expm1(-sigma * step)
            seen = torch.where(
                alpha > 1e-6, weights / alpha.clamp(min=1e-6), before[packed.ray.long()]
            )
            looked.append((_cells(samples, spaces[0]), seen, weights))
            good = (weights > _NEGLIGIBLE).nonzero()[:, 0]
            kept.append(
                (
                    packed.ray[good],
                    packed.t[good],
                    packed.triangle[good],
                    packed.barycentric[good],
                    packed.canonical[good],
                    packed.distance[good],
                )
            )
        alive[rows] = (first[rows] <= last[rows]) & (left[rows] > _ENDED)
    if not kept:
        none = torch.zeros(0, dtype=torch.int32)
        kept = [(none, torch.zeros(0), none, *[torch.zeros(0, 3)] * 2, torch.zeros(0))]
        looked = [(torch.zeros(0, dtype=torch.int64), torch.zeros(0), torch.zeros(0))]
    joined = [torch.cat(column) for column in zip(*kept, strict=True)]
    order = torch.argsort(joined[0], stable=True)
    packed = Packed(*(column[order] for column in joined))
    frame = pixels.frame[packed.ray.long()]
    samples = _samples(packed, packed.ray, frame, appearance, expression, direction, spaces[0])
    cells, seen, weights = (torch.cat(column) for column in zip(*looked, strict=True))
    return Picked(samples, packed.t, cells, seen, weights)


def _march_frames(
    pixels: Pixels,
    posed: list[tuple[PosedMesh, np.ndarray]],
    spaces: list[Clearance],
    stops: list[int],
    first: torch.Tensor,
    last: torch.Tensor,
    jitter: torch.Tensor,
    step: float,
    reach: float,
    alive: torch.Tensor,
) -> tuple[Packed, torch.Tensor]:
    """The next wave of every frame's living rays; `first` is moved on in place."""
    ops = kernels.select("cpu")
    parts, all_rows = [], []
    for index, (a, b) in enumerate(zip(pixels.starts, stops, strict=True)):
        rows = alive[a:b].nonzero()[:, 0] + a
        if len(rows) == 0:
            continue
        wave = ops.marching.march(
            posed[index][0],
            pixels.rays.origins[rows],
            pixels.rays.directions[rows],
            first[rows],
            last[rows],
            jitter[rows],
            step,
            wave=_WAVE,
            clearance=spaces[pixels.frames[index].appearance],
            band=reach,
        )
        first[rows] = wave.next
        packed = pack(wave, jitter[rows], step)
        packed.ray = rows[packed.ray.long()].int()
        parts.append(packed)
        all_rows.append(rows)
    fields = ("ray", "t", "triangle", "barycentric", "canonical", "distance")
    joined = Packed(*(torch.cat([getattr(p, name) for p in parts]) for name in fields))
    return joined, torch.cat(all_rows)


def _samples(
    packed: Packed,
    ray: torch.Tensor,
    frame: torch.Tensor,
    appearance: torch.Tensor,
    expression: torch.Tensor,
    direction: torch.Tensor,
    space: Clearance,
) -> Samples:
    return Samples(
        canonical=(packed.canonical - space.box_min) * space.box_scale,
        triangle=packed.triangle,
        barycentric=packed.barycentric,
        distance=packed.distance,
        appearance=appearance[frame.long()],
        frame=frame,
        ray=ray,
        expression=expression,
        direction=direction,
    )


def _cells(samples: Samples, space: Clearance) -> torch.Tensor:
    """Flat index of (appearance, x, y, z) in the occupancy, int64."""
    size = space.grid.shape[0]
    cell = (samples.canonical * size).long().clamp(0, size - 1)
    index = samples.appearance.long()
    for axis in range(3):
        index = index * size + cell[:, axis]
    return index
