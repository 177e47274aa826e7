"""A head model out of a Blender mesh: shape keys, vertex groups, an armature.

The mesh is read at rest, in metres, where it stands in the scene. Blender's front view is the
face's: it looks along -y.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..core.head import HeadModel, head_from_shape_keys
from .axes import TO_CORE
from .mesh import group_weights
from .pose_keys import pose_keys
from .rig import CORRECTIVE_PREFIX, REGION_PREFIX, find_armature

_SMALLEST, _LARGEST = 0.08, 2.0  # metres from end to end: life size, with or without shoulders
_MEMBER = 0.5  # weight from which a vertex is in a region


def head_from_object(
    object_: Any,
    *,
    joints: Mapping[str, str] | None = None,
    regions: Mapping[str, str] | None = None,
) -> HeadModel:
    """The head that a mesh object is, named after it.

    Shape keys become expressions (muted ones, and a rig's pose keys, are left out). Bones whose
    vertex groups hold weights become joints, `joints` renaming some (ours -> theirs: {"jaw":
    "DEF-jaw"}); where several bones have no parent, or vertices no bone, a root is added that holds
    them. Vertex groups called
    `region.<name>` become regions, `regions` adding others (ours -> theirs). Without UVs xatlas
    makes an atlas.

    Raises InputError where the object is none that a head can be read from, and says why.
    """
    _check(object_)
    mesh = object_.data
    matrix = _to_metres(object_)
    points, keys = _positions(object_)
    vertices = points @ matrix[:3, :3].T + matrix[:3, 3]
    size = float((vertices.max(0) - vertices.min(0)).max())
    if not _SMALLEST <= size <= _LARGEST:
        raise InputError(
            f"object {object_.name!r} is {size:.3g} m long; a head is life size, "
            f"{_SMALLEST:g} to {_LARGEST:g} m: scale the object"
        )
    names, parents, places, weights = _joints(object_, dict(joints or {}))
    triangles, uvs, uv_triangles = _triangles(mesh)
    moved = {name: offset @ matrix[:3, :3].T for name, offset in keys.items()}
    correctives = [moved.pop(name) for name in _correctives(moved, len(names))]
    head = head_from_shape_keys(
        vertices,
        triangles,
        {name: vertices + offset for name, offset in moved.items()},
        uvs=uvs,
        uv_triangles=uv_triangles,
        joint_names=names,
        joint_parents=parents,
        joint_positions=places,
        skinning_weights=weights,
        regions=_regions(object_, dict(regions or {})),
        name=object_.name,
        origin=f"Blender object {object_.name!r}",
    )
    return replace(head, pose_basis=np.array(correctives)) if correctives else head


def _correctives(keys: Mapping[str, Any], joints: int) -> list[str]:
    """The keys that a rig of ours drives by its bones, in order; none where they are not all
    there."""
    names = [f"{CORRECTIVE_PREFIX}{index:03d}" for index in range(9 * (joints - 1))]
    return names if all(name in keys for name in names) else []


def open_object(path: Path | None, name: str | None) -> Any:
    """The mesh object `name` of a .blend, or of the file that is open (path None).

    No name: the only mesh there is that has shape keys. Raises InputError naming what there is.
    """
    try:
        import bpy
    except ImportError as error:
        raise InputError(
            "`pav head` needs Blender: `blender -b FILE --command pav head ...`, or "
            "`pip install bpy`"
        ) from error
    if path is not None:
        if not path.is_file():
            raise InputError(f"{path}: no such Blender file")
        try:
            # a file's own scripts are not run: nothing here needs them
            bpy.ops.wm.open_mainfile(filepath=str(path.resolve()), use_scripts=False)
        except RuntimeError as error:
            raise InputError(f"{path}: not a Blender file") from error
    meshes = [thing for thing in bpy.data.objects if thing.type == "MESH"]
    where = str(path) if path else "the open file"
    if name is None:
        keyed = [thing for thing in meshes if thing.data.shape_keys]
        if len(keyed) != 1:
            found = ", ".join(thing.name for thing in meshes) or "none"
            raise InputError(
                f"{where} has {len(keyed)} meshes with shape keys; say which with --object "
                f"(meshes: {found})"
            )
        return keyed[0]
    for thing in meshes:
        if thing.name == name:
            return thing
    found = ", ".join(thing.name for thing in meshes) or "none"
    raise InputError(f"{where} has no mesh object {name!r}; it has {found}")


def _check(object_: Any) -> None:
    if object_.type != "MESH":
        raise InputError(f"object {object_.name!r} is no mesh")
    if object_.mode == "EDIT":
        object_.update_from_editmode()
    if not object_.data.polygons:
        raise InputError(f"object {object_.name!r} has no faces")
    keys = object_.data.shape_keys
    if keys is not None and not keys.use_relative:
        raise InputError(
            f"object {object_.name!r}: its shape keys are absolute; make them relative"
        )
    for modifier in object_.modifiers:
        if not modifier.show_viewport:
            continue
        what = f"object {object_.name!r}: its modifier {modifier.name!r}"
        if modifier.type != "ARMATURE":
            raise InputError(
                f"{what} is not part of a head; apply it or switch it off in the viewport"
            )
        if modifier.use_deform_preserve_volume:
            raise InputError(f"{what} preserves volume, which heads do not; switch that off")


def _to_metres(object_: Any) -> np.ndarray:
    """From the mesh's own space to the core's axes and metres, [4, 4]."""
    import bpy

    units = bpy.context.scene.unit_settings
    scale = units.scale_length if units.system != "NONE" else 1.0
    return TO_CORE @ np.diag([scale, scale, scale, 1]) @ np.array(object_.matrix_world, np.float64)


def _positions(object_: Any) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The mesh's points [V, 3] in its own space, and each shape key's offsets from them."""
    mesh, keys = object_.data, object_.data.shape_keys
    if keys is None:
        return _coordinates(mesh.vertices), {}
    offsets = {}
    turning = pose_keys(object_, find_armature(object_))
    for key in keys.key_blocks:
        if key == keys.reference_key or key.mute or key.name in turning:
            continue
        offset = _coordinates(key.data) - _coordinates(key.relative_key.data)
        if key.vertex_group:
            offset *= group_weights(object_)[:, object_.vertex_groups[key.vertex_group].index, None]
        offsets[key.name] = offset
    return _coordinates(keys.reference_key.data), offsets


def _coordinates(points: Any) -> np.ndarray:
    flat = np.empty(3 * len(points), np.float32)
    points.foreach_get("co", flat)
    return flat.reshape(-1, 3).astype(np.float64)


def _joints(
    object_: Any, renamed: dict[str, str]
) -> tuple[list[str], list[int], np.ndarray | None, np.ndarray | None]:
    """Names, parents, places [J, 3] in core metres and weights [V, J]; a lone root of no place
    where no armature moves the mesh."""
    armature = find_armature(object_)
    if armature is None:
        if renamed:
            raise InputError(f"object {object_.name!r} has no armature to take joints from")
        return ["root"], [-1], None, None
    bones = armature.data.bones
    for ours, theirs in renamed.items():
        if theirs not in bones:
            raise InputError(f"armature {armature.name!r} has no bone {theirs!r} (for {ours!r})")
    every = group_weights(object_)
    groups = {group.name: group.index for group in object_.vertex_groups}
    kept = [
        bone
        for bone in sorted(bones, key=lambda bone: len(bone.parent_recursive))
        if bone.name in renamed.values()
        or (bone.use_deform and bone.name in groups and every[:, groups[bone.name]].any())
    ]
    called = {theirs: ours for ours, theirs in renamed.items()}
    names = [called.get(bone.name, bone.name) for bone in kept]
    above = [next((p for p in bone.parent_recursive if p in kept), None) for bone in kept]
    parents = [kept.index(parent) if parent is not None else -1 for parent in above]
    matrix = _to_metres(armature)
    places = [matrix[:3, :3] @ np.array(bone.head_local) + matrix[:3, 3] for bone in kept]
    columns = [
        every[:, groups[bone.name]] if bone.name in groups else np.zeros(len(every))
        for bone in kept
    ]
    weights = np.stack(columns, 1) if columns else np.zeros((len(every), 0))
    loose = weights.sum(1) <= 0
    if parents.count(-1) != 1 or (loose.any() and names[0] != "root"):
        # one joint that everything hangs on, and that holds what no bone moves
        names = ["base" if "root" in names else "root", *names]
        parents, places = [-1, *(parent + 1 for parent in parents)], [matrix[:3, 3], *places]
        weights = np.concatenate([np.zeros((len(every), 1)), weights], 1)
    weights[loose, 0] = 1
    if len(set(names)) < len(names):
        raise InputError(f"armature {armature.name!r} gives two joints one name: {names}")
    return names, parents, np.stack(places), weights


def _triangles(mesh: Any) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Triangles [T, 3], and UVs [U, 2] with their triangles [T, 3], or None without UVs."""
    mesh.calc_loop_triangles()
    count = 3 * len(mesh.loop_triangles)
    corners, loops = np.empty(count, np.int32), np.empty(count, np.int32)
    mesh.loop_triangles.foreach_get("vertices", corners)
    mesh.loop_triangles.foreach_get("loops", loops)
    layer = mesh.uv_layers.active
    if layer is None:
        return corners.reshape(-1, 3), None, None
    flat = np.empty(2 * len(mesh.loops), np.float32)
    layer.data.foreach_get("uv", flat)
    uvs, at = np.unique(flat.reshape(-1, 2)[loops], axis=0, return_inverse=True)
    return corners.reshape(-1, 3), uvs, at.reshape(-1, 3).astype(np.int32)


def _regions(object_: Any, renamed: dict[str, str]) -> dict[str, np.ndarray]:
    groups = {group.name: group.index for group in object_.vertex_groups}
    wanted = {
        name.removeprefix(REGION_PREFIX): name for name in groups if name.startswith(REGION_PREFIX)
    } | renamed
    for ours, theirs in wanted.items():
        if theirs not in groups:
            raise InputError(
                f"object {object_.name!r} has no vertex group {theirs!r} (for {ours!r})"
            )
    weights = group_weights(object_) if wanted else None
    return {
        ours: weights[:, groups[theirs]] >= _MEMBER  # type: ignore[index]
        for ours, theirs in wanted.items()
    }
