"""What lies beside a FLAME model: texture coordinates, masks, landmarks, eyelids."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..pickles import read_pickle
from ..reading import MIB, read_array, read_arrays, read_bytes
from .model import HeadModel

# FLAME_masks.pkl's names -> ours
_MASKS = {
    "face": ("face",),
    "lips": ("lips",),
    "ears": ("left_ear", "right_ear"),
    "neck": ("neck",),
    "scalp": ("scalp",),
    "eyeballs": ("left_eyeball", "right_eyeball"),
    "left_eye_region": ("left_eye_region",),
    "right_eye_region": ("right_eye_region",),
    "nose": ("nose",),
    "forehead": ("forehead",),
    "boundary": ("boundary",),
}
_LARGEST_OBJ = 256 * MIB
_PARTS_OF_FACE = ("face", "lips", "nose", "forehead", "left_eye_region", "right_eye_region")


def read_uvs(
    path: Path | None, template: np.ndarray, triangles: np.ndarray
) -> tuple[np.ndarray, np.ndarray, str]:
    """Texture vertices [U,2], their triangles [T,3], and where they are from.

    path: an OBJ with FLAME's faces in any order. Without one, the head is laid out around its
    vertical axis, front and back, inside and outside apart, so that no texel serves two places of
    the face; good enough for an appearance's features, not for painting.
    """
    if path is None:
        return *_around(template, triangles), "texture coordinates laid out by this program"
    texture, faces = _read_obj(path)
    known = {tuple(sorted(face[:, 0].tolist())): face for face in faces}
    found = [known.get(tuple(sorted(corners))) for corners in triangles.tolist()]
    if any(face is None for face in found):
        raise InputError(f"{path}: its faces are not those of the FLAME model beside it")
    uv_triangles = np.empty_like(triangles)
    for number, (corners, face) in enumerate(zip(triangles, found, strict=True)):
        assert face is not None
        at = {int(v): int(t) for v, t in face}
        uv_triangles[number] = [at[int(v)] for v in corners]
    return texture.astype(np.float32), uv_triangles, f"texture coordinates of {path.name}"


def _read_obj(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Texture vertices [U,2] and faces [T,3,2] of (vertex, texture vertex), from 0."""
    texture, faces = [], []
    try:
        for line in read_bytes(path, _LARGEST_OBJ).decode("utf-8", "replace").splitlines():
            if line.startswith("vt "):
                texture.append([float(x) for x in line.split()[1:3]])
            elif line.startswith("f "):
                corners = [[int(n) for n in c.split("/")[:2]] for c in line.split()[1:]]
                if len(corners) != 3 or any(len(c) != 2 for c in corners):
                    raise ValueError("faces must be triangles with texture coordinates")
                faces.append(corners)
        result = np.array(texture, np.float64).reshape(-1, 2), np.array(faces).reshape(-1, 3, 2) - 1
    except (ValueError, OverflowError, TypeError) as error:
        raise InputError(f"{path}: not a readable OBJ with UVs ({error})") from error
    bad = not len(faces) or result[1].min() < 0 or result[1][..., 1].max() >= len(texture)
    if bad or not np.isfinite(result[0]).all():
        raise InputError(f"{path}: texture coordinates are missing or out of range")
    return result


def _around(template: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A layout [3T,2] of one chart a connected part, by angle and height about each part's axis."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(template)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    part = connected_components(graph, directed=False)[1][triangles[:, 0]]
    low, high = template.min(0), template.max(0)
    middle = (low + high) / 2
    uvs = np.zeros((len(triangles), 3, 2))
    sizes = {name: int((part == name).sum()) for name in np.unique(part)}
    largest = max(sizes, key=lambda name: sizes[name])
    small = [name for name in sizes if name != largest]
    corners = template[triangles]
    centre = middle * [1, 1, 1] - [0, 0, 0.15 * (high - low)[2]]
    angle = np.arctan2(corners[..., 0] - centre[0], corners[..., 2] - centre[2]) / (2 * np.pi)
    angle -= np.round(angle - angle[:, :1])  # no triangle runs round the seam at the back
    height = (corners[..., 1] - low[1]) / max(float(high[1] - low[1]), 1e-9)
    outward = np.einsum(
        "ij,ij->i",
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
        corners.mean(1) - centre,
    )
    main = part == largest
    inner = main & (outward < 0)
    uvs[..., 0], uvs[..., 1] = np.clip(angle + 0.5, 0, 1), 0.25 + 0.75 * height
    uvs[inner, :, 0] = 0.5 * uvs[inner, :, 0]
    uvs[inner, :, 1] = 0.23 * height[inner]
    width = 0.5 / max(len(small), 1)
    for place, name in enumerate(small):
        chosen = part == name
        spots = corners[chosen]
        base, reach = spots.min((0, 1)), np.ptp(spots.reshape(-1, 3), axis=0).max() + 1e-9
        local = (spots - base) / reach
        behind = local[..., 2].mean(1) < 0.5
        uvs[chosen, :, 0] = 0.5 + width * (place + 0.9 * (local[..., 0] + behind[:, None]) / 2)
        uvs[chosen, :, 1] = 0.22 * local[..., 1]
    return (
        uvs.reshape(-1, 2).astype(np.float32),
        np.arange(3 * len(triangles), dtype=np.int32).reshape(-1, 3),
    )


def masks_of(path: Path, vertices: int) -> dict[str, np.ndarray]:
    """FLAME_masks.pkl as regions [V]; the face includes eye regions, nose, forehead and lips."""
    content = read_pickle(path)
    regions: dict[str, np.ndarray] = {}
    if not isinstance(content, dict):
        raise InputError(f"{path}: not FLAME's masks (a dict of vertex numbers is expected)")
    for name, parts in _MASKS.items():
        mask = np.zeros(vertices, bool)
        for part in parts:
            if part not in content:
                continue
            index = np.asarray(content[part])
            if index.ndim != 1 or index.dtype.kind not in "iu" or (index.size and (
                index.min() < 0 or index.max() >= vertices
            )):  # fmt: skip
                raise InputError(f"{path}: the mask {part!r} does not hold vertices of FLAME")
            mask[index] = True
        if mask.any():
            regions[name] = mask
    if "face" not in regions:
        raise InputError(f"{path}: FLAME's masks without 'face'; download them again")
    for name in _PARTS_OF_FACE:
        if name in regions:
            regions["face"] = regions["face"] | regions[name]
    return regions


def drawn_regions(
    template: np.ndarray, weights: np.ndarray, joints: np.ndarray
) -> dict[str, np.ndarray]:
    """Rough regions from geometry alone, for a model without FLAME_masks.pkl.

    template [V,3] metres, weights [V,5], joints [5,3]: root, neck, jaw, left and right eye.
    """
    eyes = joints[3:5].mean(0)
    eyeballs = weights[:, 3:5].sum(1) > 0.5
    x, y, z = (template - eyes).T
    neck = y < -0.13
    front = (z > -0.05) & (np.abs(x) < 0.07) & (y > -0.13) & (y < 0.07)
    face = front & ~eyeballs & ~neck
    scalp = ~face & ~neck & ~eyeballs & (y > 0.0)
    return {"face": face, "eyeballs": eyeballs, "neck": neck, "scalp": scalp}


def read_eyelids(path: Path, vertices: int) -> np.ndarray:
    """One eyelid's closing [V,3], metres, of metrical-tracker's `blendshapes` folder."""
    offsets = read_array(path)
    if offsets.dtype.kind not in "iuf":
        raise InputError(f"{path}: it holds {offsets.dtype}, not numbers")
    offsets = np.asarray(offsets, np.float32)
    offsets = offsets[0] if offsets.ndim == 3 and len(offsets) == 1 else offsets
    if offsets.shape != (vertices, 3) or not np.isfinite(offsets).all():
        raise InputError(f"{path}: {list(offsets.shape)}; an eyelid is [{vertices}, 3], finite")
    return offsets


def read_landmarks(path: Path, head: HeadModel) -> HeadModel:
    """The head with MediaPipe's 478 landmarks, from the 105 that FLAME's embedding places.

    The others are carried over from the built-in head by a thin-plate spline through those 105
    and put on the nearest point of the surface.
    """
    stored = read_arrays(path, ["lmk_face_idx", "lmk_b_coords", "landmark_indices"])
    try:
        at = stored["lmk_face_idx"].astype(np.int64).ravel()
        weights = stored["lmk_b_coords"].astype(np.float32).reshape(-1, 3)
        numbers = stored["landmark_indices"].astype(np.int64).ravel()
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not FLAME's MediaPipe embedding ({error})") from error
    count = len(head.triangles)
    right = len(at) == len(weights) == len(numbers) >= 10 and len(set(numbers)) == len(numbers)
    right = right and at.min() >= 0 and at.max() < count and numbers.min() >= 0
    if not (right and numbers.max() < 478 and np.isfinite(weights).all()):
        raise InputError(f"{path}: landmarks that do not fit FLAME's {count} triangles")
    triangles, barycentrics = _spread(head, at, weights, numbers)
    return dataclasses.replace(
        head, landmark_triangles=triangles, landmark_barycentrics=barycentrics
    )


def _spread(
    head: HeadModel, at: np.ndarray, weights: np.ndarray, numbers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    from scipy.interpolate import RBFInterpolator
    from scipy.spatial import cKDTree

    from .builtin import builtin_head

    model = builtin_head()
    source = model.landmarks(model.template)
    corners = head.template[head.triangles]
    placed = (corners[at] * weights[..., None]).sum(1)
    spline = RBFInterpolator(source[numbers], placed, kernel="thin_plate_spline", smoothing=1e-9)
    goals = spline(source)
    _, close = cKDTree(corners.mean(1)).query(goals, k=32)
    near = corners[close]  # [478,32,3,3]
    found, best = _nearest(goals, near)
    triangles = close[np.arange(len(goals)), found].astype(np.int32)
    barycentrics = best.astype(np.float32)
    triangles[numbers], barycentrics[numbers] = at, weights
    return triangles, barycentrics


def _nearest(points: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of triangles [N,K,3,3]: which is nearest to each point [N,3], and where on it [N,3].

    By their planes, with barycentrics clipped: near enough for a point close to the surface.
    """
    a, b, c = corners[:, :, 0], corners[:, :, 1], corners[:, :, 2]
    u, v, w = b - a, c - a, points[:, None] - a
    uu, uv, vv = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    wu, wv = (w * u).sum(-1), (w * v).sum(-1)
    below = np.maximum(uu * vv - uv * uv, 1e-18)
    weights = np.stack([(wu * vv - wv * uv) / below, (wv * uu - wu * uv) / below], -1)
    weights = np.concatenate([1 - weights.sum(-1, keepdims=True), weights], -1).clip(0, 1)
    weights /= weights.sum(-1, keepdims=True)
    on = (corners * weights[..., None]).sum(2)
    found = ((on - points[:, None]) ** 2).sum(-1).argmin(1)
    return found, weights[np.arange(len(points)), found]
