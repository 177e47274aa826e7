"""Paths of avatars that stay right: when a .blend is saved elsewhere, when heads are appended from
another, and when a file was moved."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ..core.errors import InputError, PavError
from . import avatars
from .avatars import heads_of, stored_path

_before: list[tuple[str, str]] = []  # objects and their paths, while a copy is saved


def relink(folder: Path) -> tuple[list[str], list[str]]:
    """Finds the files of missing avatars anywhere in `folder`: by their name, or where none has
    it, the only avatar of the same head that knows the appearance chosen. Returns the objects that
    were mended, and lines on those that were not."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    files = sorted(path for path in folder.rglob("*.pav") if path.is_file())
    mended, missing = [], []
    for object_ in heads_of(bpy.data.objects):
        if not _missing(object_):
            continue
        found = None if object_.library else _find(object_, files)
        if found is not None:
            object_.pav.avatar = stored_path(found, bpy.data.filepath)
            mended.append(object_.name)
        else:
            where = f" (linked from {object_.library.filepath})" if object_.library else ""
            missing.append(f"{object_.name}: {object_.pav.avatar}{where}")
    return mended, missing


def _missing(object_: Any) -> bool:
    try:
        return not avatars.path_of(object_.pav).is_file()
    except PavError:
        return True


def _find(object_: Any, files: list[Path]) -> Path | None:
    name = object_.pav.avatar.replace("\\", "/").rsplit("/", 1)[-1]
    fitting = [path for path in files if _fits(object_, path)]
    named = [path for path in fitting if path.name == name]
    if named:
        return named[0]
    return fitting[0] if len(fitting) == 1 else None


def _fits(object_: Any, path: Path) -> bool:
    """Whether an avatar file is of a head object's head, and knows the appearances chosen there."""
    try:
        header = avatars.header(path)
    except PavError:
        return False
    keys = object_.data.shape_keys if object_.type == "MESH" else None
    known = set(keys.key_blocks.keys()) if keys is not None else set()
    chosen = {avatars.chosen_number(worn) for worn in (object_.pav, *object_.pav.layers)} - {0}
    return set(header["expression_names"]) <= known and (
        chosen <= set(map(avatars.number, header["appearances"]))
    )


@bpy.app.handlers.persistent
def _before_saving(*arguments: Any) -> None:
    """Paths relative to the file as it was become relative to the file that is written; absolute
    ones inside its folder become relative."""
    _before.clear()
    target = arguments[0] if arguments and isinstance(arguments[0], str) else ""
    if not target:
        return
    folder = Path(target).resolve().parent
    for object_ in heads_of(bpy.data.objects):
        if object_.library is not None or not avatars.own_path(object_.pav):
            continue
        stored = object_.pav.avatar
        if stored.startswith("//") and not bpy.data.filepath:
            continue
        path = Path(bpy.path.abspath(stored))
        if stored.startswith("//") or path.resolve().is_relative_to(folder):
            wanted = stored_path(path, target)
            if wanted != stored:
                _before.append((object_.name, stored))
                object_.pav.avatar = wanted


@bpy.app.handlers.persistent
def _after_saving(*arguments: Any) -> None:
    """After a copy was saved, the open file's own paths come back."""
    target = arguments[0] if arguments and isinstance(arguments[0], str) else ""
    if target != bpy.data.filepath:
        for name, stored in _before:
            if name in bpy.data.objects:
                bpy.data.objects[name].pav.avatar = stored
    _before.clear()


@bpy.app.handlers.persistent
def _after_failing(*_arguments: Any) -> None:
    _after_saving("")


@bpy.app.handlers.persistent
def _after_import(context: Any, *_rest: Any) -> None:
    """Paths of appended heads, which were relative to the file that they came from."""
    for item in context.import_items:
        object_ = item.id
        if not isinstance(object_, bpy.types.Object) or object_.library is not None:
            continue
        stored, library = object_.pav.avatar, item.source_library
        if stored.startswith("//") and library is not None:
            folder = Path(bpy.path.abspath(library.filepath)).parent
            object_.pav.avatar = stored_path(folder / stored[2:], bpy.data.filepath)


def _handlers() -> list[tuple[list[Any], Any]]:
    handlers = bpy.app.handlers
    pairs = {
        "save_pre": _before_saving,
        "save_post": _after_saving,
        "save_post_fail": _after_failing,
        "blend_import_post": _after_import,  # from Blender 4.3 on
    }
    return [
        (getattr(handlers, name), handler)
        for name, handler in pairs.items()
        if hasattr(handlers, name)
    ]


def register() -> None:
    for where, handler in _handlers():
        where.append(handler)


def unregister() -> None:
    for where, handler in _handlers():
        where.remove(handler)
    _before.clear()
