"""A recording of Live Link Face as keyframes on a head."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import InputError
from .motion import Motion, apply_motion
from .overrides import check_editable
from .pose_keys import BACK_SUFFIX, CONTROL_SUFFIX
from .rig import find_armature


def import_take(
    mesh: Any, path: Path, *, start: int = 1, timecode_rate: float = 0.0, turn_head: bool = True
) -> str:
    """Replaces a head's animation by a recording, at the scene's frame rate from frame `start` on;
    returns what to tell the user. InputError where file and head do not go together."""
    import bpy

    from ..core.head.livelink import ARKIT_NAMES, expression_of, pose_of, read_take, resample

    scene = bpy.context.scene
    armature, keys = find_armature(mesh), mesh.data.shape_keys
    if armature is None or keys is None:
        what = "armature" if armature is None else "shape keys"
        raise InputError(f"object {mesh.name!r} has no {what} to move")
    check_editable(mesh, armature)
    take = resample(read_take(path, timecode_rate), scene.render.fps / scene.render.fps_base)
    names = tuple(name for name in ARKIT_NAMES if name in keys.key_blocks)
    joints = tuple(
        bone.name
        for bone in sorted(armature.data.bones, key=lambda bone: bone.parent is not None)
        if not bone.name.endswith((CONTROL_SUFFIX, BACK_SUFFIX))
    )
    expression = expression_of(take, names)
    pose = pose_of(take, names, joints)
    if not turn_head and "neck" in joints:
        pose[:, joints.index("neck")] = 0
    frames = start + np.arange(len(expression), dtype=np.float64)
    still = np.zeros((len(frames), 3))
    apply_motion(mesh, armature, names, joints, Motion(expression, pose, still, frames))
    scene.frame_start, scene.frame_end = int(frames[0]), int(frames[-1])
    scene.frame_set(scene.frame_start)
    lacking = [name for name in take.shapes if name not in names]
    missed = f"; the head has no {', '.join(lacking)}" if lacking else ""
    return f"{path.name}: {len(frames)} frames{missed}"
