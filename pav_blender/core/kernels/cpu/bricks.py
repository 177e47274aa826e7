"""Cubes of posed space taken to canonical space, compiled; see `reference/bricks.py`."""

from __future__ import annotations

import numpy as np
import torch
from numba import njit

from ..reference.bricks import BRICK, FAR, FOOT, MAP, TORN, Found
from ..structures import Clearance, PosedMesh
from .lanes import (
    LANES,
    fma,
    load,
    maximum,
    minimum,
    select,
    splat,
    splat_int,
    store,
    to_float,
    to_int,
)
from .marching import grid_of, locate, rows_of, surface_of
from .search import LEAN, OPTIONS, STACK
from .threads import run_chunks

_CHUNK = 1024  # places a thread takes at a time: a multiple of LANES
_VOXELS = BRICK**3
_WIDTH = 12  # numbers of a vertex's map


def look(
    mesh: PosedMesh,
    space: Clearance,
    middles: torch.Tensor,
    near: float,
    margin: int,
    feet: torch.Tensor,
) -> Found:
    """As the reference; of what is not near, nothing is found at all."""
    count = len(middles)
    found = Found(
        torch.empty(count, dtype=torch.bool),
        torch.empty(count, dtype=torch.int32),
        torch.empty((count, 3)),
        torch.empty((count, 3)),
        torch.empty((count, 3)),
        torch.empty(count),
    )
    run_chunks(
        _look,
        count,
        _CHUNK,
        surface_of(mesh),
        grid_of(space),
        rows_of(middles, np.float32),
        np.float32(near),
        np.float32(margin),
        rows_of(feet, np.float32),
        tuple(values.numpy() for values in found),
    )
    return found


@njit(**LEAN)
def _cell_near(grid, x, y, z):
    """How many cells a filled one is off canonical (x, y, z)."""
    cells, size, corner, scale = grid
    flat, far = 0, 0
    for axis in range(3):
        place = ((x, y, z)[axis] - corner[axis]) * scale
        cell = int(np.floor(min(max(place, np.float32(-255.0)), np.float32(size + 255))))
        inside = min(max(cell, 0), size - 1)
        far = max(far, abs(cell - inside))
        flat = flat * size + inside
    return np.float32(max(far, int(cells[flat])))


@njit(**OPTIONS)
def _look(start, stop, surface, grid, middles, near, margin, feet, out):
    arrays, triangle_maps, vertex_maps, vertices, corners = surface
    kept, out_triangle, out_barycentric, out_foot, out_canonical, out_clear = out
    stack = np.empty(STACK, np.int32)
    scratch = np.empty(LANES, np.float32)
    foot = np.full(3 * LANES, np.inf, np.float32)
    canonical = np.empty(3 * LANES, np.float32)
    distances = np.empty(LANES, np.float32)
    barycentric = np.empty(3 * LANES, np.float32)
    triangle = np.empty(LANES, np.int32)
    points = np.empty(3 * LANES, np.float32)
    going = splat_int(0) < splat_int(1)
    end = np.float32(1.01) * near
    for base in range(start, stop, LANES):
        for i in range(LANES):
            row = min(base + i, stop - 1)
            gap = np.float32(0.0)
            for axis in range(3):
                points[axis * LANES + i] = middles[row, axis]
                if feet[row, 0] < np.inf:  # else the last packet's nearest point bounds the search
                    foot[axis * LANES + i] = feet[row, axis]
                gap += (foot[axis * LANES + i] - middles[row, axis]) ** 2
            if not gap < end * end:  # as does a place that is too far off to count
                for axis in range(3):
                    foot[axis * LANES + i] = middles[row, axis]
                foot[i] += end
        px, py, pz = load(points, 0), load(points, LANES), load(points, 2 * LANES)
        locate(arrays, triangle_maps, vertex_maps, vertices, corners, px, py, pz, going, near,
               stack, scratch, foot, triangle, barycentric, canonical, distances)  # fmt: skip
        for i in range(LANES):
            row = base + i
            if triangle[i] < 0:
                foot[i] = np.inf
            if row >= stop:
                continue
            close = triangle[i] >= 0 and distances[i] <= near
            clear = np.float32(np.inf)
            if close:
                x, y, z = canonical[i], canonical[LANES + i], canonical[2 * LANES + i]
                clear = _cell_near(grid, x, y, z)
            kept[row], out_triangle[row], out_clear[row] = clear <= margin, triangle[i], clear
            for axis in range(3):
                out_barycentric[row, axis] = barycentric[axis * LANES + i]
                out_foot[row, axis] = foot[axis * LANES + i]
                out_canonical[row, axis] = canonical[axis * LANES + i]


def brick_maps(mesh: PosedMesh, found: Found, middles: torch.Tensor) -> torch.Tensor:
    """As the reference."""
    maps = torch.zeros((len(middles), MAP))
    run_chunks(
        _brick_maps,
        len(middles),
        4096,
        surface_of(mesh),
        rows_of(found.triangle, np.int32),
        rows_of(found.barycentric, np.float32),
        rows_of(found.canonical, np.float32),
        rows_of(found.foot, np.float32),
        rows_of(middles, np.float32),
        maps.view(-1).numpy(),
    )
    return maps


@njit(**OPTIONS)
def _brick_maps(start, stop, surface, triangle, barycentric, canonical, foot, middles, out):
    _, triangle_maps, vertex_maps, _, corners = surface
    row = np.empty(LANES, np.float32)
    for brick in range(start, stop):
        index = max(triangle[brick], 0)
        if len(vertex_maps) == 0:
            store(row, 0, load(triangle_maps, index * _WIDTH))
        else:
            blend = splat(0.0)
            for j in range(3):
                map_of = load(vertex_maps, corners[3 * index + j] * _WIDTH)
                blend = fma(splat(barycentric[brick, j]), map_of, blend)
            store(row, 0, blend)
        for axis in range(3):
            moved = canonical[brick, axis]
            for j in range(3):
                value = row[4 * axis + j]
                out[brick * MAP + 4 * axis + j] = value
                moved -= value * middles[brick, j]
            out[brick * MAP + 4 * axis + 3] = moved
            out[brick * MAP + FOOT + axis] = foot[brick, axis]


def brick_cells(
    rows: torch.Tensor,
    found: Found,
    maps: torch.Tensor,
    space: Clearance,
    voxel: float,
    margin: int,
) -> torch.Tensor:
    """As the reference, up to the rounding of the places."""
    cells = torch.empty((len(rows), _VOXELS), dtype=torch.int32)
    run_chunks(
        _brick_cells,
        len(cells),
        512,
        rows_of(rows, np.int64),
        rows_of(found.canonical, np.float32),
        rows_of(found.clear, np.float32),
        rows_of(maps, np.float32),
        grid_of(space),
        _offsets(voxel),
        np.float32(margin),
        cells.view(-1).numpy(),
    )
    return cells


def _offsets(voxel: float) -> np.ndarray:
    """Where a brick's voxels lie from its middle: x, y and z, one after the other."""
    within = np.indices((BRICK,) * 3).reshape(-1)
    return ((within + 0.5 - BRICK / 2) * voxel).astype(np.float32)


@njit(**LEAN)
def _split(place, last):
    """Cells along one axis, the nearest there is, and by how many these are off."""
    whole = minimum(maximum(place, splat(-3.0)), last + splat(4.0))
    whole = to_float(to_int(whole + splat(4.0))) - splat(4.0)
    inside = minimum(maximum(whole, splat(0.0)), last)
    return to_int(inside), maximum(whole - inside, inside - whole)


@njit(**LEAN)
def _fill(out, at, x, y, z, maps, brick, grid, offsets, scratch):
    """Cells of a brick's voxels that have none yet, its middle lying at canonical (x, y, z)."""
    cells, size, corner, scale = grid
    row = maps[brick]
    last, wide = splat(np.float32(size - 1)), splat_int(size)
    for i in range(0, _VOXELS, LANES):
        u, v, w = load(offsets, i), load(offsets, _VOXELS + i), load(offsets, 2 * _VOXELS + i)
        flat, far = splat_int(0), splat(0.0)
        for axis in range(3):
            place = splat(((x, y, z)[axis] - corner[axis]) * scale)
            place = fma(u, splat(row[4 * axis] * scale), place)
            place = fma(v, splat(row[4 * axis + 1] * scale), place)
            place = fma(w, splat(row[4 * axis + 2] * scale), place)
            inside, off = _split(place, last)
            flat, far = flat * wide + inside, maximum(far, off)
        store(scratch, 0, select(far < splat(1.5), flat, splat_int(-1)))
        for k in range(LANES):
            cell = scratch[k]
            if cell >= 0 and cells[cell] <= 1 and out[at + i + k] < 0:
                out[at + i + k] = cell


@njit(**OPTIONS)
def _brick_cells(start, stop, rows, canonical, clear, maps, grid, offsets, margin, out):
    scratch = np.empty(LANES, np.int32)
    for number in range(start, stop):
        brick = rows[number]
        for i in range(0, _VOXELS, LANES):
            store(out, number * _VOXELS + i, splat_int(-1))
        if clear[brick] <= margin:
            x, y, z = canonical[brick, 0], canonical[brick, 1], canonical[brick, 2]
            _fill(out, number * _VOXELS, x, y, z, maps, brick, grid, offsets, scratch)


def leaps(
    at: torch.Tensor, places: torch.Tensor, canonical: torch.Tensor, maps: torch.Tensor, side: float
) -> torch.Tensor:
    """As the reference, up to the rounding of the places."""
    found = torch.zeros(len(maps))
    run_chunks(_leaps, len(maps), 2048, *_cubes(at, places, canonical, maps, side), found.numpy())
    return found


def _cubes(
    at: torch.Tensor, places: torch.Tensor, canonical: torch.Tensor, maps: torch.Tensor, side: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.float32]:
    return (
        rows_of(at, np.int32),
        rows_of(places, np.int32),
        rows_of(canonical, np.float32),
        rows_of(maps, np.float32),
        np.float32(side),
    )


@njit(**LEAN)
def _beside(at, places, canonical, maps, side, cube, direction):
    """The cube beside one in a direction of six, or -1; where its map takes the first one's middle,
    and how far that is from where it is."""
    axis, sign = direction // 2, 1 - 2 * (direction % 2)
    u, v, w = places[cube, 0], places[cube, 1], places[cube, 2]
    beside = at[u + (sign if axis == 0 else 0), v + (sign if axis == 1 else 0),
                w + (sign if axis == 2 else 0)]  # fmt: skip
    nothing = np.float32(0)
    if beside < 0:
        return beside, nothing, nothing, nothing, nothing
    back = np.float32(sign) * side
    x = canonical[beside, 0] - back * maps[beside, axis]
    y = canonical[beside, 1] - back * maps[beside, 4 + axis]
    z = canonical[beside, 2] - back * maps[beside, 8 + axis]
    leap = max(abs(x - canonical[cube, 0]), abs(y - canonical[cube, 1]),
               abs(z - canonical[cube, 2]))  # fmt: skip
    return beside, x, y, z, leap


@njit(**OPTIONS)
def _leaps(start, stop, at, places, canonical, maps, side, out):
    for cube in range(start, stop):
        for direction in range(6):
            leap = _beside(at, places, canonical, maps, side, cube, direction)[4]
            out[cube] = max(out[cube], leap)


def likely(
    canonical: torch.Tensor,
    maps: torch.Tensor,
    leaps: torch.Tensor,
    space: Clearance,
    side: float,
    margin: int,
) -> torch.Tensor:
    """As the reference, up to the rounding of the places."""
    found = torch.empty((len(maps), 8), dtype=torch.bool)
    run_chunks(
        _likely,
        len(maps),
        1024,
        rows_of(canonical, np.float32),
        rows_of(maps, np.float32),
        rows_of(leaps, np.float32),
        grid_of(space),
        np.float32(side / 4),
        np.float32(margin),
        found.numpy(),
    )
    return found


@njit(**OPTIONS)
def _likely(start, stop, canonical, maps, leaps, grid, quarter, margin, out):
    scale = grid[3]
    for cube in range(start, stop):
        most = margin + np.ceil(leaps[cube] * scale)
        row = maps[cube]
        for child in range(8):
            if leaps[cube] > np.float32(FAR):
                out[cube, child] = True
                continue
            u = quarter if child & 4 else -quarter
            v = quarter if child & 2 else -quarter
            w = quarter if child & 1 else -quarter
            x = canonical[cube, 0] + row[0] * u + row[1] * v + row[2] * w
            y = canonical[cube, 1] + row[4] * u + row[5] * v + row[6] * w
            z = canonical[cube, 2] + row[8] * u + row[9] * v + row[10] * w
            out[cube, child] = _cell_near(grid, x, y, z) <= most


def add_torn(
    cells: torch.Tensor,
    rows: torch.Tensor,
    at: torch.Tensor,
    places: torch.Tensor,
    canonical: torch.Tensor,
    maps: torch.Tensor,
    space: Clearance,
    voxel: float,
    margin: int,
) -> None:
    """As the reference, up to the rounding of the places."""
    run_chunks(
        _add_torn,
        len(cells),
        2048,
        rows_of(rows, np.int64),
        *_cubes(at, places, canonical, maps, BRICK * voxel),
        grid_of(space),
        _offsets(voxel),
        np.float32(margin),
        cells.view(-1).numpy(),
    )


@njit(**OPTIONS)
def _add_torn(start, stop, rows, at, places, canonical, maps, side, grid, offsets, margin, out):
    scratch = np.empty(LANES, np.int32)
    for number in range(start, stop):
        brick = rows[number]
        for direction in range(6):
            beside, x, y, z, leap = _beside(at, places, canonical, maps, side, brick, direction)
            if leap > np.float32(TORN) and _cell_near(grid, x, y, z) <= margin:
                _fill(out, number * _VOXELS, x, y, z, maps, beside, grid, offsets, scratch)
