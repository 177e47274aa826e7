"""Which vertices and faces the head keeps, its new eyeballs, and how targets act on them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tools.builtin_head.makehuman import MakeHuman

METRES = 0.1  # MakeHuman works in decimetres
_CHEST = 3.9  # decimetres: the torso is cut at this height
_ARM = (2.75, 5.2)  # and an arm, which hangs at 45 degrees, this far along it from this height
_LEAST_SHARE = 0.15  # of an edge that stays where the cut nearly meets its inner end: no slivers
# Solid parts and how far they move, decimetres: MakeHuman's teeth show between closed lips, and
# its upper row hides in an open mouth
_SOLID = {
    "helper-upper-teeth": (0.0, -0.020, -0.015),
    "helper-lower-teeth": (0.0, -0.020, -0.030),
    "helper-tongue": (0.0, -0.010, -0.020),
}
_MOUTH_PULL = 0.10  # the back of the mouth shrinks by this, so that it stays inside all cheeks
_MOUTH_RINGS = 5  # of quads from the lips until all of it counts as the back
_SIDES = ("left", "right")  # MakeHuman's l is +x, the person's left
# Angles of an eyeball's rings from its gaze axis, degrees: pupil, iris and limbus get rings of
# their own, the hidden back half few
_RINGS = np.radians((6.0, 12.0, 19.0, 26.5, 36.0, 47.0, 60.0, 76.0, 95.0, 120.0, 150.0))
_SEGMENTS = 20


@dataclass(frozen=True)
class Eyeball:
    """A sphere of rings round a gaze axis of +z, unit radius."""

    points: np.ndarray  # [N,3]
    triangles: np.ndarray  # [K,3]
    uvs: np.ndarray  # [N,2] unit disc, angle from the axis as radius (the back pole is left open)


def eyeball() -> Eyeball:
    azimuth = np.arange(_SEGMENTS) * 2 * np.pi / _SEGMENTS
    around = np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
    rings = [
        np.concatenate([np.sin(a) * around, np.full((_SEGMENTS, 1), np.cos(a))], 1) for a in _RINGS
    ]
    points = np.concatenate([[[0.0, 0.0, 1.0]], *rings])
    uvs = np.concatenate([[[0.0, 0.0]], *(a / _RINGS[-1] * around for a in _RINGS)])
    near = np.arange(_SEGMENTS)
    far = np.roll(near, -1)
    triangles = [np.stack([np.zeros_like(near), 1 + near, 1 + far], 1)]
    for ring in range(len(_RINGS) - 1):
        a, b = 1 + ring * _SEGMENTS, 1 + (ring + 1) * _SEGMENTS
        triangles.append(np.stack([a + near, b + near, b + far], 1))
        triangles.append(np.stack([a + near, b + far, a + far], 1))
    return Eyeball(points, np.concatenate(triangles), uvs)


class Cut:
    """The head's vertices: those of MakeHuman's mesh first, then the two eyeballs.

    Head vertex v is ``(1 - share[v]) * inner[v] + share[v] * outer[v]`` in MakeHuman's numbering:
    itself, or a place on an edge that the cut crosses. Eyeballs replace MakeHuman's 72-vertex
    spheres; they follow a target as the spheres they replace do.
    """

    def __init__(self, source: MakeHuman) -> None:
        self.source = source
        self.eye = eyeball()
        self.eye_helpers = [source.group_vertices(f"helper-{side[0]}-eye") for side in _SIDES]
        body = source.groups == "body"
        inner, ends, share = _clip(source.vertices, source.quads[body])
        solid = np.isin(source.groups, list(_SOLID))
        whole = np.union1d(inner, np.unique(source.quads[solid]))
        self.outer = np.concatenate([whole, ends[:, 0]])
        self.inner = np.concatenate([whole, ends[:, 1]])
        self.share = np.concatenate([np.zeros(len(whole)), share])
        self.new_index = np.full(len(source.vertices), -1)  # MakeHuman vertex -> head vertex
        self.new_index[self.outer] = np.arange(len(self.outer))
        known = (self.new_index[source.quads] >= 0).sum(1)
        touched = body & np.isin(source.quads, inner).any(1)
        self.quad_index = np.flatnonzero((touched & (known >= 3)) | solid)
        self.uvs = self._clipped_uvs()

    def _clipped_uvs(self) -> np.ndarray:
        """MakeHuman's UVs with those of cut edges moved along."""
        uvs = self.source.uvs.copy()
        moved = {
            outer: (inner, share)
            for outer, inner, share in zip(self.outer, self.inner, self.share, strict=True)
            if share > 0
        }
        for index in self.quad_index:
            quad, rows = self.source.quads[index].tolist(), self.source.uv_quads[index]
            for vertex, row in zip(quad, rows, strict=True):
                inner, share = moved.get(vertex, (-1, 0.0))
                if inner in quad:
                    near = self.source.uvs[rows[quad.index(inner)]]
                    uvs[row] = (1 - share) * near + share * self.source.uvs[row]
        return uvs

    @property
    def vertex_count(self) -> int:
        return len(self.outer) + 2 * len(self.eye.points)

    def eye_slice(self, side: int) -> slice:
        start = len(self.outer) + side * len(self.eye.points)
        return slice(start, start + len(self.eye.points))

    def _eye_centre(self, side: int) -> np.ndarray:
        helper = self.source.vertices[self.eye_helpers[side]]
        return (helper.max(0) + helper.min(0)) / 2

    def _mix(self, values: np.ndarray) -> np.ndarray:
        """Values [N,...] at MakeHuman's vertices -> at the head's, less the eyeballs."""
        share = self.share.reshape(-1, *(1,) * (values.ndim - 1))
        return (1 - share) * values[self.inner] + share * values[self.outer]

    @cached_property
    def rest(self) -> np.ndarray:
        """Rest positions [V,3] of MakeHuman's base mesh, decimetres."""
        body = self._mix(self.source.vertices)
        for group, shift in _SOLID.items():
            body[self.new_index[self.source.group_vertices(group)]] += shift
        deep = self._mouth_depth()
        body += _MOUTH_PULL * deep[:, None] * (body[deep > 0].mean(0) - body)
        parts = [body]
        for side in range(2):
            helper = self.source.vertices[self.eye_helpers[side]]
            centre = self._eye_centre(side)
            radius = np.linalg.norm(helper - centre, axis=1).mean()
            mirror = np.array([1 - 2 * side, 1, 1])
            parts.append(centre + radius * self.eye.points * mirror)
        return np.concatenate(parts)

    def displace(self, displacements: np.ndarray, *, round_eyes: bool = False) -> np.ndarray:
        """A target's displacements [N,3] -> those of the head's vertices [V,3], both decimetres.

        round_eyes: let eyeballs only move and grow, so that they stay spheres that look ahead.
        """
        parts = [self._mix(displacements)]
        for side in range(2):
            helper = self.eye_helpers[side]
            centre = self._eye_centre(side)
            design = np.c_[self.source.vertices[helper] - centre, np.ones(len(helper))]
            affine = np.linalg.lstsq(design, displacements[helper], rcond=None)[0]
            if round_eyes:
                affine[:3] = np.eye(3) * np.trace(affine[:3]) / 3
            points = self.rest[self.eye_slice(side)] - centre
            parts.append(np.c_[points, np.ones(len(points))] @ affine)
        return np.concatenate(parts)

    def bone(self, weights: np.ndarray) -> np.ndarray:
        """A bone's weights [N] -> [V]; the eyeballs get none."""
        return np.concatenate([self._mix(weights), np.zeros(2 * len(self.eye.points))])

    def _mouth_depth(self) -> np.ndarray:
        """How far each vertex, eyeballs left out, lies in the mouth: 0 at its rim, 1 at its back.

        The mouth's inside is the UV island below the face's in MakeHuman's layout.
        """
        quads = self.source.quads[self.quad_index]
        centres = self.source.uvs[self.source.uv_quads[self.quad_index]].mean(1)
        island = (centres[:, 1] < 0.14) & (centres[:, 0] > 0.7)
        reached = np.zeros(len(self.source.vertices), bool)
        reached[quads[~island]] = True
        depth = np.zeros(len(self.source.vertices))
        depth[np.setdiff1d(quads[island], quads[~island])] = 1.0
        for ring in range(1, _MOUTH_RINGS):
            near = np.unique(quads[island & reached[quads].any(1)])
            depth[near[~reached[near]]] = ring / _MOUTH_RINGS
            reached[near] = True
        return self._mix(depth)

    def members(self, group: str) -> np.ndarray:
        """bool [V]: vertices of a kept face group."""
        mask = np.zeros(self.vertex_count, bool)
        index = self.new_index[self.source.group_vertices(group)]
        mask[index[index >= 0]] = True
        return mask

    @cached_property
    def mirror(self) -> np.ndarray:
        """Index [V] of each vertex's mirror image."""
        body = self.new_index[self.source.mirror[self.outer]]
        count = len(self.eye.points)
        left = np.arange(count) + len(self.outer)
        return np.concatenate([body, left + count, left])

    def triangles(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Triangles [T,3] of the head and the rows [T,3] of its UVs; -1 for eyeballs.

        positions: [V,3]; each quad is cut along its shorter diagonal, and one that lost a corner
        is the triangle of the others.
        """
        quads = self.new_index[self.source.quads[self.quad_index]]
        uv_quads = self.source.uv_quads[self.quad_index]
        lost = quads < 0
        first = np.linalg.norm(positions[quads[:, 0]] - positions[quads[:, 2]], axis=1)
        second = np.linalg.norm(positions[quads[:, 1]] - positions[quads[:, 3]], axis=1)
        start = np.where(second < first - 1e-9, 1, 0)
        # a quad's second triangle is its corners start, start + 2, start + 3
        start = np.where(lost.any(1), (lost.argmax(1) + 3) % 4, start)[:, None]
        rows = np.arange(len(quads))[:, None]
        parts, uv_parts = [], []
        for steps in ((0, 1, 2), (0, 2, 3)):
            corners = (start + np.array(steps)) % 4
            keep = (quads[rows, corners] >= 0).all(1)
            parts.append(quads[rows, corners][keep])
            uv_parts.append(uv_quads[rows, corners][keep])
        for side in range(2):
            eye = self.eye.triangles if side == 0 else self.eye.triangles[:, [0, 2, 1]]
            parts.append(eye + self.eye_slice(side).start)
            uv_parts.append(np.full_like(eye, -1))
        return np.concatenate(parts), np.concatenate(uv_parts)


def sphere_centre(points: np.ndarray) -> np.ndarray:
    """Centre [3] of the sphere through points [N,3], by least squares."""
    design = np.c_[2 * points, np.ones(len(points))]
    return np.linalg.lstsq(design, (points**2).sum(1), rcond=None)[0][:3]


def _clip(vertices: np.ndarray, quads: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cuts the body across the chest and the arms.

    Returns the vertices inside, the ends [n,2] (outside, inside) of the edges that the cut crosses,
    one for each vertex outside, and how much [n] of each such edge stays.
    """
    height, width = vertices[:, 1], np.abs(vertices[:, 0])
    along_arm = np.sqrt(0.5) * (width - (height - _ARM[1]))
    inside = np.minimum(height - _CHEST, _ARM[0] - along_arm)
    a, b = quads.ravel(), quads[:, [1, 2, 3, 0]].ravel()
    edges = np.concatenate([np.stack([a, b], 1), np.stack([b, a], 1)])
    crossing = edges[(inside[edges[:, 0]] <= 0) & (inside[edges[:, 1]] > 0)]
    # the innermost neighbour first, so that np.unique keeps it
    crossing = crossing[np.argsort(-inside[crossing[:, 1]], kind="stable")]
    ends = crossing[np.unique(crossing[:, 0], return_index=True)[1]]
    share = inside[ends[:, 1]] / (inside[ends[:, 1]] - inside[ends[:, 0]])
    body = np.unique(quads)
    return body[inside[body] > 0], ends, np.maximum(share, _LEAST_SHARE)
