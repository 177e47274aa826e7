"""One person's motion on another's head."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..errors import InputError
from ..head import HeadModel
from .model import Clip

OTHER_PERSON = 0.002  # metres: fits of one person lie nearer, see identity_distance


def identity_distance(head: HeadModel, first: np.ndarray, second: np.ndarray) -> float:
    """How far two neutral heads [V, 3] lie apart, metres: the mean over the face (the whole mesh
    without one), after the rigid move that fits them best."""
    from scipy.spatial.transform import Rotation  # here: it takes a seventh of a second to load

    face = head.regions.get("face")
    rows = face if face is not None and face.any() else np.ones(len(first), bool)
    a, b = first[rows].astype(np.float64), second[rows].astype(np.float64)
    a, b = a - a.mean(0), b - b.mean(0)
    turn, _ = Rotation.align_vectors(b, a)
    return float(np.linalg.norm(turn.apply(a) - b, axis=1).mean())


def relative_clip(clip: Clip, neutral: int | None = None) -> Clip:
    """The clip's motion measured from its own neutral, to be put on the rest of another head.

    neutral: the number of the frame in which the person does nothing; None: the median of each
    number over the clip. Expressions and every joint's turn but the root's are what differs from
    the neutral; the translation is moved so that the neutral's is 0, and the cameras with it.
    Vertices beyond the parameters are the other person's, and are left out. InputError where the
    clip has no such frame.
    """
    from scipy.spatial.transform import Rotation

    if neutral is None:
        expression, pose, translation = (
            np.median(values, axis=0) for values in (clip.expression, clip.pose, clip.translation)
        )
    else:
        rows = np.flatnonzero(clip.frame_id == neutral)
        if len(rows) == 0:
            raise InputError(
                f"clip {clip.name!r} has no frame {neutral} to take for the neutral; it has "
                f"{clip.frame_id.min()} to {clip.frame_id.max()}"
            )
        row = int(rows[0])
        expression, pose, translation = clip.expression[row], clip.pose[row], clip.translation[row]
    turns = clip.pose.copy()
    for joint in range(1, turns.shape[1]):
        rest = Rotation.from_rotvec(pose[joint])
        turns[:, joint] = (rest.inv() * Rotation.from_rotvec(clip.pose[:, joint])).as_rotvec()
    cameras = clip.camera_to_world.copy()
    cameras[:, :3, 3] -= translation
    return replace(
        clip,
        expression=(clip.expression - expression).astype(np.float32),
        pose=turns,
        translation=(clip.translation - translation).astype(np.float32),
        camera_to_world=cameras,
        vertices=None,
    )
