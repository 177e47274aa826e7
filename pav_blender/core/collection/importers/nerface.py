"""NeRFace's datasets are recognised, and refused with what they lack."""

from __future__ import annotations

from pathlib import Path

from ...errors import InputError
from .parsed import ParsedClip
from .source import Tell, first_frame, peek_json

TITLE = "NeRFace"
_FILES = ("transforms_train.json", "transforms.json", "transforms_test.json", "transforms_val.json")


def looks_like(path: Path) -> bool:
    """Transforms whose frames hold expression coefficients and no mesh."""
    frames = (first_frame(peek_json(path / name)) for name in _FILES)
    return any("expression" in f and "mesh_path" not in f for f in frames)


def read(path: Path, name: str, tell: Tell = None) -> list[ParsedClip]:
    """Raises InputError: there is no mesh, and its coefficients are of another face model."""
    raise InputError(
        f"{path}: a NeRFace dataset ({name}) has no mesh and no identity, and its 76 expression "
        "coefficients belong to another face model than FLAME, so that no head can be posed from "
        "it; track its pictures with metrical-tracker or VHAP and import that, or give the video "
        "to pav track"
    )
