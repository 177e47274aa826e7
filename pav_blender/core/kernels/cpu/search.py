"""The search tree over a mesh's triangles, and its traversal by `LANES` points at once.

The tree is complete, sixteen children a node: node i of a level holds nodes 16 i .. 16 i + 15 of
the level below, and triangles are the lowest level, so there is nothing to chase. Its order comes
from the rest mesh once; a pose only refits the boxes. A packet of points walks it as one: the box
around the packet is tested against sixteen child boxes in a dozen instructions; what survives is
tested by every point against its own bound, and a triangle that survives that is measured for all
points without a branch.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from .lanes import (
    LANES,
    bits,
    fma,
    gather,
    largest,
    load,
    lowest_bit,
    maximum,
    minimum,
    select,
    smallest,
    splat,
    splat_int,
    store,
)

OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
INLINE: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
# for what makes no arrays: they are not counted on the way in and out, which took a tenth of the
# time of small functions that are given many
LEAN: dict[str, Any] = {**INLINE, "_nrt": False}

# Floats of a triangle in `records`: corner a, axes X, Y, N of its plane, then in plane coordinates
# (a at 0, b at (length, 0), c at (cx, cy)) length, cx, cy, 1/|ac|^2, 1/|bc|^2, 1/length, 1/cy.
RECORD = 20
# A triangle lower than this fraction of its longest edge has no usable plane: never chosen.
FLATNESS = 1e-5
_BOX = 6 * LANES  # floats of a node: the least x, y, z then the greatest of its children
_LEVEL_BITS = 26
STACK = 12 * LANES


def build_order(centroids: np.ndarray) -> np.ndarray:
    """An order of triangles [T] in which every aligned run of 16, 256, ... is compact.

    Halves along the longest side, each cut at a multiple of the size of a subtree.
    """
    order = np.arange(len(centroids))
    stack = [(0, len(order))]
    while stack:
        start, stop = stack.pop()
        count = stop - start
        if count <= LANES:
            continue
        whole = LANES
        while whole * LANES < count:
            whole *= LANES
        cut = start + max(whole, round(count / 2 / whole) * whole)
        if cut >= stop:
            continue
        part = order[start:stop]
        places = centroids[part]
        axis = int(np.argmax(np.ptp(places, axis=0)))
        order[start:stop] = part[np.argpartition(places[:, axis], cut - start)]
        stack += [(start, cut), (cut, stop)]
    return order.astype(np.int32)


def level_starts(slots: int) -> np.ndarray:
    """Where the boxes of each level begin, from the triangles' parents up to the single root."""
    sizes = [-(-max(slots, 1) // LANES)]
    while sizes[-1] > 1:
        sizes.append(-(-sizes[-1] // LANES))
    return np.concatenate([[0], np.cumsum(sizes) * _BOX]).astype(np.int64)


@njit(**OPTIONS)
def fit_triangles(start, stop, vertices, corners, order, records, boxes, usable):
    """Records and boxes of the triangles in slots start..stop, in float64 up to the rounding.

    A degenerate triangle gets an empty box, which no search enters.
    """
    for slot in range(start, stop):
        triangle = order[slot]
        base = slot * RECORD
        box = (slot // LANES) * _BOX + slot % LANES
        good = False
        if triangle >= 0:
            a, b, c = corners[triangle, 0], corners[triangle, 1], corners[triangle, 2]
            ax, ay, az = (
                np.float64(vertices[a, 0]),
                np.float64(vertices[a, 1]),
                np.float64(vertices[a, 2]),
            )
            bx, by, bz = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
            dx, dy, dz = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
            nx, ny, nz = by * dz - bz * dy, bz * dx - bx * dz, bx * dy - by * dx
            area = np.sqrt(nx * nx + ny * ny + nz * nz)
            bb, cc = bx * bx + by * by + bz * bz, dx * dx + dy * dy + dz * dz
            ee = (dx - bx) ** 2 + (dy - by) ** 2 + (dz - bz) ** 2
            good = area > FLATNESS * max(bb, cc, ee) and area < np.inf
            usable[triangle] = good
            if good:
                length = np.sqrt(bb)
                xx, xy, xz = bx / length, by / length, bz / length
                nx, ny, nz = nx / area, ny / area, nz / area
                records[base], records[base + 1], records[base + 2] = ax, ay, az
                records[base + 3], records[base + 4], records[base + 5] = xx, xy, xz
                records[base + 6] = ny * xz - nz * xy
                records[base + 7] = nz * xx - nx * xz
                records[base + 8] = nx * xy - ny * xx
                records[base + 9], records[base + 10], records[base + 11] = nx, ny, nz
                records[base + 12] = length
                records[base + 13] = dx * xx + dy * xy + dz * xz
                records[base + 14] = area / length
                records[base + 15], records[base + 16] = 1.0 / cc, 1.0 / ee
                records[base + 17], records[base + 18] = 1.0 / length, length / area
                records[base + 19] = 0.0
                for axis in range(3):
                    p, q, r = vertices[a, axis], vertices[b, axis], vertices[c, axis]
                    low, high = min(p, q, r), max(p, q, r)
                    # Wider than any rounding of the distance to what is inside.
                    pad = np.float32(4e-7) * (abs(low) + abs(high))
                    boxes[box + axis * LANES] = low - pad
                    boxes[box + (axis + 3) * LANES] = high + pad
        if not good:
            for i in range(RECORD):
                records[base + i] = 0.0
            records[base] = np.inf
            for axis in range(3):
                boxes[box + axis * LANES] = np.inf
                boxes[box + (axis + 3) * LANES] = -np.inf


@njit(**OPTIONS)
def fit_levels(boxes, starts):
    """Boxes of the nodes from those of their children, level by level."""
    for level in range(1, len(starts) - 1):
        below = (starts[level] - starts[level - 1]) // _BOX
        nodes = (starts[level + 1] - starts[level]) // _BOX
        for child in range(nodes * LANES):
            target = starts[level] + (child // LANES) * _BOX + child % LANES
            source = starts[level - 1] + child * _BOX
            for axis in range(3):
                low, high = np.float32(np.inf), np.float32(-np.inf)
                if child < below:
                    for i in range(LANES):
                        low = min(low, boxes[source + axis * LANES + i])
                        high = max(high, boxes[source + (axis + 3) * LANES + i])
                boxes[target + axis * LANES] = low
                boxes[target + (axis + 3) * LANES] = high


@njit(**LEAN)
def _clamp(x):
    return minimum(maximum(x, splat(0.0)), splat(1.0))


@njit(**LEAN)
def _to_plane(x, y, z, dx, dy, dz):
    return fma(z, dz, fma(y, dy, x * dx))


@njit(**LEAN)
def _in_plane(x, y, z, length, cx, cy, inverse_ac, inverse_bc, inverse_length, inverse_cy):
    """Squared distance of plane coordinates (x, y, height z), barycentrics of the nearest point.

    Weights that vanish on an edge or at a corner are 0 exactly.
    """
    zero, one = splat(0.0), splat(1.0)
    beyond, ex = x - length, cx - length
    wb = _clamp(x * inverse_length)
    wa, wc = one - wb, zero
    gap = maximum(maximum(beyond, zero - x), zero)
    best = fma(gap, gap, y * y)
    t = _clamp(fma(x, cx, y * cy) * inverse_ac)
    gx, gy = x - t * cx, y - t * cy
    distance = fma(gx, gx, gy * gy)
    closer = distance < best
    best = select(closer, distance, best)
    wa, wb, wc = select(closer, one - t, wa), select(closer, zero, wb), select(closer, t, wc)
    t = _clamp(fma(beyond, ex, y * cy) * inverse_bc)
    gx, gy = beyond - t * ex, y - t * cy
    distance = fma(gx, gx, gy * gy)
    closer = distance < best
    best = select(closer, distance, best)
    wa, wb, wc = select(closer, zero, wa), select(closer, one - t, wb), select(closer, t, wc)
    inside = zero <= minimum(y, minimum(cy * x - cx * y, ex * y - cy * beyond))
    best = select(inside, zero, best)
    inner_c = _clamp(y * inverse_cy)
    inner_b = _clamp((x - inner_c * cx) * inverse_length)
    wa = select(inside, _clamp(one - inner_b - inner_c), wa)
    wb, wc = select(inside, inner_b, wb), select(inside, inner_c, wc)
    return fma(z, z, best), wa, wb, wc


@njit(**LEAN)
def measure(records, slot, px, py, pz):
    """Squared distance of the packet's points to the triangle in one slot."""
    r = slot * RECORD
    dx, dy, dz = px - splat(records[r]), py - splat(records[r + 1]), pz - splat(records[r + 2])
    x = _to_plane(splat(records[r + 3]), splat(records[r + 4]), splat(records[r + 5]), dx, dy, dz)
    y = _to_plane(splat(records[r + 6]), splat(records[r + 7]), splat(records[r + 8]), dx, dy, dz)
    z = _to_plane(splat(records[r + 9]), splat(records[r + 10]), splat(records[r + 11]), dx, dy, dz)
    squared, _, _, _ = _in_plane(
        x,
        y,
        z,
        splat(records[r + 12]),
        splat(records[r + 13]),
        splat(records[r + 14]),
        splat(records[r + 15]),
        splat(records[r + 16]),
        splat(records[r + 17]),
        splat(records[r + 18]),
    )
    return squared


@njit(**LEAN)
def foot(records, slots, px, py, pz):
    """Each point's nearest point on the triangle in its own slot: barycentrics, then the place."""
    r = slots * splat_int(RECORD)
    ax, ay, az = gather(records, r, 0), gather(records, r, 1), gather(records, r, 2)
    xx, xy, xz = gather(records, r, 3), gather(records, r, 4), gather(records, r, 5)
    yx, yy, yz = gather(records, r, 6), gather(records, r, 7), gather(records, r, 8)
    length, cx, cy = gather(records, r, 12), gather(records, r, 13), gather(records, r, 14)
    dx, dy, dz = px - ax, py - ay, pz - az
    _, wa, wb, wc = _in_plane(
        _to_plane(xx, xy, xz, dx, dy, dz),
        _to_plane(yx, yy, yz, dx, dy, dz),
        splat(0.0),
        length,
        cx,
        cy,
        gather(records, r, 15),
        gather(records, r, 16),
        gather(records, r, 17),
        gather(records, r, 18),
    )
    u, v = fma(wb, length, wc * cx), wc * cy
    qx = fma(xx, u, fma(yx, v, ax))
    qy = fma(xy, u, fma(yy, v, ay))
    qz = fma(xz, u, fma(yz, v, az))
    return wa, wb, wc, qx, qy, qz


@njit(**LEAN)
def _gap(low, high, least, greatest):
    """How far apart two intervals are, 0 where they meet."""
    return maximum(maximum(low - greatest, least - high), splat(0.0))


@njit(**LEAN)
def _packet_distances(boxes, start, lx, ly, lz, hx, hy, hz):
    """Squared distance of the packet's box to the children of the node at `start`."""
    dx = _gap(load(boxes, start), load(boxes, start + 3 * LANES), lx, hx)
    dy = _gap(load(boxes, start + LANES), load(boxes, start + 4 * LANES), ly, hy)
    dz = _gap(load(boxes, start + 2 * LANES), load(boxes, start + 5 * LANES), lz, hz)
    return fma(dx, dx, fma(dy, dy, dz * dz))


@njit(**LEAN)
def _may_hold(boxes, at, px, py, pz, bound):
    """Whether any point is nearer than its bound to the box whose numbers begin at `at`."""
    dx = _gap(splat(boxes[at]), splat(boxes[at + 3 * LANES]), px, px)
    dy = _gap(splat(boxes[at + LANES]), splat(boxes[at + 4 * LANES]), py, py)
    dz = _gap(splat(boxes[at + 2 * LANES]), splat(boxes[at + 5 * LANES]), pz, pz)
    return bits(fma(dx, dx, fma(dy, dy, dz * dz)) <= bound) != 0


@njit(**LEAN)
def search(boxes, starts, records, px, py, pz, best, found, stack, scratch):
    """Squared distance and slot of the triangle nearest to each point (all must be finite).

    `best`, `found` hold what is known: a bound that is certain to be reached (or infinity), and the
    slot it came from or -1. Only what is closer than `best` replaces it, or as close in an earlier
    slot: the answer does not depend on the way there.
    """
    lx, hx = splat(smallest(px)), splat(largest(px))
    ly, hy = splat(smallest(py)), splat(largest(py))
    lz, hz = splat(smallest(pz)), splat(largest(pz))
    # Boxes are padded and bounds generous, so that rounding hides no triangle.
    slack = np.float32(1.000001)
    bound = largest(best) * slack
    top = len(starts) - 2
    stack[0] = top << _LEVEL_BITS
    size = 1
    while size > 0:
        size -= 1
        entry = stack[size]
        level, node = entry >> _LEVEL_BITS, entry & ((1 << _LEVEL_BITS) - 1)
        if level < top:
            at = starts[level + 1] + (node // LANES) * _BOX + node % LANES
            if not _may_hold(boxes, at, px, py, pz, best * splat(slack)):
                continue
        start = starts[level] + node * _BOX
        near = _packet_distances(boxes, start, lx, ly, lz, hx, hy, hz)
        word = bits(near <= splat(bound))
        if level > 0:
            store(scratch, 0, near)
            least, least_at = np.float32(np.inf), size
            while word != 0:
                child = lowest_bit(word)
                word &= word - 1
                if scratch[child] < np.inf:  # an empty box passes where nothing is known yet
                    if scratch[child] < least:
                        least, least_at = scratch[child], size
                    stack[size] = ((level - 1) << _LEVEL_BITS) + node * LANES + child
                    size += 1
            if least < np.inf:  # the nearest child is next
                stack[least_at], stack[size - 1] = stack[size - 1], stack[least_at]
            continue
        while word != 0:
            child = lowest_bit(word)
            word &= word - 1
            if not _may_hold(boxes, start + child, px, py, pz, best * splat(slack)):
                continue
            slot = node * LANES + child
            squared = measure(records, slot, px, py, pz)
            here = splat_int(slot)
            closer = (squared < best) | ((squared == best) & (here < found))
            if bits(closer) != 0:
                best = select(closer, squared, best)
                found = select(closer, here, found)
                bound = largest(best) * slack
                word &= bits(near <= splat(bound))
    return best, found
