"""The UV atlas: MakeHuman's islands, repacked without overlaps, most of it for the face."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from tools.builtin_head.cut import Cut

_MARGIN = 0.006  # three texels at 512
# Boxes (x0, y0, x1, y1) of the atlas
_BOXES = {
    "head": (0.0, 0.31, 1.0, 1.0),
    "torso": (0.0, 0.0, 0.46, 0.31),
    "left_eye": (0.60, 0.17, 0.74, 0.31),
    "right_eye": (0.46, 0.17, 0.60, 0.31),
    "helper-upper-teeth": (0.46, 0.11, 0.60, 0.17),
    "helper-lower-teeth": (0.46, 0.05, 0.60, 0.11),
    "left_socket": (0.67, 0.09, 0.74, 0.17),
    "right_socket": (0.60, 0.09, 0.67, 0.17),
    "mouth": (0.74, 0.11, 1.0, 0.31),
    "helper-tongue": (0.76, 0.0, 0.96, 0.11),
}


def build_atlas(
    cut: Cut, triangles: np.ndarray, uv_triangles: np.ndarray
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """UVs [U,2], uv triangles [T,3], and the triangles (bool [T]) of each named island."""
    raw = np.concatenate([cut.uvs, cut.eye.uvs, cut.eye.uvs * (-1, 1)])
    uv_triangles = uv_triangles.copy()
    start = len(cut.uvs)
    for side in range(2):
        first = cut.eye_slice(side).start
        mine = (triangles >= first).all(1) & (triangles < cut.eye_slice(side).stop).all(1)
        uv_triangles[mine] = triangles[mine] - first + start + side * len(cut.eye.uvs)
    islands = _name_islands(cut, triangles, uv_triangles)
    for name, mask in islands.items():
        index = np.unique(uv_triangles[mask])
        raw[index] = _fit(_straighten(name, raw[index]), _BOXES[name])
    used, compact = np.unique(uv_triangles, return_inverse=True)
    return raw[used], compact.reshape(-1, 3), islands


def _name_islands(
    cut: Cut, triangles: np.ndarray, uv_triangles: np.ndarray
) -> dict[str, np.ndarray]:
    i = uv_triangles.ravel()
    j = uv_triangles[:, [1, 2, 0]].ravel()
    size = uv_triangles.max() + 1
    label = connected_components(sp.coo_matrix((np.ones(len(i)), (i, j)), (size, size)), False)[1]
    label = label[uv_triangles[:, 0]]
    result: dict[str, np.ndarray] = {}
    for group in ("helper-upper-teeth", "helper-lower-teeth", "helper-tongue"):
        result[group] = cut.members(group)[triangles].all(1)
    for side, name in enumerate(("left", "right")):
        result[f"{name}_eye"] = (triangles >= cut.eye_slice(side).start).all(1) & (
            triangles < cut.eye_slice(side).stop
        ).all(1)
    body = ~np.any(list(result.values()), axis=0)
    rest = cut.rest
    for number in np.unique(label[body]):
        mask = body & (label == number)
        centre = rest[triangles[mask]].mean((0, 1))
        if mask.sum() > 5000:
            name = "head"
        elif centre[1] < 5.5:
            name = "torso"
        elif centre[1] < 6.9:
            name = "mouth"
        else:
            name = "left_socket" if centre[0] > 0 else "right_socket"
        result[name] = mask
    return result


def _straighten(name: str, uv: np.ndarray) -> np.ndarray:
    """Turn an island upright; give the head island's middle (the face) more room."""
    if name == "helper-tongue":
        return uv[:, ::-1] * (-1, 1)
    if name != "head":
        return uv
    # MakeHuman lays the face on its side, crown at low u
    across, up = uv[:, 1], -uv[:, 0]
    across = across - 0.5 * (across.min() + across.max())
    x = _spread(across / across.max(), 0.0, 0.27, 2.6)
    y = _spread(_unit(up), 0.34, 0.16, 1.6)
    return np.stack([x, y], 1)


def _unit(values: np.ndarray) -> np.ndarray:
    return (values - values.min()) / (values.max() - values.min())


def _spread(values: np.ndarray, centre: float, width: float, gain: float) -> np.ndarray:
    """A monotone map that magnifies by up to 1 + gain round a centre."""
    grid = np.linspace(values.min(), values.max(), 2001)
    density = 1 + gain * np.exp(-(((grid - centre) / width) ** 2))
    total = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    return np.interp(values, grid, total / total[-1])


def _fit(uv: np.ndarray, box: tuple[float, float, float, float]) -> np.ndarray:
    """Scale into a box less its margin; keeps proportions except where the box is the head's."""
    low = np.array(box[:2]) + _MARGIN
    size = np.array(box[2:]) - _MARGIN - low
    extent = np.ptp(uv, axis=0)
    scale = size / extent
    if box != _BOXES["head"]:
        scale = np.full(2, scale.min())
    return low + 0.5 * (size - extent * scale) + (uv - uv.min(0)) * scale
