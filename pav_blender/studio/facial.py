"""Brows, lashes and beards: strands that ride on the skin's triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from .hair import Growth, HairColour, Roots, clump, grow, sample_roots, tints
from .objects import curve_object, move_curves
from .person import Person, Surface
from .skin import smoothstep


@dataclass(frozen=True)
class BeardStyle:
    """Lengths and radii in metres; `kind`: "full", "stubble", "goatee"."""

    kind: str
    colour: HairColour
    strands: int
    length: tuple[float, float]
    radius: float


@dataclass(eq=False)
class RidingHair:
    """Strands held in the frames of the triangles they grow on."""

    items: list
    vertices: np.ndarray  # the skin part's rows of the refined mesh
    corners: np.ndarray
    weights: np.ndarray
    local: np.ndarray  # [S,P,3]

    def follow(self, state) -> None:
        points = state.fine[self.vertices]
        frame, origin = frames(points, self.corners, self.weights)
        move_curves(self.items[0], origin[:, None] + np.einsum("sij,spj->spi", frame, self.local))


def frames(points: np.ndarray, corners: np.ndarray, weights: np.ndarray):
    """Orthonormal frames [S,3,3] (columns: edge, side, normal) and origins [S,3] of roots."""
    a, b, c = (points[corners[:, k]] for k in range(3))
    edge = b - a
    edge = edge / np.maximum(np.linalg.norm(edge, axis=1, keepdims=True), 1e-12)
    normal = np.cross(b - a, c - a)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    frame = np.stack([edge, np.cross(normal, edge), normal], axis=2)
    return frame, (points[corners] * weights[..., None]).sum(1)


def ride(person: Person, name, strands, roots: Roots, radius, material, label, tint) -> RidingHair:
    """Make `strands` (rest space) follow the skin."""
    vertices = person.parts["skin"].vertices
    frame, origin = frames(person.fine[vertices], roots.corners, roots.weights)
    local = np.einsum("sji,spj->spi", frame, strands - origin[:, None]).astype(np.float32)
    item = curve_object(name, strands, radius, material, label=label, tint=tint)
    return RidingHair([item], vertices, roots.corners, roots.weights, local)


def brow_mask(person: Person, thickness: float = 1.0):
    """Two arches over the eyes."""
    marks = person.landmarks
    eye = marks.eye

    def mask(points: np.ndarray) -> np.ndarray:
        x, y, z = np.abs(points[:, 0]), points[:, 1] - eye[1], points[:, 2]
        t = (x - 0.36 * eye[0]) / (1.42 * eye[0])  # 0 inner end, 1 outer end
        middle = 0.0162 + 0.0068 * np.sin(np.clip(t, 0, 1) * 2.1) - 0.004 * np.clip(t, 0, 1) ** 3
        half = thickness * np.interp(t, (0, 0.15, 0.55, 1), (0.0026, 0.0036, 0.0030, 0.0010))
        across = 1 - smoothstep(np.abs(y - middle) / half, 0.55, 1.15)
        ends = smoothstep(t, -0.02, 0.14) * (1 - smoothstep(t, 0.93, 1.02))
        return across * ends * (z > eye[2] - 0.03)

    return mask


def brow_strands(person: Person, surface: Surface, count: int, rng, thickness=1.0):
    eye = person.landmarks.eye
    roots = sample_roots(person, brow_mask(person, thickness), count, rng)

    def field(points: np.ndarray) -> np.ndarray:
        t = np.clip((np.abs(points[:, 0]) - 0.36 * eye[0]) / (1.42 * eye[0]), 0, 1)
        up = np.interp(t, (0, 0.15, 0.45, 1), (1.2, 0.6, 0.12, -0.35))
        return np.stack([np.sign(points[:, 0]), up, -0.25 * t], axis=1)

    length = 0.0078 * rng.uniform(0.65, 1.1, count)
    growth = Growth(0.28, 0.0, 0.2, (0.0003, 0.0010), 0.16)
    strands = grow(roots, length, 4, growth, field, surface, rng)
    return roots, clump(strands, 5, 0.35, rng, 0.0012)[0]


def beard_mask(person: Person, kind: str):
    """The beard's field of growth: jaw, chin, moustache; sideburns join the scalp."""
    marks = person.landmarks
    mouth, chin, ear, nose = marks.mouth, marks.chin, marks.ear, marks.nose
    lips = person.masks["lips"] > 0.4
    lip_tree = cKDTree(person.fine[lips])
    inside = person.fine[person.masks["mouth_interior"] > 0.3]
    mouth_tree = cKDTree(inside)

    def mask(points: np.ndarray) -> np.ndarray:
        x, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
        # upper edge: from the sideburn down the cheek to above the corner of the mouth
        height = np.interp(
            z, (ear[2] + 0.012, ear[2] + 0.028, -0.028, 0.004, 0.022, 0.03),
            (ear[1] + 0.012, ear[1] + 0.005, mouth[1] + 0.012, mouth[1] + 0.008,
             mouth[1] + 0.016, nose[1] - 0.009),
        )  # fmt: skip
        cheek = 1 - smoothstep(y - height, -0.005, 0.003)
        # lower edge: along the jaw, a little onto the neck
        under = chin[1] - 0.004 + 0.45 * (chin[2] - z)
        under = np.minimum(under, ear[1] - 0.012) - 0.016
        neck = smoothstep(y - under, -0.004, 0.008)
        front = smoothstep(z, ear[2] + 0.008, ear[2] + 0.016)
        out = cheek * neck * front
        nostril = 1 - smoothstep(y, nose[1] - 0.012, nose[1] - 0.008)
        out = out * np.where(x < 0.022, nostril, 1)
        near_lip, _ = lip_tree.query(points)
        near_mouth, _ = mouth_tree.query(points)
        out = out * smoothstep(near_lip, 0.0007, 0.0032) * (near_mouth > 0.002)
        patch = (x < 0.010) & (y < mouth[1]) & (y > mouth[1] - 0.016)
        corner = (np.abs(x - marks.mouth_half - 0.002) < 0.005) & (np.abs(y - mouth[1]) < 0.007)
        out = out * np.where(corner, 0.5, 1) * np.where(patch, 0.75, 1)
        if kind == "goatee":
            out = out * (1 - smoothstep(x, marks.mouth_half - 0.001, marks.mouth_half + 0.010))
        return out

    return mask


def beard_strands(person: Person, style: BeardStyle, surface: Surface, rng):
    marks = person.landmarks
    roots = sample_roots(person, beard_mask(person, style.kind), style.strands, rng)

    def field(points: np.ndarray) -> np.ndarray:
        x, y = points[:, 0], points[:, 1]
        lip = (y > marks.mouth[1]) & (np.abs(x) < marks.mouth_half * 1.2)
        aside = np.where(lip, 9.0, 3.0) * x / marks.mouth_half * 0.12
        return np.stack([aside, -1 + 0 * x, 0.25 + 0 * x], axis=1)

    low, high = style.length
    x, y, _ = roots.points.T
    chin = np.exp(-(((x / 0.03) ** 2) + ((y - marks.chin[1]) / 0.025) ** 2))
    length = (low + (high - low) * chin) * rng.uniform(0.6, 1.1, len(x))
    lip = (y > marks.mouth[1] - 0.001) & (np.abs(x) < marks.mouth_half)
    length = np.where(lip, np.minimum(length, 0.0075), length)
    lift = 0.55 if style.kind != "stubble" else 0.9
    growth = Growth(lift, 0.02, 0.22, (0.0, 0.0), 0.22)
    strands = grow(roots, length, 4, growth, field, surface, rng)
    strands, clumps = clump(strands, 7, 0.0 if style.kind == "stubble" else 0.45, rng, 0.0015)
    return roots, strands, tints(style.colour, clumps, len(strands), rng)


def lash_strands(person: Person, count: int, rng: np.random.Generator):
    """Lashes of all four lids: roots on the lid's rim, curving away from the eye."""
    vertices = person.parts["skin"].vertices
    points, normals = person.fine[vertices], person.normals[vertices]
    quads = person.parts["skin"].quads
    carrier = np.zeros(len(points), int)
    carrier[quads.reshape(-1)] = np.repeat(np.arange(len(quads)), 4)
    rows, strands = [], []
    for side, name in ((1, "left_eye"), (-1, "right_eye")):
        centre = person.joints[person.head.joint_names.index(name)]
        for up, share, length in ((1, 0.62, 0.0082), (-1, 0.38, 0.0045)):
            rim = lid_rim(points, normals, centre, up)
            pick = rng.integers(0, len(rim), int(count * share / 2))
            root = points[rim[pick]]
            across = side * (root[:, 0] - centre[0]) / 0.015  # +1 at the outer corner
            out = np.stack([side * (0.12 + 0.55 * across), 0.15 * up + 0 * across,
                            1.0 - 0.2 * across], 1)  # fmt: skip
            out += rng.normal(0, 0.10, out.shape)
            size = length * rng.uniform(0.7, 1.05, len(pick)) * (0.8 + 0.2 * across)
            share_along = np.linspace(0, 1, 4)[None, :, None]
            reach = out / np.linalg.norm(out, axis=1, keepdims=True)
            curl = np.array([0, up * 0.75, 0.0])
            path = share_along * reach[:, None] + share_along**2 * curl
            strands.append(root[:, None] + size[:, None, None] * path * 0.85)
            rows.append(rim[pick])
    row = np.concatenate(rows)
    corners = quads[carrier[row]]
    # barycentrics that name the vertex itself
    three = np.where((corners[:, 3] == row)[:, None], corners[:, [0, 2, 3]], corners[:, :3])
    weights = (three == row[:, None]).astype(np.float32)
    roots = Roots(three, weights, points[row], normals[row])
    return roots, np.concatenate(strands).astype(np.float32)


def lid_rim(points: np.ndarray, normals: np.ndarray, centre: np.ndarray, up: int) -> np.ndarray:
    """Rows of the skin vertices on the edge of a lid (up: +1 upper, -1 lower)."""
    offset = points - centre
    reach = np.linalg.norm(offset, axis=1)
    near = (reach > 0.0155) & (reach < 0.021) & (offset[:, 2] > 0.003) & (normals[:, 2] > 0.05)
    near &= (np.abs(offset[:, 0]) < 0.017) & (up * offset[:, 1] > -0.003)
    rows = np.flatnonzero(near)
    column = np.round(offset[rows, 0] / 0.0009).astype(int)
    rim = []
    for value in np.unique(column):
        mine = rows[column == value]
        rim.append(mine[np.argmin(up * offset[mine, 1])])
    return np.asarray(rim)
