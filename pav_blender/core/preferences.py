"""What this program remembers for a user: one JSON file in the folder for settings.

The folder is `$PAV_CONFIG`, or the platform's own: `~/.config/pav_blender` (or under
`$XDG_CONFIG_HOME`), `~/Library/Application Support/pav_blender`, `%APPDATA%\\pav_blender`.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

from .files import write_text

_NAME = "preferences.json"


def folder() -> Path:
    """Where preferences lie; it need not exist."""
    chosen = os.environ.get("PAV_CONFIG")
    if chosen:
        return Path(chosen)
    home = Path.home()
    if sys.platform == "darwin":
        return home / "Library" / "Application Support" / "pav_blender"
    if sys.platform == "win32":
        return Path(os.environ.get("APPDATA") or home / "AppData" / "Roaming") / "pav_blender"
    return Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config") / "pav_blender"


def read(section: str) -> dict[str, Any]:
    """A section of the preferences; empty where there is none or the file is damaged."""
    try:
        content = json.loads((folder() / _NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    found = content.get(section) if isinstance(content, dict) else None
    return dict(found) if isinstance(found, dict) else {}


def write(section: str, values: dict[str, Any]) -> Path:
    """Replaces a section; returns the file. Raises InputError where it cannot be written."""
    path = folder() / _NAME
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        content = {}
    content = content if isinstance(content, dict) else {}
    content[section] = values
    write_text(path, json.dumps(content, indent=1) + "\n")
    return path
