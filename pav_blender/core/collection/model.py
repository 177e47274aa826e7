"""What a collection holds: clips of tracked frames, each clip one appearance of the person."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..head import HeadModel

FORMAT = "pav-collection"
VERSION = 1

# the value of a pixel in labels/%06d.png is an index into this
LABELS = (
    "background",
    "face",
    "lips",
    "eyes",
    "mouth",
    "ears",
    "neck",
    "scalp_hair",
    "facial_hair",
    "cloth",
    "accessory",
)

# train: learned from; test: held-out frames; view: held-out cameras
SPLITS = ("train", "test", "view")

# of a clip, in its frames.npz; the last two only where there are any
ARRAYS = (
    "expression", "pose", "translation", "intrinsics", "camera_to_world", "frame_id", "split",
    "vertices", "landmarks",
)  # fmt: skip


@dataclass(eq=False)
class Clip:
    """One clip: F frames of `width` x `height` pixels, tracked. Arrays as in the collection file.

    expression [F, E]; pose [F, J, 3] axis-angle, radians; translation [F, 3] metres; intrinsics
    [F, 3, 3] pixels; camera_to_world [F, 4, 4], OpenCV axes; frame_id [F] int32, the number in the
    picture's name; split [F], one of SPLITS; vertices [F, V, 3] metres or None (posed parameters);
    landmarks [F, L, 2] pixels as the tracker saw them, or None.
    """

    name: str
    appearance: str
    width: int
    height: int
    expression: np.ndarray
    pose: np.ndarray
    translation: np.ndarray
    intrinsics: np.ndarray
    camera_to_world: np.ndarray
    frame_id: np.ndarray
    split: np.ndarray
    vertices: np.ndarray | None = None
    landmarks: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.frame_id)

    def indices(self, *splits: str) -> np.ndarray:
        """Row numbers of the frames in any of `splits`."""
        return np.flatnonzero(np.isin(self.split, splits))


@dataclass(eq=False)
class Collection:
    """Clips of one person: `betas` [B] is the identity they share, and so is `head_offset` [V, 3],
    metres, which `head` has in its template already (None: none)."""

    path: Path
    head_name: str
    head: HeadModel
    betas: np.ndarray
    clips: list[Clip]
    extra: dict = field(default_factory=dict)
    head_offset: np.ndarray | None = None

    def head_with(self, offset: np.ndarray | None) -> HeadModel:
        """The head model with another person's offset [V, 3] in place of this collection's."""
        zero = np.zeros_like(self.head.template)
        own = zero if self.head_offset is None else self.head_offset
        change = (zero if offset is None else offset) - own
        return self.head.with_offset(change) if change.any() else self.head

    @property
    def appearances(self) -> list[str]:
        """Names in order of first use; several clips may share one."""
        return list(dict.fromkeys(clip.appearance for clip in self.clips))

    def clip(self, name: str) -> Clip:
        for clip in self.clips:
            if clip.name == name:
                return clip
        names = ", ".join(clip.name for clip in self.clips)
        raise InputError(f"{self.path}: no clip named {name!r}; it has {names}")

    def only(self, appearance: str) -> Collection:
        """The same person's clips of one appearance alone."""
        clips = [clip for clip in self.clips if clip.appearance == appearance]
        if not clips:
            names = ", ".join(self.appearances)
            raise InputError(f"{self.path}: no appearance named {appearance!r}; it has {names}")
        return replace(self, clips=clips)

    def image_path(self, clip: Clip, row: int) -> Path:
        return self._picture("images", clip, row)

    def labels_path(self, clip: Clip, row: int) -> Path:
        return self._picture("labels", clip, row)

    def _picture(self, kind: str, clip: Clip, row: int) -> Path:
        path = self.path / "clips" / clip.name / kind / f"{clip.frame_id[row]:06d}.png"
        if not path.resolve().is_relative_to(self.path.resolve()):
            raise InputError(f"{path}: a link that leads out of the collection; it is not read")
        return path

    def posed(self, clip: Clip, rows: np.ndarray) -> np.ndarray:
        """Vertices of the tracked mesh, [len(rows), V, 3] float32 metres."""
        if clip.vertices is not None:
            return np.ascontiguousarray(clip.vertices[rows], np.float32)
        posed = self.head.pose(
            self.betas, clip.expression[rows], clip.pose[rows], clip.translation[rows]
        )
        return np.ascontiguousarray(posed.detach().numpy(), np.float32)
