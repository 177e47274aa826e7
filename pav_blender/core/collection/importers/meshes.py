"""The vertices of tracked meshes: OBJ and PLY files of a head's vertices in its own order.

Their faces are not read: INSTA's have 8090 of FLAME's 9976 and leave 958 vertices without one.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from ...errors import InputError
from ...reading import MIB, read_bytes
from .parsed import VERTICES

_LARGEST = 1024 * MIB
_KINDS = {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8", "uchar": "u1",
          "uint8": "u1", "char": "i1", "int8": "i1", "short": "i2", "int16": "i2",
          "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4",
          "uint32": "u4"}  # fmt: skip


def read_vertices(path: Path, count: int | None = VERTICES) -> np.ndarray:
    """[count, 3] float32, in the file's units (None: however many there are); InputError for
    another mesh or a damaged file."""
    try:
        content = read_bytes(path, _LARGEST)
        found = _ply(content) if path.suffix == ".ply" else _obj(content)
    except (
        ValueError,
        DeprecationWarning,
        UnicodeDecodeError,
        IndexError,
        KeyError,
    ) as error:
        raise InputError(f"{path}: not a readable mesh ({error})") from error
    if found.shape != (count or len(found), 3):
        whose = "FLAME" if count == VERTICES else "the head"
        raise InputError(f"{path}: {len(found)} vertices; {whose} has {count}")
    return found


def _obj(content: bytes) -> np.ndarray:
    lines = [line[2:] for line in content.split(b"\n") if line.startswith(b"v ")]
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # what is no number
        values = np.fromstring(b" ".join(lines), np.float32, sep=" ")
    if not lines or len(values) % len(lines) or len(values) < 3 * len(lines):
        raise ValueError("lines of vertices are missing or differ in length")
    return values.reshape(len(lines), -1)[:, :3]


def _ply(content: bytes) -> np.ndarray:
    end = content.index(b"end_header\n") + len(b"end_header\n")
    header = content[:end].decode("ascii").splitlines()
    if header[0] != "ply":
        raise ValueError("not a PLY")
    count, form, inside = 0, "", False
    fields: list[tuple[str, str]] = []
    for words in (line.split() for line in header[1:]):
        if not words:
            continue
        if words[0] == "format":
            form = words[1]
        elif words[0] == "element":
            inside = words[1] == "vertex"
            if inside:
                count = int(words[2])
            elif not fields:
                raise ValueError("vertices must come first")
        elif words[0] == "property" and inside:
            fields.append((words[2], _KINDS[words[1]]))
    if not 0 < count < 10_000_000:
        raise ValueError("no vertices")
    if form == "ascii":
        lines = content[end:].split(b"\n")[:count]
        table = np.array([line.split() for line in lines], np.float32)
        order = [[name for name, _ in fields].index(axis) for axis in "xyz"]
        return table[:, order]
    kind = np.dtype([(n, (">" if form.endswith("big_endian") else "<") + k) for n, k in fields])
    record = np.frombuffer(content, kind, count, end)
    return np.stack([record[axis] for axis in "xyz"], 1).astype(np.float32)
