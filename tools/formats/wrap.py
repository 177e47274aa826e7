"""A studio clip as a performance of the FLAME-shaped head, and as a source of every format.

That head's vertices are the built-in head's, its first directions are the built-in head's own, and
its joints lie where the built-in head's do: so the studio's pictures show it. `apart` says how
nearly. The formats' writers are those of the tests.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from pav_blender.core.collection import Clip, Collection
from pav_blender.core.head.oracle import rotation_matrix

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "core"))

import formats_fixtures as formats
from flame_fixture import SOFTER, flame, posed
from takes import Filmed, Take

HELD = 9  # of a studio clip of 54 frames, as the studio does
# source: the studio clip that it shows; the FLAME that its tool is used with
SOURCES = {
    "insta": ("crop", "2020"),
    "metrical": ("long", "2020"),
    "flashavatar": ("grey", "2020"),
    "imavatar": ("long", "2020"),
    "vhap": ("crop", "2023"),
    "gaussianavatars": ("grey", "2023"),
    "vhap-track": ("long", "2023"),
}
MODELS = {"2020": "generic_model.pkl", "2023": "flame2023.pkl"}


def write_models(root: Path) -> None:
    """`root`/2020 and `root`/2023: FLAME-shaped models and what lies beside them."""
    for version, name in MODELS.items():
        (root / version).mkdir(parents=True)
        formats.write_model(root / version / name, chumpy=version == "2020")
        formats.write_companions(root / version)


def write_source(name: str, collection: Collection, path: Path) -> Take:
    """The source called `name` in folder `path`; returns what is to be seen in it."""
    clip = collection.clip(SOURCES[name][0])
    rows = np.concatenate([clip.indices("train"), clip.indices("test")])
    whole = perform(collection, clip, rows)
    if name == "insta":
        formats.write_insta(path, act=whole)
    elif name == "metrical":
        formats.write_metrical(path, act=whole, matte=True)
    elif name == "flashavatar":
        formats.write_flashavatar(path, act=whole)
    elif name == "imavatar":
        formats.write_imavatar(path, act=whole)
    elif name == "vhap":
        formats.write_vhap(path, act=whole)
    elif name == "vhap-track":
        formats.write_vhap_track(path, act=whole)
    else:
        parts = rows[:-HELD], rows[-HELD:]
        first, second = (perform(collection, clip, part) for part in parts)
        formats.write_combined(path.parent, path.name, filmed=(first, second))
    return whole


def perform(collection: Collection, clip: Clip, rows: np.ndarray) -> Take:
    """Rows of a studio clip as the FLAME-shaped head's performance."""
    pose = clip.pose[rows].astype(np.float64)
    expression = np.zeros((len(rows), 100))
    expression[:, :52] = clip.expression[rows][:, flame().order] / SOFTER
    shape = np.zeros(300)
    shape[: len(collection.betas)] = collection.betas
    seen = np.linalg.inv(clip.camera_to_world[rows].astype(np.float64))
    translation = clip.translation[rows].astype(np.float64)
    joints = collection.head.joints(collection.betas).astype(np.float64)
    (fx, _, cx), (_, fy, cy), _ = clip.intrinsics[0].tolist()
    return Take(
        shape,
        expression,
        root=pose[:, 0],
        neck=pose[:, 1],
        jaw=pose[:, 2],
        eyes=pose[:, 3:],
        lids=np.zeros((len(rows), 2)),
        size=(clip.height, clip.width),
        lens=(fx, fy, cx, cy),
        held=HELD,
        filmed=Filmed(
            [collection.image_path(clip, row) for row in rows],
            [collection.labels_path(clip, row) for row in rows],
            seen,
            translation,
            np.stack(
                [
                    camera @ _of_skull(joints, turns, shift)
                    for camera, turns, shift in zip(seen, pose, translation, strict=True)
                ]
            ),
        ),
    )


def _of_skull(joints: np.ndarray, turns: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """How root and neck move the skull, [4, 4]: some formats hold a head whose neck rests."""
    root, neck = rotation_matrix(turns[0]), rotation_matrix(turns[1])
    move = np.eye(4)
    move[:3, :3] = root @ neck
    move[:3, 3] = root @ (joints[1] - joints[0]) + joints[0] + shift - move[:3, :3] @ joints[1]
    return move


def apart(collection: Collection, take: Take, clip: Clip, rows: np.ndarray) -> float:
    """Metres between the FLAME-shaped head's vertices and the studio's own, mean."""
    truth = collection.posed(clip, rows)[:, flame().kept]
    assert take.filmed
    ours = np.stack(
        [
            posed(take.shape, take.expression[at], take.turns(at), take.filmed.translation[at])
            for at in range(len(rows))
        ]
    )
    return float(np.linalg.norm(ours - truth, axis=2).mean())
