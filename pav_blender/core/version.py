"""The version of this program, as the extension's manifest names it."""

from __future__ import annotations

import functools
import tomllib
from pathlib import Path

_MANIFEST = Path(__file__).parents[1] / "blender_manifest.toml"


@functools.cache
def version() -> str:
    return str(tomllib.loads(_MANIFEST.read_text(encoding="utf-8"))["version"])
