"""What an avatar wears in a picture, one appearance or several by shares, and where it may be."""

from __future__ import annotations

import hashlib
import weakref
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage

from .. import kernels
from ..deformation import Clearance, Deformer, clearance
from ..errors import InputError
from ..field.avatar import Avatar
from ..field.field import Worn
from ..field.identities import check_one_person, code
from ..field.mixture import Mixture
from ..kernels.structures import Frozen
from .guide import guide, neighbourhood

Appearance = str | Mapping[str, float | np.ndarray]
_KEPT = 4  # mixtures remembered an avatar
_SOME = 1e-3  # a share below which an appearance is taken not to be there
_CLOSE, _AWAY = 0.005, 0.03  # metres from the mesh between which shares begin to blur
_BLUR = 0.012  # metres, the deviation


@dataclass(frozen=True, eq=False)
class Wearing:
    """The appearances worn, where they fill canonical space, and the greatest density (1/m) to
    expect in each of its cells [G, G, G]; mixture: None for one appearance alone; person: whose
    head they are (`identities.code`)."""

    worn: Worn
    mixture: Mixture | None
    space: Clearance
    guide: torch.Tensor
    person: torch.Tensor


_deformers: weakref.WeakKeyDictionary[Avatar, Deformer] = weakref.WeakKeyDictionary()
_spaces: weakref.WeakKeyDictionary[Avatar, dict[int, Clearance]] = weakref.WeakKeyDictionary()
_guides: weakref.WeakKeyDictionary[Avatar, dict[int, torch.Tensor]] = weakref.WeakKeyDictionary()
_nearest: weakref.WeakKeyDictionary[Avatar, _Surroundings] = weakref.WeakKeyDictionary()
_places: weakref.WeakKeyDictionary[
    Avatar,
    OrderedDict[tuple[tuple[int, ...], bytes], tuple[torch.Tensor, Clearance, torch.Tensor]],
] = weakref.WeakKeyDictionary()
_mixed: weakref.WeakKeyDictionary[Avatar, OrderedDict[tuple[tuple[int, ...], bytes], Wearing]] = (
    weakref.WeakKeyDictionary()
)
_shorts: weakref.WeakKeyDictionary[Avatar, tuple[np.ndarray, np.ndarray] | None] = (
    weakref.WeakKeyDictionary()
)


def short_tables_of(avatar: Avatar, frozen: Frozen) -> tuple[np.ndarray, np.ndarray] | None:
    """An avatar's encodings in bfloat16, if this processor is to work with it; made once."""
    if avatar not in _shorts:
        _shorts[avatar] = kernels.select("cpu").tracing.short_tables(frozen)
    return _shorts[avatar]


def wearing_of(avatar: Avatar, appearance: Appearance) -> Wearing:
    """An appearance by name, or several, each by a weight or by one at every vertex [V].

    Only the weights' proportions count. InputError for unknown names, for those of several people,
    and for weights that are negative, not finite, or all nothing at some vertex.
    """
    rows, shares = shares_of(avatar, appearance)
    if len(rows) == 1:
        row = rows[0]
        return Wearing(
            avatar.field.wearing([row]),
            None,
            space_of(avatar, row),
            guide_of(avatar, row),
            code(avatar, row),
        )
    known = _mixed.setdefault(avatar, OrderedDict())
    key = rows, shares.tobytes()
    if key not in known:
        known[key] = _mix(avatar, rows, shares)
        while len(known) > _KEPT:
            known.popitem(last=False)
    known.move_to_end(key)
    return known[key]


def shares_of(avatar: Avatar, appearance: Appearance) -> tuple[tuple[int, ...], np.ndarray]:
    """Rows of the appearances that are worn anywhere, rising, and their shares [V, K] float32."""
    chosen = {appearance: 1.0} if isinstance(appearance, str) else dict(appearance)
    vertices = len(avatar.canonical_vertices)
    weights = np.zeros((vertices, len(avatar.appearances)), np.float32)
    for name, weight in chosen.items():
        given = np.asarray(weight, np.float32)
        if given.shape not in ((), (vertices,)):
            raise InputError(
                f"weights of appearance {name!r}: {list(given.shape)}; a number or [{vertices}], "
                "one a vertex, are needed"
            )
        weights[:, avatar.appearance_index(name)] += given
    total = weights.sum(1, keepdims=True)
    if not (np.isfinite(weights).all() and (weights >= 0).all() and (total > 0).all()):
        raise InputError(
            f"weights of appearances {', '.join(chosen)}: finite, none negative, and at every "
            "vertex one above 0"
        )
    shares = weights / total
    shares[shares < _SOME] = 0
    rows = np.flatnonzero(shares.any(0))
    check_one_person(avatar, rows.tolist())
    shares = shares[:, rows]
    return tuple(rows.tolist()), np.ascontiguousarray(shares / shares.sum(1, keepdims=True))


def _mix(avatar: Avatar, rows: tuple[int, ...], shares: np.ndarray) -> Wearing:
    spread = torch.from_numpy(_in_space(avatar, shares))
    present = neighbourhood((spread > 0).float()) > 0
    filled, space, guide = _where(avatar, rows, present)
    device = avatar.field.device
    mixture = Mixture(spread.to(device), filled.to(device))
    worn = avatar.field.wearing(list(rows))
    return Wearing(worn, mixture, space, guide, code(avatar, rows[0]))


def _where(
    avatar: Avatar, rows: tuple[int, ...], present: torch.Tensor
) -> tuple[torch.Tensor, Clearance, torch.Tensor]:
    """Which cells each appearance fills [K, G, G, G], where any is that is `present` there, and
    the greatest density to expect: a mixture is nowhere denser than the densest of what is mixed.

    Kept: while weights change from frame to frame, where something is does not.
    """
    known = _places.setdefault(avatar, OrderedDict())
    key = rows, hashlib.sha256(np.packbits(present.numpy()).tobytes()).digest()
    if key not in known:
        filled = torch.from_numpy(avatar.occupied[list(rows)])
        guides = torch.stack([guide_of(avatar, row) for row in rows])
        space = clearance_of((filled & present).any(0).numpy(), avatar.box_min, avatar.box_size)
        known[key] = filled, space, torch.where(present, guides, 0).amax(0)
        while len(known) > _KEPT:
            known.popitem(last=False)
    known.move_to_end(key)
    return known[key]


def _in_space(avatar: Avatar, shares: np.ndarray) -> np.ndarray:
    """Shares at vertices [V, K] -> at cells [K, G, G, G], or [K, 1, 1, 1] if all are the same.

    On the mesh a cell's are those of its nearest point; away from it, where the nearest point leaps
    from one part of the mesh to another, they are blurred.
    """
    if (shares == shares[:1]).all():
        return shares[0, :, None, None, None]
    about = _surroundings(avatar)
    size = avatar.occupied.shape[1]
    spread = np.zeros((shares.shape[1], size, size, size), np.float32)
    found = (shares[about.corners] * about.weights[..., None]).sum(1)
    for grid, values in zip(spread[1:], found.T[1:], strict=True):
        grid[about.cells] = values
        soft = ndimage.gaussian_filter(grid, _BLUR * size / avatar.box_size) / about.near
        grid += about.away * (soft - grid)
        grid[grid < _SOME] = 0
    spread[0] = 1 - spread[1:].sum(0)
    spread[0][spread[0] < _SOME] = 0
    return spread / spread.sum(0)


@dataclass(frozen=True, eq=False)
class _Surroundings:
    """cells: those that anything fills, as an index of a grid; of the mesh's points nearest to
    their middles the vertices, corners [N, 3], and weights [N, 3]; near [G, G, G]: the cells
    themselves, blurred; away [G, G, G]: how far from the mesh a cell is, from 0 to 1."""

    cells: tuple[np.ndarray, ...]
    corners: np.ndarray
    weights: np.ndarray
    near: np.ndarray
    away: np.ndarray


def _surroundings(avatar: Avatar) -> _Surroundings:
    """Computed once."""
    if avatar not in _nearest:
        cells = np.argwhere(avatar.occupied.any(0))
        size = avatar.occupied.shape[1]
        points = (cells + 0.5) / size * avatar.box_size + avatar.box_min
        deformer = deformer_of(avatar)
        mesh = deformer.pose(avatar.canonical_vertices)
        found = deformer.nearest(mesh, torch.from_numpy(points).float())
        triangle, weights, distance = (values.numpy() for values in found)
        index = tuple(cells.T)
        known, away = np.zeros((size,) * 3, np.float32), np.ones((size,) * 3, np.float32)
        known[index] = 1
        near = ndimage.gaussian_filter(known, _BLUR * size / avatar.box_size).clip(1e-9)
        away[index] = np.clip((distance - _CLOSE) / (_AWAY - _CLOSE), 0, 1)
        corners = avatar.triangles[triangle]
        _nearest[avatar] = _Surroundings(index, corners, weights, near, away)
    return _nearest[avatar]


def deformer_of(avatar: Avatar) -> Deformer:
    """The avatar's deformer, built once."""
    if avatar not in _deformers:
        _deformers[avatar] = Deformer(
            avatar.canonical_vertices, avatar.triangles, avatar.config.frames
        )
    return _deformers[avatar]


def space_of(avatar: Avatar, row: int) -> Clearance:
    """Where an appearance fills space, computed once."""
    known = _spaces.setdefault(avatar, {})
    if row not in known:
        known[row] = clearance_of(avatar.occupied[row], avatar.box_min, avatar.box_size)
    return known[row]


def guide_of(avatar: Avatar, row: int) -> torch.Tensor:
    """The density (1/m) of each cell [G, G, G] in an appearance, computed once."""
    known = _guides.setdefault(avatar, {})
    if row not in known:
        worn = avatar.field.wearing([row])
        person, occupied = code(avatar, row), avatar.occupied[row]
        known[row] = guide(avatar, deformer_of(avatar), worn, person, occupied)
    return known[row]


def clearance_of(occupied: np.ndarray, box_min: np.ndarray, box_size: float) -> Clearance:
    """The clearance grid of cells [G, G, G] bool over a cube."""
    return Clearance(
        torch.from_numpy(clearance(occupied)),
        torch.from_numpy(np.asarray(box_min, np.float32)),
        1 / box_size,
    )
