"""What the tracker should find on the studio's pictures: the truth as its fit holds it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pav_blender.core.collection import Clip, read_collection
from pav_blender.core.head import HeadModel
from pav_blender.core.images import read_rgba
from pav_blender.core.tracking.landmark_model import axis_angles, rotations
from pav_blender.core.tracking.terms import ClipFit

STUDIO = Path(__file__).resolve().parents[2] / "data" / "studio3"
_BEHIND = 110  # grey


@dataclass(eq=False)
class Filmed:
    """Training frames of a clip. fit: as the camera sees them; the root turns with the shoulders.
    pictures: uint8 [H, W, 3] each, the person before grey."""

    head: HeadModel
    betas: np.ndarray
    clip: Clip
    fit: ClipFit
    pictures: list[np.ndarray]


def filmed(look: str, frames: int) -> Filmed:
    collection = read_collection(STUDIO)
    clip = collection.clip(look)
    rows = clip.indices("train")[:frames]
    head, flip = collection.head, np.diag([1.0, -1.0, -1.0])
    to_camera = np.linalg.inv(clip.camera_to_world[rows].astype(np.float64))
    joint = head.joints(collection.betas)[0].astype(np.float64)
    turn, shift = flip @ to_camera[:, :3, :3], to_camera[:, :3, 3] @ flip
    pose = clip.pose[rows].astype(np.float64)
    pose[:, 0] = axis_angles(turn @ rotations(pose[:, 0]))
    place = np.einsum("fij,fj->fi", turn, joint + clip.translation[rows]) + shift - joint
    focal = float(clip.intrinsics[0, 0, 0])
    expression = clip.expression[rows].astype(np.float64)
    fit = ClipFit(focal, pose[len(rows) // 2, 0], pose, place, expression)
    betas = np.asarray(collection.betas, np.float64)
    return Filmed(head, betas, clip, fit, [_before_grey(collection, clip, row) for row in rows])


def _before_grey(collection, clip: Clip, row: int) -> np.ndarray:
    rgba = read_rgba(collection.image_path(clip, int(row))).astype(np.float32)
    alpha = rgba[..., 3:] / 255
    return (rgba[..., :3] * alpha + _BEHIND * (1 - alpha)).astype(np.uint8)


def held_still(seen: Filmed) -> ClipFit:
    """As landmarks have it: shoulders turned one way throughout, the head where it is."""
    truth, joints = seen.fit, seen.head.joints(seen.betas).astype(np.float64)
    bone, still = joints[1] - joints[0], rotations(truth.root)
    body = rotations(truth.pose[:, 0])
    pose = truth.pose.copy()
    pose[:, 0] = truth.root
    pose[:, 1] = axis_angles(still.T @ body @ rotations(pose[:, 1]))
    return replace(truth, pose=pose, translation=truth.translation + (body - still) @ bone)
