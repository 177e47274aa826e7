"""Performances of the FLAME-shaped head: what the formats' fixtures write down."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from flame_fixture import SIZE, picture

from pav_blender.core.collection import LABELS
from pav_blender.core.head.oracle import rotation_matrix
from pav_blender.core.images import read_gray, read_rgba

FOCAL = 190.0
CENTRE = (50.25, 38.5)
FRAMES = 6


@dataclass
class Filmed:
    """Pictures of the head by other hands: RGBA files, their labels, and where the camera was."""

    pictures: list[Path]
    labels: list[Path]
    world_to_camera: np.ndarray  # [F, 4, 4], OpenCV; the head moves by the take's root and neck
    translation: np.ndarray  # [F, 3]
    resting: np.ndarray  # [F, 4, 4] likewise, for a head whose root and neck rest


@dataclass
class Take:
    """What happens in a clip; truth[frame number] = pixels [V, 2] as the tool projects them."""

    shape: np.ndarray
    expression: np.ndarray  # [F, 100]
    root: np.ndarray  # [F, 3]
    neck: np.ndarray
    jaw: np.ndarray
    eyes: np.ndarray  # [F, 2, 3]
    lids: np.ndarray  # [F, 2]
    truth: dict[int, np.ndarray] = field(default_factory=dict)
    size: tuple[int, int] = SIZE
    lens: tuple[float, float, float, float] = (FOCAL, FOCAL * 1.01, *CENTRE)
    held: int = 2  # frames at the end that are tested on, in formats that say so
    filmed: Filmed | None = None

    def __len__(self) -> int:
        return len(self.expression)

    def picture(self, frame: int, pixels: np.ndarray, depth: np.ndarray, size=None) -> np.ndarray:
        if self.filmed:
            return read_rgba(self.filmed.pictures[frame])
        return picture(pixels, depth, size or self.size)

    def labels(self, frame: int) -> np.ndarray | None:
        """What is where in a filmed picture, indices into the collection's LABELS."""
        return read_gray(self.filmed.labels[frame]) if self.filmed else None

    def turns(self, frame: int, *, root: bool = True, neck: bool = True) -> np.ndarray:
        still = np.zeros(3)
        return np.stack(
            [
                rotation_matrix(self.root[frame] if root else still),
                rotation_matrix(self.neck[frame] if neck else still),
                rotation_matrix(self.jaw[frame]),
                rotation_matrix(self.eyes[frame, 0]),
                rotation_matrix(self.eyes[frame, 1]),
            ]
        )


def take(seed: int = 0, frames: int = FRAMES) -> Take:
    random = np.random.default_rng(seed)
    shape = np.zeros(300)
    shape[:80] = random.normal(0, 0.5, 80)
    expression = np.zeros((frames, 100))
    expression[:, :40] = random.normal(0, 0.5, (frames, 40))
    turn = np.linspace(-0.4, 0.4, frames)
    zero = np.zeros(frames)
    return Take(
        shape,
        expression,
        root=np.stack([0.2 * turn, turn, 0.3 * turn], 1),
        neck=np.stack([0.1 * np.cos(5 * turn), 0.2 * turn, zero], 1),
        jaw=np.stack([random.uniform(0, 0.3, frames), 0.03 * turn, zero], 1),
        eyes=random.uniform(-0.25, 0.25, (frames, 2, 3)),
        lids=random.uniform(0, 0.8, (frames, 2)),
    )


def sixes(matrix: np.ndarray) -> np.ndarray:
    """A rotation's first two rows: PyTorch3D's six numbers."""
    return matrix[:2].ravel()


def looking_cv(root: np.ndarray, distance: float = 0.75) -> np.ndarray:
    """World to camera, OpenCV: before a face at the origin's height, turned against the head."""
    centre = np.array([0.0, -0.02, 0.03])
    turn = np.diag([1.0, -1.0, -1.0]) @ rotation_matrix(root)
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    matrix[:3, 3] = -turn @ centre + [0.01, 0.0, distance]
    return matrix


# the number that each of our labels has in INSTA's masks and in face-parsing networks' pictures
INSTA_CODES = {
    "face": 250, "eyes": 210, "accessory": 190, "ears": 170, "mouth": 140, "lips": 120, "neck": 110,
    "cloth": 90, "scalp_hair": 80, "facial_hair": 250,
}  # fmt: skip
PARSING_CODES = {
    "face": 1, "eyes": 4, "accessory": 18, "ears": 7, "mouth": 11, "lips": 12, "neck": 14,
    "cloth": 16, "scalp_hair": 17, "facial_hair": 1,
}  # fmt: skip


def coded(labels: np.ndarray, codes: dict[str, int]) -> np.ndarray:
    return np.array([codes.get(name, 0) for name in LABELS], np.uint8)[labels]
