"""The search tree over a mesh's triangles, and its traversal by sixteen points at once.

The tree is complete, sixteen children a node: node i of a level holds nodes 16 i .. 16 i + 15 of
the level below, and triangles are the lowest level, so there is nothing to chase. Its order comes
from the rest mesh once; a pose only refits the boxes. A packet of sixteen points walks it as one:
its box is tested against sixteen child boxes in a dozen instructions, and a triangle that survives
is measured for all sixteen points without a branch.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from . import simd
from .simd import LANES

# Floats of a triangle in `records`: corner a, axes X, Y, N of its plane, then in plane coordinates
# (a at 0, b at (length, 0), c at (cx, cy)) length, cx, cy, 1/|ac|^2, 1/|bc|^2 and 1/length, 1/cy.
RECORD = 20
# A triangle lower than this fraction of its longest edge has no usable plane: never chosen.
FLATNESS = 1e-5
_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
_INLINE: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


def build_order(centroids: np.ndarray) -> np.ndarray:
    """An order of triangles [T] in which every aligned run of 16, 256, ... is compact.

    Halves along the longest side, each cut at a multiple of the size of a subtree.
    """
    order = np.arange(len(centroids))
    stack = [(0, len(order))]
    while stack:
        start, stop = stack.pop()
        count = stop - start
        if count <= 2:
            continue
        whole = LANES
        while whole * LANES < count:
            whole *= LANES
        if count <= LANES:
            whole = 1
        cut = start + max(whole, round(count / 2 / whole) * whole)
        if cut >= stop:
            continue
        part = order[start:stop]
        places = centroids[part]
        axis = int(np.argmax(np.ptp(places, axis=0)))
        order[start:stop] = part[np.argpartition(places[:, axis], cut - start)]
        stack += [(start, cut), (cut, stop)]
    return order.astype(np.int32)


def level_sizes(slots: int) -> list[int]:
    """Nodes of each level from the triangles' parents up to the single root."""
    sizes = [-(-max(slots, 1) // LANES)]
    while sizes[-1] > 1:
        sizes.append(-(-sizes[-1] // LANES))
    return sizes


@njit(**_OPTIONS)
def fit_triangles(start, stop, vertices, corners, order, records, boxes, usable):
    """Records and boxes of the triangles in slots start..stop, in float64 up to the rounding.

    A degenerate triangle gets an empty box, which no search enters.
    """
    for slot in range(start, stop):
        triangle = order[slot]
        ax, ay, az = np.float64(0), np.float64(0), np.float64(0)
        usable_here = False
        if triangle >= 0:
            a, b, c = corners[triangle, 0], corners[triangle, 1], corners[triangle, 2]
            ax, ay, az = vertices[a, 0], vertices[a, 1], vertices[a, 2]
            bx, by, bz = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
            dx, dy, dz = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
            nx, ny, nz = by * dz - bz * dy, bz * dx - bx * dz, bx * dy - by * dx
            area = np.sqrt(nx * nx + ny * ny + nz * nz)
            bb, cc = bx * bx + by * by + bz * bz, dx * dx + dy * dy + dz * dz
            ex, ey, ez = dx - bx, dy - by, dz - bz
            ee = ex * ex + ey * ey + ez * ez
            usable_here = area > FLATNESS * max(bb, cc, ee)
            usable[triangle] = usable_here
        node, lane = slot // LANES, slot % LANES
        box = node * 6 * LANES + lane
        if not usable_here:
            for axis in range(3):
                boxes[box + axis * LANES] = np.inf
                boxes[box + (axis + 3) * LANES] = -np.inf
            for i in range(RECORD):
                records[slot * RECORD + i] = 0.0
            records[slot * RECORD] = np.inf
            continue
        length = np.sqrt(bb)
        xx, xy, xz = bx / length, by / length, bz / length
        nx, ny, nz = nx / area, ny / area, nz / area
        yx, yy, yz = ny * xz - nz * xy, nz * xx - nx * xz, nx * xy - ny * xx
        cx, cy = dx * xx + dy * xy + dz * xz, area / length
        record = records[slot * RECORD : slot * RECORD + RECORD]
        record[0], record[1], record[2] = ax, ay, az
        record[3], record[4], record[5] = xx, xy, xz
        record[6], record[7], record[8] = yx, yy, yz
        record[9], record[10], record[11] = nx, ny, nz
        record[12], record[13], record[14] = length, cx, cy
        record[15], record[16] = 1.0 / cc, 1.0 / ee
        record[17], record[18], record[19] = 1.0 / length, 1.0 / cy, 0.0
        for axis in range(3):
            p, q, r = vertices[a, axis], vertices[b, axis], vertices[c, axis]
            low, high = min(p, q, r), max(p, q, r)
            # Wider than any rounding of the distance to what is inside.
            pad = np.float32(4e-7) * (abs(low) + abs(high))
            boxes[box + axis * LANES] = low - pad
            boxes[box + (axis + 3) * LANES] = high + pad


@njit(**_OPTIONS)
def fit_levels(boxes, starts):
    """Boxes of the nodes from those of their children, level by level."""
    for level in range(1, len(starts) - 1):
        below = (starts[level] - starts[level - 1]) // (6 * LANES)
        nodes = (starts[level + 1] - starts[level]) // (6 * LANES)
        for child in range(nodes * LANES):
            target = starts[level] + (child // LANES) * 6 * LANES + child % LANES
            source = starts[level - 1] + child * 6 * LANES
            for axis in range(3):
                low, high = np.float32(np.inf), np.float32(-np.inf)
                if child < below:
                    for lane in range(LANES):
                        low = min(low, boxes[source + axis * LANES + lane])
                        high = max(high, boxes[source + (axis + 3) * LANES + lane])
                boxes[target + axis * LANES] = low
                boxes[target + (axis + 3) * LANES] = high


@njit(**_INLINE)
def _clamp(x):
    return simd.minimum(simd.maximum(x, simd.splat(0.0)), simd.splat(1.0))


@njit(**_INLINE)
def measure(records, slot, px, py, pz):
    """Squared distance of sixteen points to the triangle in a slot."""
    r = slot * RECORD
    dx = px - simd.splat(records[r])
    dy = py - simd.splat(records[r + 1])
    dz = pz - simd.splat(records[r + 2])
    x = simd.splat(records[r + 3]) * dx
    x = simd.fma(simd.splat(records[r + 4]), dy, x)
    x = simd.fma(simd.splat(records[r + 5]), dz, x)
    y = simd.splat(records[r + 6]) * dx
    y = simd.fma(simd.splat(records[r + 7]), dy, y)
    y = simd.fma(simd.splat(records[r + 8]), dz, y)
    z = simd.splat(records[r + 9]) * dx
    z = simd.fma(simd.splat(records[r + 10]), dy, z)
    z = simd.fma(simd.splat(records[r + 11]), dz, z)
    zero = simd.splat(0.0)
    length, cx, cy = records[r + 12], simd.splat(records[r + 13]), simd.splat(records[r + 14])
    ex = simd.splat(records[r + 13] - length)
    beyond = x - simd.splat(length)
    # Edges ab, ac, bc in the plane.
    gap = simd.maximum(simd.maximum(beyond, zero - x), zero)
    yy = y * y
    best = simd.fma(gap, gap, yy)
    t = _clamp(simd.fma(x, cx, y * cy) * simd.splat(records[r + 15]))
    gx, gy = x - t * cx, y - t * cy
    best = simd.minimum(best, simd.fma(gx, gx, gy * gy))
    t = _clamp(simd.fma(beyond, ex, y * cy) * simd.splat(records[r + 16]))
    gx, gy = beyond - t * ex, y - t * cy
    best = simd.minimum(best, simd.fma(gx, gx, gy * gy))
    inside = simd.minimum(y, simd.minimum(cy * x - cx * y, ex * y - cy * beyond))
    best = simd.select(zero <= inside, zero, best)
    return simd.fma(z, z, best)


@njit(**_INLINE)
def _box_distance(boxes, start, lx, ly, lz, hx, hy, hz):
    """Squared distance of one box to sixteen child boxes."""
    zero = simd.splat(0.0)
    dx = simd.maximum(
        simd.maximum(simd.load(boxes, start) - hx, lx - simd.load(boxes, start + 3 * LANES)), zero
    )
    dy = simd.maximum(
        simd.maximum(
            simd.load(boxes, start + LANES) - hy, ly - simd.load(boxes, start + 4 * LANES)
        ),
        zero,
    )
    dz = simd.maximum(
        simd.maximum(
            simd.load(boxes, start + 2 * LANES) - hz, lz - simd.load(boxes, start + 5 * LANES)
        ),
        zero,
    )
    return simd.fma(dx, dx, simd.fma(dy, dy, dz * dz))


@njit(**_INLINE)
def search(tree, px, py, pz, seed, stack_node, stack_distance, scratch, counters):
    """Nearest slot of sixteen points (all finite) and its squared distance; -1, inf for none.

    `seed` is a slot likely to be near, or -1. Ties go to the lowest triangle index.
    """
    boxes, starts, records, order = tree
    lx, hx = simd.splat(simd.smallest(px)), simd.splat(simd.largest(px))
    ly, hy = simd.splat(simd.smallest(py)), simd.splat(simd.largest(py))
    lz, hz = simd.splat(simd.smallest(pz)), simd.splat(simd.largest(pz))
    best = simd.splat(np.inf)
    found = simd.splat_int(-1)
    if seed >= 0:
        distance = measure(records, seed, px, py, pz)
        closer = distance < best  # not where the seed is degenerate in this pose
        best = simd.select(closer, distance, best)
        found = simd.select(closer, simd.splat_int(seed), found)
    # Rounding must not hide a tie: boxes are padded, the bound is a little generous.
    bound = simd.largest(best) * np.float32(1.000001)
    top = len(starts) - 2
    stack_node[0] = 0
    stack_distance[0] = 0.0
    level_bits = 26
    stack_node[0] = top << level_bits
    size = 1
    while size > 0:
        size -= 1
        if stack_distance[size] > bound:
            continue
        entry = stack_node[size]
        level, node = entry >> level_bits, entry & ((1 << level_bits) - 1)
        start = starts[level] + node * 6 * LANES
        near = _box_distance(boxes, start, lx, ly, lz, hx, hy, hz)
        counters[0] += 1
        word = simd.bits(near <= simd.splat(bound))
        if level > 0:
            simd.store(scratch, 0, near)
            least = np.float32(np.inf)
            least_at = size
            while word != 0:
                child = simd.lowest_bit(word)
                word &= word - 1
                distance_child = scratch[child]
                if distance_child < np.inf:
                    if distance_child < least:
                        least = distance_child
                        least_at = size
                    stack_node[size] = ((level - 1) << level_bits) + node * LANES + child
                    stack_distance[size] = distance_child
                    size += 1
            if least < np.inf:  # the nearest child is next
                last = size - 1
                stack_node[least_at], stack_node[last] = stack_node[last], stack_node[least_at]
                stack_distance[least_at], stack_distance[last] = (
                    stack_distance[last],
                    stack_distance[least_at],
                )
            continue
        while word != 0:
            child = simd.lowest_bit(word)
            word &= word - 1
            slot = node * LANES + child
            distance = measure(records, slot, px, py, pz)
            counters[1] += 1
            closer = distance < best
            if simd.bits(closer) != 0:
                best = simd.select(closer, distance, best)
                found = simd.select(closer, simd.splat_int(slot), found)
                bound = simd.largest(best) * np.float32(1.000001)
                word &= simd.bits(near <= simd.splat(bound))
    return best, found


@njit(**_OPTIONS)
def raw(start, stop, points, tree, out_slot, out_d, counters):
    stack_node = np.empty(16 * 8, np.int32)
    stack_distance = np.empty(16 * 8, np.float32)
    scratch = np.empty(16, np.float32)
    x = np.empty(16, np.float32)
    y = np.empty(16, np.float32)
    z = np.empty(16, np.float32)
    seed = np.int32(-1)
    for p in range(start, stop, 16):
        for i in range(16):
            q = min(p + i, stop - 1)
            x[i] = points[q, 0]
            y[i] = points[q, 1]
            z[i] = points[q, 2]
        best, found = search(
            tree, simd.load(x, 0), simd.load(y, 0), simd.load(z, 0), seed,
            stack_node, stack_distance, scratch, counters,
        )
        seed = simd.lane(found, 15)
        simd.store(out_slot, p, found)
        simd.store(out_d, p, best)
