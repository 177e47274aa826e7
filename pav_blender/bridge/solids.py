"""The other meshes of a scene, copied out of Blender when they change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core.rendering.solids import Shape, Solid
from .axes import TO_CORE

_GREY = (0.8, 0.8, 0.8)
_OUTLINED = {"WIRE", "BOUNDS"}


@dataclass(frozen=True, eq=False)
class _Copy:
    """A mesh's shape, and how it was split: corners [C] (the vertex of each), loops [T, 3] (the
    corners of each triangle), face [T] (what each is part of)."""

    shape: Shape
    faces: int
    corners: np.ndarray
    loops: np.ndarray
    face: np.ndarray


def _copy_of(mesh: Any, last: _Copy | None) -> _Copy:
    """A copy that shares with `last` what is the same in both; the shape itself if all is."""
    faces = len(mesh.polygons)
    corners = _read(mesh.attributes[".corner_vert"], "value", len(mesh.loops), np.int32)
    if last is not None and faces == last.faces and np.array_equal(corners, last.corners):
        loops, face, triangles = last.loops, last.face, last.shape.triangles
    else:
        loops, face = _split(mesh)
        triangles = corners[loops]
    count = len(mesh.vertices)
    vertices = _read(mesh.attributes["position"], "vector", count, np.float32, 3)
    normals, normal_of = _normals(mesh, triangles, loops, face)
    shape = Shape(vertices, triangles, normals, normal_of, _materials(mesh, face))
    if last is not None and _same(shape, last.shape):
        shape = last.shape
    return _Copy(shape, faces, corners, loops, face)


def _normals(
    mesh: Any, triangles: np.ndarray, loops: np.ndarray, face: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Flat faces have one each, smooth surfaces one a vertex, others one a corner."""
    if mesh.normals_domain == "POINT":
        source, index = mesh.vertex_normals, triangles
    elif mesh.normals_domain == "FACE":
        source, index = mesh.polygon_normals, np.repeat(face[:, None], 3, 1)
    else:
        source, index = mesh.corner_normals, loops
    found = np.empty(3 * len(source), np.float32)
    source.foreach_get("vector", found)
    return found.reshape(-1, 3), index


def _materials(mesh: Any, face: np.ndarray) -> np.ndarray:
    attribute = mesh.attributes.get("material_index")
    if attribute is None or attribute.domain != "FACE" or attribute.data_type != "INT":
        return np.zeros(len(face), np.int32)
    return _read(attribute, "value", len(mesh.polygons), np.int32)[face]


class Copies:
    """What one 3D view has copied: meshes that did not change are not read again."""

    def __init__(self) -> None:
        # by object and mesh, and by object alone: a mesh that changed may lie elsewhere
        self._known: dict[tuple[int, int], _Copy] = {}
        self._last: dict[int, _Copy] = {}

    def collect(self, depsgraph: Any, shown: Callable[[Any], bool]) -> tuple[Solid, ...]:
        """Every visible mesh (or what has one: text, curves, metaballs, instances) but heads that
        wear an avatar, and those drawn as wires or bounds. shown: whether an evaluated object is to
        be seen. Colours are the materials' viewport colours."""
        changed = {u.id.original.as_pointer() for u in depsgraph.updates if u.is_updated_geometry}
        known: dict[tuple[int, int], _Copy] = {}
        solids = []
        # curves, texts, surfaces and metaballs come a second time, as the mesh that they make
        for instance in depsgraph.object_instances:
            evaluated = instance.object
            if evaluated.type != "MESH" or not instance.show_self or evaluated.pav.avatar:
                continue
            if evaluated.display_type in _OUTLINED:
                continue
            if not shown(instance.parent if instance.is_instance else evaluated):
                continue
            copy = self._copy(evaluated, changed, known)
            if copy is not None and len(copy.shape.triangles):
                place = TO_CORE @ np.array(instance.matrix_world, np.float64)
                if np.isfinite(place).all():
                    solids.append(Solid(copy.shape, place, _colours(evaluated)))
        self._known = known
        self._last = {original: copy for (original, _), copy in known.items()}
        return tuple(solids)

    def _copy(
        self, evaluated: Any, changed: set[int], known: dict[tuple[int, int], _Copy]
    ) -> _Copy | None:
        original, data = evaluated.original, evaluated.data
        key = original.as_pointer(), data.as_pointer()
        stale = key[0] in changed or (original.data and original.data.as_pointer() in changed)
        if key not in known and key in self._known and not stale:
            known[key] = self._known[key]
        if key not in known:
            editing = evaluated.mode == "EDIT"  # what is being edited is not in its mesh yet
            mesh = evaluated.to_mesh() if editing else data
            if len(mesh.polygons):
                known[key] = _copy_of(mesh, self._last.get(key[0]))
            if editing:
                evaluated.to_mesh_clear()
        return known.get(key)


def _split(mesh: Any) -> tuple[np.ndarray, np.ndarray]:
    """Triangles [T, 3] as a mesh's corners, and the face [T] that each is part of."""
    starts = np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("loop_start", starts)
    sizes = np.diff(starts, append=len(mesh.loops))
    face = np.repeat(np.arange(len(starts), dtype=np.int32), sizes - 2)
    if (sizes == 3).all():
        return np.arange(len(mesh.loops), dtype=np.int32).reshape(-1, 3), face
    mesh.calc_loop_triangles()
    loops = np.empty(3 * len(mesh.loop_triangles), np.int32)
    mesh.loop_triangles.foreach_get("loops", loops)
    return loops.reshape(-1, 3), face


def _read(attribute: Any, name: str, count: int, kind: type, width: int = 1) -> np.ndarray:
    values: np.ndarray = np.empty(count * width, kind)
    attribute.data.foreach_get(name, values)
    return values.reshape(-1, width) if width > 1 else values


def _same(one: Shape, other: Shape) -> bool:
    return one.triangles is other.triangles and all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("vertices", "normals", "normal_of", "material")
    )


def _colours(evaluated: Any) -> np.ndarray:
    """A row for every material slot, scene-linear; light grey where there is none."""
    materials = [slot.material for slot in evaluated.material_slots] or list(
        evaluated.data.materials
    )
    rows = [tuple(m.diffuse_color[:3]) if m is not None else _GREY for m in materials]
    return np.array(rows or [_GREY], np.float32)
