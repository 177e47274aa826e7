"""What the kernels exchange: a posed mesh with its maps, the clearance grid, a wave of samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch

MODES = ("rigid", "affine", "smooth")


@dataclass(frozen=True, eq=False)
class PosedMesh:
    """A mesh in one pose: where its triangles are, and the way back to the canonical mesh.

    `search` is what the kernels' `refit` returned. With one map a triangle (modes "rigid" and
    "affine") `triangle_maps` is [T,3,4] and a posed point x of nearest triangle i goes to
    `M_i [x, 1]`. In mode "smooth" `vertex_maps` [V,3,4] = [L | c] holds a linear part and the
    canonical place of each vertex, and x with nearest point p of barycentrics b goes to
    `sum_j b_j (L_j (x - p) + c_j)`.
    """

    mode: str
    search: Any
    triangles: torch.Tensor  # [T,3] int32
    vertices: torch.Tensor  # [V,3] float32, posed
    triangle_maps: torch.Tensor | None = None
    vertex_maps: torch.Tensor | None = None


@dataclass(frozen=True, eq=False)
class Clearance:
    """How far the occupied canonical cells are from each cell, for leaping over empty space.

    `grid[i, j, k]` (x, y, z) is 0 in an occupied cell, else the chessboard distance in cells to the
    nearest occupied one (capped at 255). A canonical point x lies in cell
    `floor((x - box_min) * box_scale * G)`; outside the box nothing is occupied.
    """

    grid: torch.Tensor  # [G,G,G] uint8
    box_min: torch.Tensor  # [3] float32, metres
    box_scale: float  # 1 / side of the box in metres

    @property
    def cell(self) -> float:
        """Side of a cell in metres."""
        return 1.0 / (self.box_scale * self.grid.shape[0])


@dataclass(frozen=True, eq=False)
class Voxels:
    """Posed space in bricks of 4x4x4 voxels: where a pose may hold anything, and which canonical
    cell that is, so that rays can be followed without a search.

    `bricks[i, j, k]` is a row of `cells`, or where nothing can be minus the chessboard distance in
    bricks to the nearest that has one. `cells` holds each voxel's canonical cell, a flat index into
    the grid of a `Clearance`, or -1. A posed point x lies in brick `floor((x - box_min) * scale)`;
    outside the box there is nothing. `maps` holds for each brick an affine map [3, 4] from posed to
    canonical space, how far its answer may be off (metres, infinite where the mesh is torn), and
    the mesh's nearest point to the brick's middle.
    """

    bricks: torch.Tensor  # [N,N,N] int32
    cells: torch.Tensor  # [B,4,4,4] int32
    box_min: torch.Tensor  # [3] float32, metres
    scale: float  # bricks a metre
    maps: torch.Tensor  # [B,16] float32

    @property
    def box(self) -> torch.Tensor:
        """The two opposite corners [2,3], for `bounds`."""
        return torch.stack([self.box_min, self.box_min + len(self.bricks) / self.scale])


class Known(NamedTuple):
    """What a guide knows of `Voxels`: density [B, 4, 4, 4] (1/m), negative where nothing can be;
    held [B] int64: a bit for each voxel where something can, the last index counting by ones."""

    density: torch.Tensor
    held: torch.Tensor


class Thrift(NamedTuple):
    """How few samples may stand for a ray's places; what a place adds is told by a guide.

    width: samples at most; share: what places that go together may add to a pixel; longest: how
    many they may be; opaque: the guide's optical depth at which a ray ends, or infinite where the
    guide is not to hide anything.
    """

    width: int
    share: float = 0.0
    longest: int = 1
    opaque: float = float("inf")


class Probing(NamedTuple):
    """How a picture's rays look at places: in runs, of which the middle is looked at first.

    width: runs between two looks at a ray's transmittance; probe: places in a run; longest: places
    in a run that adds no more than `share` to a pixel by what a guide knows; tolerance: a run that
    adds more is taken apart (1: none is); transmittance: a ray ends when less of it is left;
    negligible: weight a metre below which a sample's colour is not asked for.
    """

    width: int
    share: float
    longest: int
    probe: int
    tolerance: float
    transmittance: float
    negligible: float


class Wave(NamedTuple):
    """Up to W occupied samples a ray; entries beyond `count` hold -1 (k, triangle) and zeros."""

    count: torch.Tensor  # type: ignore[assignment]  # [R] int32; hides tuple.count
    next: torch.Tensor  # [R] int32: lattice index to continue from, last + 1 when finished
    k: torch.Tensor  # [R,W] int32, lattice index: t = (k + jitter) * step
    triangle: torch.Tensor  # [R,W] int32
    barycentric: torch.Tensor  # [R,W,3]
    canonical: torch.Tensor  # [R,W,3] metres
    distance: torch.Tensor  # [R,W] metres, to the posed mesh


class Picks(NamedTuple):
    """Samples [R, W] of which the first `count` [R] of a ray count.

    looks [R]: places that were looked at; next [R]: lattice index to continue from, last + 1 when
    finished; k: lattice index; steps: how many steps of the lattice the sample stands for; the rest
    as in a `Wave`.
    """

    count: torch.Tensor  # type: ignore[assignment]
    looks: torch.Tensor
    next: torch.Tensor
    k: torch.Tensor
    steps: torch.Tensor
    triangle: torch.Tensor
    barycentric: torch.Tensor
    canonical: torch.Tensor
    distance: torch.Tensor


class Seen(NamedTuple):
    """What the rays of one frame, of an appearance, picked, and how they lie (`pick`): jitter [R],
    origins and directions [R, 3]; shoulders [3, 3] and offset [3] (arrays) as in
    `rigid.Stance`."""

    picks: Picks
    appearance: int
    jitter: torch.Tensor
    origins: torch.Tensor
    directions: torch.Tensor
    shoulders: Any
    offset: Any


class Layers(NamedTuple):
    """A ReLU network: weights [out, in] and biases [out] of each layer."""

    weights: list[torch.Tensor]
    biases: list[torch.Tensor]


@dataclass(frozen=True, eq=False)
class Frozen:
    """A field held still for one picture: what depends on the frame or the appearance alone is in
    the networks' first biases.

    A sample's `inputs` are its embedding, log-density and geometry features, in this order; offset
    and colour see all of them (what one does not use has a weight of 0).
    """

    encodings: tuple[tuple[torch.Tensor, Any], ...]  # tables and layout, of the canonical place
    # and, where the field has it, of the place that rests with the shoulders
    density: Layers
    offset: Layers | None
    colour: Layers
    view: torch.Tensor  # [16, hidden]: harmonics of the direction to the colour's first layer
    latent: torch.Tensor  # [K, V, C] at vertices or [K, S, S, C] texels; C may be 0
    corner_uvs: torch.Tensor  # [T, 3, 2] where there are texels, else [0, 3, 2]
    untrained: tuple[float, float, float, float]  # far log-density, rise at the mesh, falloff, skin
    limit: float  # of log-densities
    # several appearances at once, K > 1 (`field.mixture`), else [1, 1, 1, 1] of 1 and True
    shares: torch.Tensor  # [K, S, S, S]
    filled: torch.Tensor  # [K, G, G, G] bool
    mixing: tuple[float, float, float, float]  # empty, solid (a millimetre), firmness, thickness


class Traced(NamedTuple):
    """Rays that ended: colour [R, 4] of what was worth a look and how much of the ray that was,
    depth [R] (weighted), left [R] transmittance; how many densities were evaluated."""

    colour: torch.Tensor
    depth: torch.Tensor
    left: torch.Tensor
    evaluations: int
