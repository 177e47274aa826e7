"""Posed meshes as OBJ or PLY files, one a frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..collection import Clip, Collection
from ..errors import InputError
from ..files import new_folder, replacing
from ..head import HeadModel
from ..progress import Report

FORMATS = ("obj", "ply")
_AT_ONCE = 16  # frames that are posed together


def export_meshes(
    collection: Collection,
    clips: list[Clip],
    out: Path,
    kind: str,
    *,
    progress: Report | None = None,
) -> int:
    """Writes `out`/<clip>/<frame_id>.<kind> for every frame; returns how many.

    Vertices in the head's own order, metres, core axes (+y up, the face toward +z): the tracked
    mesh where the collection's cameras see it. OBJ carries UVs.
    """
    if kind not in FORMATS:
        raise InputError(f"format {kind!r}: one of {', '.join(FORMATS)}")
    total, done = sum(len(clip) for clip in clips), 0
    with new_folder(out) as folder:
        for clip in clips:
            writer = ObjWriter(collection.head) if kind == "obj" else None
            for row, vertices in posed_rows(collection, clip):
                path = folder / clip.name / f"{clip.frame_id[row]:06d}.{kind}"
                path.parent.mkdir(exist_ok=True)
                if writer is not None:
                    writer.write(path, vertices)
                else:
                    write_ply(path, vertices, collection.head.triangles)
                done += 1
                if progress:
                    progress(done / total, mesh=f"{clip.name}/{path.name}")
    return total


def posed_rows(collection: Collection, clip: Clip):
    """Yields (row, vertices [V, 3]) of every frame of a clip, posed some at a time."""
    for start in range(0, len(clip), _AT_ONCE):
        rows = np.arange(start, min(start + _AT_ONCE, len(clip)))
        yield from zip(rows.tolist(), collection.posed(clip, rows), strict=True)


class ObjWriter:
    """OBJ files of one head: what they have in common is written out once."""

    def __init__(self, head: HeadModel) -> None:
        corners = np.stack([head.triangles, head.uv_triangles], -1) + 1
        faces = "f %d/%d %d/%d %d/%d\n" * len(corners) % tuple(corners.ravel().tolist())
        uvs = "vt %.6f %.6f\n" * len(head.uvs) % tuple(head.uvs.ravel().tolist())
        self._rest = uvs + faces

    def write(self, path: Path, vertices: np.ndarray) -> None:
        """Vertices [V, 3] in metres, to a micrometre."""
        points = "v %.6f %.6f %.6f\n" * len(vertices) % tuple(vertices.ravel().tolist())
        with replacing(path) as temporary:
            temporary.write_text(points + self._rest, encoding="ascii")


def write_ply(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> None:
    """A binary PLY of vertices [V, 3] and triangles [T, 3], whole or not at all."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, triangles
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        stream.write(header.encode("ascii"))
        stream.write(np.ascontiguousarray(vertices, "<f4").tobytes())
        stream.write(faces.tobytes())
