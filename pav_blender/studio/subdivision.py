"""Catmull-Clark subdivision as one sparse matrix: a posed mesh is refined by a single product."""

from __future__ import annotations

import numpy as np
from scipy import sparse


def quads_of(triangles: np.ndarray) -> np.ndarray:
    """Faces [N,4] of a triangle list [T,3] that was cut from quads; -1 ends a face that was none.

    Two orders are known: the halves (a,b,c), (a,c,d) of a quad follow each other, or all first
    halves come before all second ones.
    """
    step = 1
    partner = np.flatnonzero(
        (triangles[:, 0] == triangles[0, 0]) & (triangles[:, 1] == triangles[0, 2])
    )
    if len(partner):
        step = int(partner[0])
    first = np.arange(len(triangles))
    first = first[first % 2 == 0] if step == 1 else first[:step]
    first = first[first + step < len(triangles)]
    a, b = triangles[first], triangles[first + step]
    fits = (a[:, 0] == b[:, 0]) & (a[:, 2] == b[:, 1])
    first = first[fits]
    quads = np.concatenate([triangles[first], triangles[first + step][:, 2:]], axis=1)
    alone = np.ones(len(triangles), bool)
    alone[first] = alone[first + step] = False
    rest = np.pad(triangles[alone], ((0, 0), (0, 1)), constant_values=-1)
    return np.concatenate([quads, rest]).astype(np.int64)


def subdivide(faces: np.ndarray, count: int) -> tuple[sparse.csr_matrix, np.ndarray]:
    """One Catmull-Clark step of `faces` [N,4] (-1: a triangle) over `count` vertices.

    Returns the matrix [V', V] and the new quads [N', 4]. Open borders are cubic curves.
    """
    corner_face, corner_slot = np.nonzero(faces >= 0)
    corner_vertex = faces[corner_face, corner_slot]
    sides = (faces >= 0).sum(1)
    face_vertex = _incidence(corner_face, corner_vertex, len(faces), count)
    face_point = sparse.diags(1.0 / sides) @ face_vertex

    following = faces[corner_face, (corner_slot + 1) % sides[corner_face]]
    preceding = faces[corner_face, (corner_slot - 1) % sides[corner_face]]
    edges, edge_of = np.unique(
        np.sort(np.stack([corner_vertex, following], 1), 1), axis=0, return_inverse=True
    )
    edge_of = edge_of.reshape(-1)
    edge_faces = _incidence(edge_of, corner_face, len(edges), len(faces))
    ends = np.repeat(np.arange(len(edges)), 2)
    edge_vertex = _incidence(ends, edges.reshape(-1), len(edges), count)
    border = np.asarray(edge_faces.sum(1)).reshape(-1) != 2
    inner = sparse.diags((~border).astype(float))
    edge_point = inner @ (0.25 * edge_vertex + 0.25 * (edge_faces @ face_point)) + (
        sparse.diags(border.astype(float)) @ (0.5 * edge_vertex)
    )
    vertex_point = _vertex_rule(face_vertex, face_point, edge_vertex, edges, border, count)
    matrix = sparse.vstack([vertex_point, face_point, edge_point]).tocsr()

    lookup = sparse.csr_matrix(
        (np.arange(1, len(edges) + 1), (edges[:, 0], edges[:, 1])), shape=(count, count)
    )
    before = np.sort(np.stack([corner_vertex, preceding], 1), 1)
    edge_before = np.asarray(lookup[before[:, 0], before[:, 1]]).reshape(-1) - 1
    base = count + len(faces)
    quads = np.stack(
        [corner_vertex, base + edge_of, count + corner_face, base + edge_before], axis=1
    )
    return matrix, quads


def _vertex_rule(face_vertex, face_point, edge_vertex, edges, border, count) -> sparse.csr_matrix:
    valence = np.maximum(np.asarray(edge_vertex.sum(0)).reshape(-1), 1.0)
    face_count = np.maximum(np.asarray(face_vertex.sum(0)).reshape(-1), 1.0)
    around = sparse.diags(1.0 / face_count) @ (face_vertex.T @ face_point)
    midpoints = sparse.diags(1.0 / valence) @ (edge_vertex.T @ (0.5 * edge_vertex))
    smooth = sparse.diags(1.0 / valence) @ (
        around + 2.0 * midpoints + sparse.diags(valence - 3.0)
    )
    rim = edges[border]
    neighbours = _incidence(
        np.concatenate([rim[:, 0], rim[:, 1]]), np.concatenate([rim[:, 1], rim[:, 0]]), count, count
    )
    on_rim = np.asarray(neighbours.sum(1)).reshape(-1)
    curve = 0.75 * sparse.identity(count) + 0.125 * neighbours
    pick = [
        sparse.diags((on_rim == 0).astype(float)) @ smooth,
        sparse.diags((on_rim == 2).astype(float)) @ curve,
        sparse.diags(((on_rim != 0) & (on_rim != 2)).astype(float)),
    ]
    return (pick[0] + pick[1] + pick[2]).tocsr()


def _incidence(rows, columns, height: int, width: int) -> sparse.csr_matrix:
    return sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(height, width))


def subdivision(faces: np.ndarray, count: int, levels: int) -> tuple[sparse.csr_matrix, np.ndarray]:
    """`levels` steps as one matrix [V', count] and the quads of the finest mesh."""
    matrix: sparse.csr_matrix = sparse.identity(count, format="csr")
    for _ in range(levels):
        step, faces = subdivide(faces, matrix.shape[0])
        matrix = (step @ matrix).tocsr()
    return matrix.astype(np.float32), faces
