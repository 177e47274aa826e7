"""A short performance no clip holds: what the demo's avatar is driven by."""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from .model import Clip, Collection


def performance(collection: Collection, frames: int = 24, name: str = "performance") -> Clip:
    """A made-up motion of `frames` frames before the first clip's camera; it has no pictures.

    The head turns and nods, a smile comes and goes, the mouth opens, both eyes blink, each on its
    own period. Works for heads with ARKit-named expressions; those a head lacks are left out.
    """
    if frames < 2:
        raise InputError(f"a performance of {frames} frames: at least 2")
    head, source = collection.head, collection.clips[0]
    first = int(source.indices("train", "test")[0])
    time = np.linspace(0, 1, frames, endpoint=False)
    turn = 2 * np.pi * time
    curves = {
        "jawOpen": 0.55 * np.clip(np.sin(2 * turn), 0, 1),
        "mouthSmileLeft": 0.8 * np.clip(np.sin(turn + 2.6), 0, 1),
        "mouthSmileRight": 0.8 * np.clip(np.sin(turn + 2.6), 0, 1),
        "eyeBlinkLeft": np.exp(-(((time - 0.45) / 0.03) ** 2)),
        "eyeBlinkRight": np.exp(-(((time - 0.45) / 0.03) ** 2)),
        "browInnerUp": 0.7 * np.clip(np.sin(turn - 0.6), 0, 1),
        "mouthPucker": 0.6 * np.clip(np.sin(3 * turn + 1.0), 0, 1) * (time > 0.6),
    }
    expression = np.zeros((frames, len(head.expression_names)), np.float32)
    for key, curve in curves.items():
        if key in head.expression_names:
            expression[:, head.expression_names.index(key)] = curve
    pose = np.repeat(source.pose[first][None], frames, 0)
    neck = head.joint_names.index("neck") if "neck" in head.joint_names else 0
    pose[:, neck, 0] = np.radians(7) * np.sin(turn + 0.5)
    pose[:, neck, 1] = np.radians(28) * np.sin(turn)
    pose[:, neck, 2] = np.radians(5) * np.sin(2 * turn + 1)

    def still(values: np.ndarray) -> np.ndarray:
        return np.repeat(values[first][None], frames, 0)

    return Clip(
        name=name,
        appearance=source.appearance,
        width=source.width,
        height=source.height,
        expression=expression,
        pose=pose,
        translation=still(source.translation),
        intrinsics=still(source.intrinsics),
        camera_to_world=still(source.camera_to_world),
        frame_id=np.arange(1, frames + 1, dtype=np.int32),
        split=np.full(frames, "test"),
    )
