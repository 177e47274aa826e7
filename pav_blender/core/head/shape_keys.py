"""Any mesh with shape keys as a head model: game characters, scans, MetaHuman-like rigs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..errors import InputError, PavError
from .model import HeadModel


def head_from_shape_keys(
    vertices: np.ndarray,
    triangles: np.ndarray,
    keys: Mapping[str, np.ndarray],
    *,
    uvs: np.ndarray | None = None,
    uv_triangles: np.ndarray | None = None,
    joint_names: Sequence[str] = ("root",),
    joint_parents: Sequence[int] = (-1,),
    joint_positions: np.ndarray | None = None,
    skinning_weights: np.ndarray | None = None,
    regions: Mapping[str, np.ndarray] | None = None,
    name: str = "mesh",
    origin: str = "",
) -> HeadModel:
    """A head without an identity space out of a mesh and its shape keys.

    vertices: [V,3] metres, +y up, face toward +z; triangles: [T,3]; keys: name -> [V,3] positions
    (not offsets) with that key at 1; uvs [U,2] with uv_triangles [T,3] (the triangles themselves
    where U = V and none are given; a new atlas by xatlas where there are no uvs);
    joint_positions: [J,3] (the middle of the mesh for a lone root); skinning_weights: [V,J]
    (everything on the root where None; rows are normalised). Raises :class:`InputError` where
    arrays do not fit together, :class:`PavError` where an atlas is needed and xatlas is missing.

    Example::

        head = head_from_shape_keys(points, triangles, {"jawOpen": points_with_jaw_open})
    """
    vertices = np.asarray(vertices, np.float64)
    triangles = np.asarray(triangles)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not len(vertices):
        raise InputError(f"vertices have shape {list(vertices.shape)}; [V,3] is needed")
    for key, positions in keys.items():
        if np.shape(positions) != vertices.shape:
            raise InputError(
                f"shape key '{key}' has shape {list(np.shape(positions))}; "
                f"the mesh has {list(vertices.shape)}"
            )
    if uvs is None:
        uvs, uv_triangles = _unwrap(vertices, triangles)
    elif uv_triangles is None:
        uv_triangles = triangles
    joints = len(joint_names)
    if joint_positions is None:
        joint_positions = np.broadcast_to(vertices.mean(0), (joints, 3))
        if joints > 1:
            raise InputError(f"{joints} joints need joint_positions [{joints},3]")
    offsets = [np.asarray(positions, np.float64) - vertices for positions in keys.values()]
    return HeadModel(
        name=name,
        template=vertices,
        triangles=triangles,
        uvs=uvs,
        uv_triangles=uv_triangles,  # type: ignore[arg-type]
        shape_basis=np.zeros((0, len(vertices), 3)),
        expression_basis=np.array(offsets).reshape(-1, len(vertices), 3),
        expression_names=tuple(keys),
        pose_basis=np.zeros((0, len(vertices), 3)),
        joint_names=tuple(joint_names),
        joint_parents=np.asarray(joint_parents),
        joint_regressor=_regressor(vertices, np.asarray(joint_positions, np.float64)),
        skinning_weights=_normalised(skinning_weights, len(vertices), joints),
        regions=dict(regions or {}),
        landmark_triangles=np.zeros(0),
        landmark_barycentrics=np.zeros((0, 3)),
        origin=origin,
    )


def _unwrap(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    try:
        import xatlas
    except ImportError as error:
        raise PavError(
            "the mesh has no UVs and the module xatlas is missing: unwrap the mesh in Blender, "
            "or pip install xatlas"
        ) from error
    _, corners, uvs = xatlas.parametrize(
        np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(triangles, np.uint32)
    )
    return uvs, corners.astype(np.int32)


def _regressor(vertices: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """The smallest weights [J,V] that sum to 1 and whose mean of the vertices is each position."""
    centre = vertices.mean(0)
    scale = max(np.abs(vertices - centre).max(), 1e-12)
    design = np.vstack([np.ones(len(vertices)), ((vertices - centre) / scale).T])
    goals = np.vstack([np.ones(len(positions)), ((positions - centre) / scale).T])
    weights = np.linalg.lstsq(design, goals, rcond=None)[0]
    missed = np.abs(design @ weights - goals).max() * scale
    if missed > 1e-4 * scale:
        raise InputError("a joint lies off a flat mesh; give joints in the mesh's plane")
    return weights.T


def _normalised(weights: np.ndarray | None, vertices: int, joints: int) -> np.ndarray:
    if weights is None:
        return np.eye(1, joints).repeat(vertices, 0)
    weights = np.asarray(weights, np.float64)
    if weights.shape != (vertices, joints):
        raise InputError(
            f"skinning weights have shape {list(weights.shape)}, not [{vertices}, {joints}]"
        )
    total = weights.sum(1, keepdims=True)
    if (weights < 0).any() or (total <= 0).any():
        bad = int(np.flatnonzero((weights < 0).any(1) | (total[:, 0] <= 0))[0])
        raise InputError(f"skinning weights of vertex {bad} are negative or all zero")
    return weights / total
