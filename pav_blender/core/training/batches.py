"""One batch: pixels of a few frames, and the samples of their rays that matter."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace

import numpy as np
import torch

from .. import kernels
from ..config import Config
from ..deformation import Clearance, Deformer, PosedMesh, Thrift, Voxels, voxels
from ..deformation.rigid import Stance, stance
from ..field.field import Samples, condition
from ..kernels.structures import Seen
from ..rendering.rays import TILE, RayBatch, camera_rays
from .attention import Attention
from .frames import Frame
from .occupancy import Visibility

_UNIFORM = 0.05  # part of the tiles drawn from anywhere in the picture
_LED = 0.4  # part of the tiles drawn by how wrong they were
KEPT_POSES = 192  # some six megabytes each
_THRIFT = Thrift(width=48, share=0.05, longest=3, opaque=8.0)


@dataclass(eq=False)
class Pixels:
    """R pixels of B frames: colour [R, 3] and alpha [R] in [0, 1], depth [R] (0: no target); tile
    [R], the row in its frame's tiles, or -1."""

    rays: RayBatch
    frame: torch.Tensor
    colour: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor
    tile: np.ndarray
    frames: list[Frame]
    starts: list[int]

    def to(self, device: torch.device) -> Pixels:
        names = ("rays", "frame", "colour", "alpha", "depth")
        return replace(self, **{name: getattr(self, name).to(device) for name in names})


@dataclass(eq=False)
class Picked:
    """The samples of a batch, sorted by ray: t [N], width [N] (metres of ray each stands for),
    cells [N] (flat indices into the occupancy); looks: places that were looked at for them;
    ended [R]: rays that were not followed to their end."""

    samples: Samples
    t: torch.Tensor
    width: torch.Tensor
    cells: torch.Tensor
    looks: int
    ended: torch.Tensor


@dataclass(eq=False)
class _Posed:
    vertices: np.ndarray
    mesh: PosedMesh
    stance: Stance
    voxels: Voxels
    version: int


class Poses:
    """Frames' posed meshes, stances and voxels, the most recently used ones kept.

    Cells are only ever emptied, so that old voxels are still right, merely more than needed.
    """

    def __init__(self, deformer: Deformer, canonical: np.ndarray, weights: np.ndarray) -> None:
        self._deformer, self._canonical, self._weights = deformer, canonical, weights
        self._kept: OrderedDict[str, _Posed] = OrderedDict()

    def __call__(self, frame: Frame, space: Clearance, version: int, reach: float) -> _Posed:
        """The frame posed; its voxels are those of `version` of the space, or a later one."""
        known = self._kept.get(frame.name)
        if known is None or known.vertices is not frame.vertices:  # a corrected one has others
            mesh = self._deformer.pose(frame.vertices)
            meshes = self._canonical, frame.vertices, self._weights
            filled = voxels(mesh, space, reach)
            known = _Posed(frame.vertices, mesh, stance(*meshes), filled, version)
            self._kept[frame.name] = known
            if len(self._kept) > KEPT_POSES:
                self._kept.popitem(last=False)
        elif known.version != version:
            known.voxels, known.version = voxels(known.mesh, space, reach), version
        self._kept.move_to_end(frame.name)
        return known


def draw_pixels(
    frames: list[Frame],
    rays: int,
    random: np.random.Generator,
    attention: Attention | None = None,
) -> Pixels:
    """Tiles of pixels, mostly near the matte, an equal number from each frame."""
    per_frame = max(1, rays // len(frames) // TILE**2)
    parts: list[tuple[RayBatch, np.ndarray, np.ndarray]] = []
    tiles = []
    starts, total = [], 0
    for frame in frames:
        columns, rows, tile = _draw_tiles(frame, per_frame, random, attention)
        tiles.append(tile)
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
        np.concatenate(tiles),
        frames,
        starts,
    )


def _draw_tiles(
    frame: Frame, count: int, random: np.random.Generator, attention: Attention | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns and rows of pixels, and each one's row in the frame's tiles or -1."""
    height, width = frame.rgba.shape[:2]
    anywhere = round(count * _UNIFORM)
    led = 0 if attention is None else round(count * _LED)
    which = random.integers(len(frame.tiles), size=count - anywhere - led)
    if attention is not None and led:
        which = np.concatenate([which, attention.draw(frame, led, random)])
    limit = (-(-height // TILE), -(-width // TILE))
    free = random.integers((0, 0), limit, size=(anywhere, 2))
    corner = np.concatenate([frame.tiles[which], free]).astype(np.int64) * TILE
    inner = np.arange(TILE)
    rows = (corner[:, 0, None, None] + inner[:, None]).repeat(TILE, 2).reshape(-1)
    columns = (corner[:, 1, None, None] + inner[None, :]).repeat(TILE, 1).reshape(-1)
    tile = np.concatenate([which, np.full(anywhere, -1)]).repeat(TILE**2)
    inside = (rows < height) & (columns < width)
    return columns[inside], rows[inside], tile[inside]


def pick_samples(
    poses: Poses,
    pixels: Pixels,
    visibility: Visibility,
    config: Config,
    step: float,
    generator: torch.Generator,
    codes: torch.Tensor | None = None,
) -> Picked:
    """The samples of all rays, by what the field was of late; no network runs. codes [A, P]: of
    several people, whose head each appearance is (`identities.codes`)."""
    ops = kernels.select("cpu")
    count = len(pixels.rays)
    stops = [*pixels.starts[1:], count]
    jitter, chance = torch.rand(2, count, generator=generator)
    parts: list[Seen] = []
    directions, ended, conditions = [], [], []
    looks = 0
    for index, (a, b) in enumerate(zip(pixels.starts, stops, strict=True)):
        appearance = pixels.frames[index].appearance
        space = visibility.spaces[appearance]
        posed = poses(pixels.frames[index], space, visibility.version, config.reach)
        rays = pixels.rays.origins[a:b], pixels.rays.directions[a:b]
        near, far = ops.marching.bounds(posed.voxels.box, 0.0, *rays)
        first, last = ops.marching.lattice(near, far, jitter[a:b], step)
        picks = ops.picking.pick(
            posed.mesh,
            posed.voxels,
            visibility.guide[appearance],
            *rays,
            first,
            last,
            jitter[a:b],
            chance[a:b],
            torch.ones(b - a),
            step,
            clearance=space,
            band=config.reach,
            thrift=_THRIFT,
        )
        looks += int(picks.looks.sum())
        ended.append(picks.next <= last)
        stance = posed.stance
        parts.append(Seen(picks, appearance, jitter[a:b], *rays, stance.shoulders, stance.offset))
        expression = pixels.frames[index].expression
        person = None if codes is None else codes[appearance]
        conditions.append(condition(config, expression, stance.turn, person))
        directions.append(rays[1] @ torch.from_numpy(stance.rotation))
    found = ops.batches.gather(parts, step, visibility.spaces[0])
    samples = Samples(
        canonical=found.canonical,
        still=found.still,
        triangle=found.triangle,
        barycentric=found.barycentric,
        distance=found.distance,
        appearance=found.appearance,
        frame=found.frame,
        ray=found.ray,
        condition=torch.stack(conditions),
        direction=torch.cat(directions),
    )
    return Picked(samples, found.t, found.width, found.cells, looks, torch.cat(ended))
