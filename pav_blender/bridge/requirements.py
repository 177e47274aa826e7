"""What rendering and training need beside Blender, looked up without importing any of it."""

from __future__ import annotations

import importlib.metadata
import importlib.util

from ..core.errors import PavError

NEEDED = ("torch", "numba", "safetensors", "scipy", "OpenImageIO")
TRACKING = ("av", "mediapipe")
OPTIONAL = {"av": "reads videos", "mediapipe": "finds faces in them"}


def missing(names: tuple[str, ...] = NEEDED) -> list[str]:
    """Names of the needed Python packages that this Python lacks."""
    return [name for name in names if not present(name)]


def present(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:  # imported, and without a spec
        return True


def version(name: str) -> str:
    """The version of a package that is there, "" of one that is not."""
    if not present(name):
        return ""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "present"


def explanation(names: list[str]) -> str:
    return (
        f"Blender's Python lacks {', '.join(names)}: the add-on's preferences install them, "
        "or take an environment that has them"
    )


def check(names: tuple[str, ...] = NEEDED) -> None:
    """PavError naming what is missing, if anything is."""
    lacking = missing(names)
    if lacking:
        raise PavError(explanation(lacking))
