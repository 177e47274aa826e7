"""What every importer makes of a source: clips as their tool meant them, before normalising."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError

JOINTS = ("root", "neck", "jaw", "left_eye", "right_eye")  # FLAME's order
POSE_JOINTS = len(JOINTS)
VERTICES = 5023
LEAVE = 255  # in a table of labels: keep what an earlier layer said


@dataclass(frozen=True)
class Picture:
    """A picture, what to cut it out with, and layers of labels: (file, table [256] of labels)."""

    image: Path
    matte: Path | None = None
    labels: tuple[tuple[Path, np.ndarray], ...] = ()


@dataclass(eq=False)
class ParsedClip:
    """One clip, F frames. Metres; cameras camera-to-world, OpenCV axes, in the tool's own world.

    flame: the FLAME it was tracked with ("2020", "2023"); head: the fingerprint of the very head,
    where `pav export` wrote the source, and then V and E are that head's. shape [B]; expression
    [F, E]; pose [F, 5, 3] axis-angle; eyelids [F, 2] (left, right) or None; vertices [F, V, 3]: the
    posed mesh where the tool wrote it; canonical [V, 3]: its neutral head with the jaw open by 12
    degrees; offset [V, 3] is added to the template; moving_offset [F, V, 3] likewise, a frame.
    lost: what of the source has no place in a collection; skipped: frames left out, and why.
    """

    name: str
    tool: str
    flame: str
    width: int
    height: int
    shape: np.ndarray | None
    expression: np.ndarray
    pose: np.ndarray
    translation: np.ndarray
    intrinsics: np.ndarray
    camera_to_world: np.ndarray
    frame_id: np.ndarray
    split: np.ndarray
    pictures: list[Picture]
    eyelids: np.ndarray | None = None
    vertices: np.ndarray | None = None
    canonical: np.ndarray | None = None
    offset: np.ndarray | None = None
    moving_offset: np.ndarray | None = None
    appearance: str = ""
    head: str = ""
    habit: int = 0  # frames at the end that the tool's users hold out; where no split is given
    lost: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.frame_id)


_LARGEST = 1e7  # metres, radians, pixels or coefficients: more is as good as infinite
_ROW = ("expression", "pose", "translation", "intrinsics", "camera_to_world")
_OPTIONAL = ("eyelids", "vertices", "moving_offset")


def stacked(name: str, tool: str, rows: list[dict[str, Any]], **rest: Any) -> ParsedClip:
    """A clip out of rows in order: each a dict of the arrays of a frame, `frame_id` and `picture`.

    Rows with values that are not finite, whose number came before, or that lack the matte that
    others have, are left out by name.
    InputError where none is left.
    """
    skipped = list(rest.pop("skipped", ()))
    kept: dict[int, dict[str, Any]] = {}
    cut = any(row["picture"].matte for row in rows)
    for row in rows:
        number = int(row["frame_id"])
        bad = [k for k in (*_ROW, *_OPTIONAL) if k in row and not _sensible(row[k])]
        if bad:
            skipped.append(f"frame {number}: {bad[0]} is not finite")
        elif cut and row["picture"].matte is None:
            skipped.append(f"frame {number}: its matte is missing")
        elif number in kept:
            skipped.append(f"frame {number}: there twice")
        else:
            kept[number] = row
    if not kept:
        why = f" (for example {skipped[0]})" if skipped else ""
        raise InputError(f"{name}: no frame of this {tool} source can be used{why}")
    used = [kept[number] for number in sorted(kept)]
    for key in (*_ROW, *_OPTIONAL):
        if len({np.shape(row[key]) for row in used if row.get(key) is not None}) > 1:
            raise InputError(f"{name}: its frames differ in the size of {key}")
    arrays: dict[str, Any] = {
        key: np.stack([np.asarray(row[key], np.float64) for row in used]) for key in _ROW
    }
    if not rest.get("head"):
        arrays["expression"] = arrays["expression"][:, :100]
    arrays["camera_to_world"][:, 3] = (0, 0, 0, 1)
    for key in _OPTIONAL:
        if all(row.get(key) is not None for row in used):
            kind = np.float64 if key == "eyelids" else np.float32
            arrays[key] = np.stack([np.asarray(row[key], kind) for row in used])
    return ParsedClip(
        name=name,
        tool=tool,
        frame_id=np.array([row["frame_id"] for row in used], np.int32),
        split=np.array([row.get("split", "train") for row in used], "<U8"),
        pictures=[row["picture"] for row in used],
        skipped=skipped,
        **arrays,
        **rest,
    )


def _sensible(values: Any) -> bool:
    return bool((np.abs(values) < _LARGEST).all())  # false for what is no number


def padded_pose(**joints: np.ndarray) -> np.ndarray:
    """Axis-angle of named joints -> [5, 3]; the others rest."""
    pose = np.zeros((POSE_JOINTS, 3))
    for joint, turn in joints.items():
        pose[JOINTS.index(joint)] = turn
    return pose
