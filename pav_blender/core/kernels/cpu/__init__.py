"""Kernels for the CPU, compiled by numba on first use and kept on disk.

Importing this package decides where compiled code is kept, so it must come before numba: every
module here does so by being inside the package.
"""

from __future__ import annotations

import atexit
import hashlib
import importlib
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

from .. import MODULES

_ALONE = ("batches", "compositing", "networks", "tracing")  # without a counterpart in plain torch
_KEPT_CACHES = 6
_CHOSEN = "PAV_NUMBA_CACHE"  # what was chosen here, not by the user: child processes choose anew


def _cache_root() -> Path:
    if os.environ.get("PAV_CACHE"):  # as a Blender extension: the folder it may write to
        return Path(os.environ["PAV_CACHE"])
    if os.environ.get("XDG_CACHE_HOME"):
        return Path(os.environ["XDG_CACHE_HOME"])
    if sys.platform == "win32" and os.environ.get("LOCALAPPDATA"):
        return Path(os.environ["LOCALAPPDATA"])
    return Path.home() / ".cache"


def _fingerprint() -> str:
    """Hash of the kernels' sources: numba looks at one file's date and misses edits of imports.

    And of the package's name: compiled code imports its parts by it, and a Blender extension has
    another than what runs beside Blender.
    """
    digest = hashlib.sha256(__name__.encode())
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _usable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            os.utime(folder)
            return True
    except OSError:
        return False


def _forget_old(parent: Path) -> None:
    """Caches of earlier versions go, the most recently used ones stay."""
    try:
        folders = sorted(parent.iterdir(), key=lambda p: p.stat().st_mtime, reverse=True)
    except OSError:
        return
    for folder in folders[_KEPT_CACHES:]:
        shutil.rmtree(folder, ignore_errors=True)


def _choose_cache() -> str:
    parent = _cache_root() / "pav_blender" / "numba"
    folder = parent / _fingerprint()
    if _usable(folder):
        _forget_old(parent)
        return str(folder)
    # A private folder: compiled code in a shared one could be somebody else's.
    temporary = tempfile.mkdtemp(prefix="pav_blender-numba-")
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    return temporary


def _set_cache() -> None:
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given and given != os.environ.get(_CHOSEN):
        return
    os.environ["NUMBA_CACHE_DIR"] = os.environ[_CHOSEN] = folder = _choose_cache()
    loaded = sys.modules.get("numba.core.config")
    if loaded is not None and not loaded.CACHE_DIR:  # the host imported numba before us
        setattr(loaded, "CACHE_DIR", folder)  # noqa: B010  (a module's attribute, unknown to mypy)


_set_cache()
_told = False


def _tell_of_compiling() -> None:
    """The first use on a machine takes long: nobody shall wonder why."""
    global _told
    if not _told and not any(Path(os.environ["NUMBA_CACHE_DIR"]).rglob("*.nbi")):
        print(
            "pav: compiling kernels for this processor, once; it takes most of a minute",
            file=sys.stderr,
            flush=True,
        )
    _told = True


def __getattr__(name: str) -> Any:
    if name in (*MODULES, *_ALONE, "threads"):
        if name != "threads":
            _tell_of_compiling()
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
