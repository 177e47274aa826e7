"""Single files in other programs' formats: checkpoints, meshes, JSON."""

from __future__ import annotations

import json
import pickle
import zipfile
from pathlib import Path

import numpy as np
from flame_fixture import flame


def save_frame(path: Path, content: dict) -> None:
    """What `torch.save` writes of a dict of numpy arrays: a zip with one pickle in it."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", pickle.dumps(content, protocol=2))
        archive.writestr("archive/version", "3\n")


def obj_text(vertices: np.ndarray) -> str:
    """As INSTA's meshes: 8090 faces, so that some vertices belong to none."""
    faces = flame().arrays["f"].astype(int)[:8090] + 1
    lines = [f"v {x:.8f} {y:.8f} {z:.8f}" for x, y, z in vertices]
    return "\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in faces)]) + "\n"


def ply_bytes(vertices: np.ndarray) -> bytes:
    faces = flame().arrays["f"].astype(int)
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(len(faces), [("n", "u1"), ("v", "<i4", 3)])
    rows["n"], rows["v"] = 3, faces
    return header.encode() + vertices.astype("<f4").tobytes() + rows.tobytes()


def opaque(rgba: np.ndarray, background: int) -> np.ndarray:
    """The picture laid over a plain grey, without alpha."""
    part = rgba[..., 3:].astype(np.float64) / 255
    colour = rgba[..., :3] * part + background * (1 - part)
    full = np.full_like(part, 255)
    return np.round(np.concatenate([colour, full], 2)).astype(np.uint8)


def write_json(path: Path, content: dict) -> None:
    path.write_text(json.dumps(content))


def rewrite_json(path: Path, change) -> None:
    """Lets `change` alter a JSON file's content in place."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
