"""What rendering and training need beside Blender, looked up without importing any of it."""

from __future__ import annotations

import importlib.util

from ..core.errors import PavError

NEEDED = ("torch", "numba", "safetensors", "OpenImageIO")


def missing() -> list[str]:
    """Names of the needed Python packages that this Python lacks."""
    return [name for name in NEEDED if importlib.util.find_spec(name) is None]


def explanation(names: list[str]) -> str:
    return (
        f"Blender's Python lacks {', '.join(names)}: install them there, or start Blender with "
        "PYTHONPATH set to where they are"
    )


def check() -> None:
    """PavError naming what is missing, if anything is."""
    names = missing()
    if names:
        raise PavError(explanation(names))
