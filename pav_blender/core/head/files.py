"""Head models on disk: one npz, read without pickle.

Arrays carry the names of :class:`HeadModel`'s fields, regions are ``region/<name>``. A basis may be
stored as int16 multiples of a step in metres (``<basis>_step``), which packs to about a third.
"""

from __future__ import annotations

import os
import uuid
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..reading import read_arrays
from .model import HeadModel

FORMAT = "pav-head"
VERSION = 1
_STRINGS = ("name", "origin")
_NAMES = ("expression_names", "joint_names")
_QUANTISED = ("shape_basis", "expression_basis", "pose_basis")
_FLAG = "joints_follow_expression"  # absent from older files, where it is false
_OTHERS = (*_STRINGS, *_NAMES, _FLAG, "regions")
_ARRAYS = tuple(field.name for field in fields(HeadModel) if field.name not in _OTHERS)
_INDICES = ("triangles", "uv_triangles", "joint_parents", "landmark_triangles")
_REGION = "region/"


def write_head(path: str | Path, head: HeadModel, *, step: float | None = None) -> None:
    """Write a head, atomically.

    step: metres; bases are rounded to multiples of it (None keeps float32). Raises
    :class:`InputError` where a basis is too large for the step or the folder does not exist.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise InputError(f"{path.parent} is not a folder; make it before writing {path.name}")
    content: dict[str, np.ndarray] = {
        "format": np.array(FORMAT),
        "version": np.array(VERSION),
        **{name: np.array(getattr(head, name)) for name in _STRINGS},
        **{name: np.array(getattr(head, name), dtype=np.str_) for name in _NAMES},
        **{name: getattr(head, name) for name in _ARRAYS},
        _FLAG: np.array(head.joints_follow_expression),
        **{_REGION + name: mask for name, mask in head.regions.items()},
    }
    if step is not None:
        for name in _QUANTISED:
            content[name] = _quantise(name, content[name], step)
            content[name + "_step"] = np.array(step, np.float32)
    # not mkstemp, which would leave a file that only its owner may read
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    try:
        with temporary.open("xb") as stream:
            np.savez_compressed(stream, **content)  # type: ignore[arg-type]
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def read_head(path: str | Path) -> HeadModel:
    """Read a head written by :func:`write_head`.

    Raises :class:`InputError` where the file is missing, is no npz, was written for another
    version, or its arrays do not make a head.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such head file")
    return _assemble(path, read_arrays(path))


def _assemble(path: Path, content: dict[str, np.ndarray]) -> HeadModel:
    if str(content.get("format", "")) != FORMAT:
        raise InputError(f"{path}: not a head file (its format entry is not '{FORMAT}')")
    version = str(content.get("version", "none"))
    if version != str(VERSION):
        raise InputError(
            f"{path}: head file version {version}; this program reads version {VERSION}"
        )
    missing = [n for n in (*_STRINGS, *_NAMES, *_ARRAYS) if n not in content]
    if missing:
        raise InputError(f"{path}: the head file lacks {', '.join(missing)}")
    kinds = dict.fromkeys(_ARRAYS, ("iuf", "numbers"))
    kinds |= dict.fromkeys(_INDICES, ("iu", "whole numbers"))
    marks = [name for name in content if name == _FLAG or name.startswith(_REGION)]
    kinds |= dict.fromkeys(marks, ("b", "yes or no"))
    for name, (allowed, what) in kinds.items():
        if content[name].dtype.kind not in allowed:
            raise InputError(f"{path}: {name} holds {content[name].dtype}, not {what}")
    for name in _QUANTISED:
        if name + "_step" in content:
            step = content[name + "_step"]
            if step.shape != () or step.dtype.kind not in "iuf":
                raise InputError(f"{path}: {name}_step is not one number")
            with np.errstate(over="ignore"):  # what is too large is infinite, and told
                content[name] = content[name].astype(np.float32) * np.float32(step)
    values: dict[str, Any] = {name: content[name] for name in _ARRAYS}
    values |= {name: str(content[name]) for name in _STRINGS}
    values |= {name: tuple(content[name].ravel().tolist()) for name in _NAMES}
    values[_FLAG] = bool(np.any(content.get(_FLAG, False)))
    values["regions"] = {
        name.removeprefix(_REGION): mask
        for name, mask in content.items()
        if name.startswith(_REGION)
    }
    try:
        return HeadModel(**values)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _quantise(name: str, basis: np.ndarray, step: float) -> np.ndarray:
    counts = np.round(basis / np.float32(step))
    if counts.size and np.abs(counts).max() > np.iinfo(np.int16).max:
        reach = np.abs(basis).max()
        raise InputError(f"{name} reaches {reach:.3g} m, too far for a step of {step}")
    return counts.astype(np.int16)
