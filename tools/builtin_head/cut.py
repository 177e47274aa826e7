"""Which vertices and faces the head keeps, its new eyeballs, and how targets act on them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tools.builtin_head.makehuman import MakeHuman

METRES = 0.1  # MakeHuman works in decimetres
CUT_HEIGHT, CUT_WIDTH = 3.9, 3.0  # decimetres: shoulders and the top of the chest stay
_SOLID = ("helper-upper-teeth", "helper-lower-teeth", "helper-tongue")
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
    """The head's vertices: kept ones of MakeHuman's mesh first, then the two eyeballs.

    Eyeballs replace MakeHuman's 72-vertex spheres; they follow a target by the affine map that it
    makes of the sphere they replace.
    """

    def __init__(self, source: MakeHuman) -> None:
        self.source = source
        corners = source.vertices[source.quads]
        inside = (corners[..., 1] > CUT_HEIGHT) & (np.abs(corners[..., 0]) < CUT_WIDTH)
        body = (source.groups == "body") & inside.all(1)
        self.quad_index = np.flatnonzero(body | np.isin(source.groups, _SOLID))
        self.kept = np.unique(source.quads[self.quad_index])
        self.eye = eyeball()
        self.eye_helpers = [source.group_vertices(f"helper-{side[0]}-eye") for side in _SIDES]

    @cached_property
    def new_index(self) -> np.ndarray:
        """MakeHuman vertex -> head vertex, -1 where dropped."""
        index = np.full(len(self.source.vertices), -1)
        index[self.kept] = np.arange(len(self.kept))
        return index

    @property
    def vertex_count(self) -> int:
        return len(self.kept) + 2 * len(self.eye.points)

    def eye_slice(self, side: int) -> slice:
        start = len(self.kept) + side * len(self.eye.points)
        return slice(start, start + len(self.eye.points))

    def eye_centre(self, side: int, displacements: np.ndarray | float = 0.0) -> np.ndarray:
        """Centre of an eye's sphere, decimetres."""
        moved = self.source.vertices + displacements
        helper = moved[self.eye_helpers[side]]
        return (helper.max(0) + helper.min(0)) / 2

    def rest(self) -> np.ndarray:
        """Rest positions [V,3] of MakeHuman's base mesh, decimetres."""
        parts = [self.source.vertices[self.kept]]
        for side in range(2):
            helper = self.source.vertices[self.eye_helpers[side]]
            centre = self.eye_centre(side)
            radius = np.linalg.norm(helper - centre, axis=1).mean()
            mirror = np.array([1 - 2 * side, 1, 1])
            parts.append(centre + radius * self.eye.points * mirror)
        return np.concatenate(parts)

    def displace(self, displacements: np.ndarray) -> np.ndarray:
        """A target's displacements [N,3] -> those of the head's vertices [V,3], both decimetres."""
        rest = self.rest()
        parts = [displacements[self.kept]]
        for side in range(2):
            helper = self.eye_helpers[side]
            centre = self.eye_centre(side)
            design = np.c_[self.source.vertices[helper] - centre, np.ones(len(helper))]
            affine = np.linalg.lstsq(design, displacements[helper], rcond=None)[0]
            points = rest[self.eye_slice(side)] - centre
            parts.append(np.c_[points, np.ones(len(points))] @ affine)
        return np.concatenate(parts)

    def bone(self, weights: np.ndarray) -> np.ndarray:
        """A bone's weights [N] -> [V]; the eyeballs get none."""
        return np.concatenate([weights[self.kept], np.zeros(2 * len(self.eye.points))])

    def members(self, group: str) -> np.ndarray:
        """bool [V]: vertices of a kept face group."""
        mask = np.zeros(self.vertex_count, bool)
        index = self.new_index[self.source.group_vertices(group)]
        mask[index[index >= 0]] = True
        return mask

    @cached_property
    def mirror(self) -> np.ndarray:
        """Index [V] of each vertex's mirror image."""
        body = self.new_index[self.source.mirror[self.kept]]
        count = len(self.eye.points)
        left = np.arange(count) + len(self.kept)
        return np.concatenate([body, left + count, left])

    def triangles(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Triangles [T,3] of the head and the rows [T,3] of MakeHuman's UVs; -1 for eyeballs.

        positions: [V,3]; each quad is cut along its shorter diagonal.
        """
        quads = self.new_index[self.source.quads[self.quad_index]]
        uv_quads = self.source.uv_quads[self.quad_index]
        first = np.linalg.norm(positions[quads[:, 0]] - positions[quads[:, 2]], axis=1)
        second = np.linalg.norm(positions[quads[:, 1]] - positions[quads[:, 3]], axis=1)
        turn = (second < first - 1e-9)[:, None]
        quads = np.where(turn, np.roll(quads, -1, 1), quads)
        uv_quads = np.where(turn, np.roll(uv_quads, -1, 1), uv_quads)
        parts = [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
        uv_parts = [uv_quads[:, [0, 1, 2]], uv_quads[:, [0, 2, 3]]]
        for side in range(2):
            eye = self.eye.triangles if side == 0 else self.eye.triangles[:, [0, 2, 1]]
            parts.append(eye + self.eye_slice(side).start)
            uv_parts.append(np.full_like(eye, -1))
        return np.concatenate(parts), np.concatenate(uv_parts)
