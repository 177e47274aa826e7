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

from .errors import InputError
from .files import write_text
from .reading import read_json

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
    found = _content().get(section)
    return dict(found) if isinstance(found, dict) else {}


def write(section: str, values: dict[str, Any]) -> Path:
    """Replaces a section; returns the file. Raises InputError where it cannot be written."""
    path = folder() / _NAME
    write_text(path, json.dumps({**_content(), section: values}, indent=1) + "\n")
    return path


def _content() -> dict[str, Any]:
    try:
        return read_json(folder() / _NAME)
    except InputError:
        return {}
