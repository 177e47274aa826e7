"""What INSTA's and VHAP's layouts have in common: splits, lenses, copied pictures."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from ..collection import Clip, Collection
from ..errors import InputError
from ..files import write_text
from ..head import HeadModel, load_head, write_head
from ..head.flame import EXPRESSIONS, version_of

# ours -> theirs: "val" is their name for cameras that training never saw
SPLITS = {"train": "train", "test": "test", "view": "val"}
_SKEW = 1e-4  # pixels a pixel: what a pinhole without skew may leave out


def pinhole(clip: Clip, row: int) -> dict[str, float]:
    """`fl_x fl_y cx cy camera_angle_x camera_angle_y` of a frame, pixels and radians.

    InputError for a skewed lens: neither layout has a place for it.
    """
    (fx, skew, cx), (_, fy, cy), _ = clip.intrinsics[row].astype(float).tolist()
    if abs(skew) > _SKEW * fx:
        raise InputError(
            f"clip {clip.name}: frame {clip.frame_id[row]} has a skewed lens ({skew:.3g}); "
            "neither INSTA's nor VHAP's layout can say that"
        )
    return {
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx,
        "cy": cy,
        "camera_angle_x": 2 * math.atan(clip.width / (2 * fx)),
        "camera_angle_y": 2 * math.atan(clip.height / (2 * fy)),
    }


def write_transforms(
    folder: Path, top: dict[str, Any], frames: list[dict[str, Any]], splits: list[str]
) -> None:
    """`transforms.json` of all frames, and one file more for each of train, test and val."""
    chosen = {"": frames} | {
        f"_{theirs}": [f for f, s in zip(frames, splits, strict=True) if s == ours]
        for ours, theirs in SPLITS.items()
    }
    for suffix, listed in chosen.items():
        content = json.dumps({**top, "frames": listed}, indent=1)
        write_text(folder / f"transforms{suffix}.json", content + "\n")


def copy_picture(collection: Collection, clip: Clip, row: int, target: Path) -> None:
    """The RGBA picture as it is: its alpha is the matte there, too."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(collection.image_path(clip, row), target)


def write_head_file(folder: Path, collection: Collection) -> None:
    """`head.npz`: the head itself (regions, weights, bases), so that no peer has to guess it.

    FLAME is not ours to hand on, and its users have it.
    """
    if not version_of(collection.head):
        known = collection.head.fingerprint
        head = load_head(collection.head_name, known, beside=collection.path)
        write_head(folder / "head.npz", head)


def write_names(folder: Path, collection: Collection) -> None:
    """`names.json`: the head, its fingerprint, and what its coefficients are called."""
    head = collection.head
    names = {
        "head": head.name,
        "fingerprint": head.fingerprint,
        "expressions": head.expression_names,
    }
    write_text(folder / "names.json", json.dumps(names, indent=1) + "\n")


def expressions_of(head: HeadModel, expression: np.ndarray) -> np.ndarray:
    """A frame's coefficients [E], padded to the 100 that these layouts have; of FLAME only those
    that are FLAME's own (what eyelids do is in the meshes)."""
    own = expression[:EXPRESSIONS] if version_of(head) else expression
    return padded(own, EXPRESSIONS)


def padded(values: np.ndarray, count: int) -> np.ndarray:
    """The values [N] and zeros to `count`; a longer vector keeps what it has."""
    out = np.zeros(max(count, len(values)), np.float32)
    out[: len(values)] = values
    return out
