"""Where Python packages come from that Blender lacks: the extension's own folder (filled by
`install`), or an environment that the user has. Both are searched last: what Blender or its system
brings wins."""

from __future__ import annotations

import importlib
import os
import re
import sys
from pathlib import Path
from typing import Any

ROOT = __package__.rpartition(".")[0]  # the add-on's name in Blender's preferences
_added: list[str] = []


def preferences() -> Any | None:
    """The add-on's preferences; None where it was registered without being enabled."""
    import bpy

    addon = bpy.context.preferences.addons.get(ROOT)
    return addon.preferences if addon is not None else None


def user_folder(name: str) -> Path:
    """A folder of the extension's own, which outlives its updates; it need not exist."""
    import bpy

    try:
        return Path(bpy.utils.extension_path_user(ROOT, path=name))
    except ValueError:  # not installed as an extension
        return Path(bpy.utils.user_resource("EXTENSIONS")) / ".user" / ROOT / name


def own_folder() -> Path:
    """What was installed for this Python."""
    return user_folder(f"packages-{sys.implementation.cache_tag}")


def chosen_python() -> str:
    """The Python that jobs shall run in; "" for Blender's."""
    import bpy

    chosen = preferences()
    return bpy.path.abspath(chosen.python) if chosen is not None and chosen.python else ""


def chosen_environment() -> str:
    import bpy

    chosen = preferences()
    if chosen is None or not chosen.environment:
        return ""
    return str(bpy.path.abspath(chosen.environment))


def site_packages(environment: Path) -> Path | None:
    """The folder with the packages of an environment, named by itself or by its root."""
    if environment.name in ("site-packages", "dist-packages") and environment.is_dir():
        return environment
    here = f"python{sys.version_info[0]}.{sys.version_info[1]}"
    found = [environment / "Lib" / "site-packages", environment / "lib" / here / "site-packages"]
    found += sorted(environment.glob("lib/python3*/site-packages"))
    found += [environment] if (environment / "torch").is_dir() else []
    return next((folder for folder in found if folder.is_dir()), None)


def version_of(folder: Path) -> str:
    """The Python ("3.11") that a folder of packages is for, by what tells; "" if nothing does."""
    named = re.fullmatch(r"python(3\.\d+)", folder.parent.name)
    if named:
        return named[1]
    for above in (folder, *folder.parents[:3]):
        try:
            text = (above / "pyvenv.cfg").read_text(encoding="utf-8", errors="replace")
        except OSError:
            continue
        stated = re.search(r"^version(?:_info)?\s*=\s*(3\.\d+)", text, re.MULTILINE)
        if stated:
            return stated[1]
    for module in sorted((folder / "torch").glob("_C.*")):
        built = re.search(r"(?:cpython-|cp)3(\d+)", module.name)
        if built:
            return f"3.{built[1]}"
    return ""


def problem(environment: str) -> str:
    """What is wrong with an environment that was named, as one line; "" if nothing is."""
    if not environment:
        return ""
    folder = site_packages(Path(environment))
    if folder is None:
        return f"{environment}: no environment and no folder of packages"
    here = f"{sys.version_info[0]}.{sys.version_info[1]}"
    there = version_of(folder)
    if there and there != here:
        return f"{environment}: made for Python {there}; this Blender's is {here}"
    return ""


def added() -> list[str]:
    """The folders that `activate` added, which are searched last."""
    return list(_added)


def activate() -> None:
    """Looks for packages where the preferences say now."""
    deactivate()
    environment = chosen_environment()
    folders = [own_folder()]
    if environment and not problem(environment):
        folders.append(site_packages(Path(environment)) or folders[0])
    for folder in folders:
        if folder.is_dir() and str(folder) not in sys.path:
            sys.path.append(str(folder))
            _added.append(str(folder))
    importlib.invalidate_caches()
    if ROOT.startswith("bl_ext."):  # an extension writes nowhere else
        os.environ.setdefault("PAV_CACHE", str(user_folder("cache")))


def deactivate() -> None:
    for entry in _added:
        if entry in sys.path:
            sys.path.remove(entry)
    _added.clear()
