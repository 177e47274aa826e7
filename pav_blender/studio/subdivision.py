"""Catmull-Clark subdivision as one sparse matrix: a posed mesh is refined by a single product."""

from __future__ import annotations

import numpy as np
from scipy import sparse


def quads_of(triangles: np.ndarray) -> np.ndarray:
    """Faces [N,4] of a triangle list [T,3] that was cut from quads; -1 ends a face that was none.

    A quad's halves are (a,b,c) and, anywhere later in the list, (a,c,d): each triangle is joined
    with the one that starts with its diagonal, unless that one is taken.
    """
    rows = triangles.tolist()
    starting = {(a, b): number for number, (a, b, _) in enumerate(rows)}
    taken = [False] * len(rows)
    quads, alone = [], []
    for number, (a, b, c) in enumerate(rows):
        if taken[number]:
            continue
        partner = starting.get((a, c), -1)
        if partner > number and not taken[partner]:
            taken[partner] = True
            quads.append((a, b, c, rows[partner][2]))
        else:
            alone.append((a, b, c, -1))
    return np.asarray([*quads, *alone], np.int64).reshape(-1, 4)


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
    smooth = sparse.diags(1.0 / valence) @ (around + 2.0 * midpoints + sparse.diags(valence - 3.0))
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
