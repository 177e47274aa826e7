"""A baked mesh as one binary glTF file."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError, PavError
from ..files import replacing
from .bake import Baked


def write_glb(path: Path | str, baked: Baked, name: str) -> None:
    """Writes a `.glb`, whole or not at all: one mesh, one material without light of its own
    (`KHR_materials_unlit`), for the light is in the colours. Axes are glTF's: metres, +y up, +z
    forward, which are the core's."""
    path = Path(path)
    if path.suffix != ".glb":
        raise InputError(f"{path}: a baked mesh ends in .glb")
    try:
        import trimesh
        from PIL import Image
    except ImportError as error:
        raise PavError(f"writing glTF needs trimesh and pillow; {error.name} is missing") from error
    pixels = np.floor(np.clip(baked.texture, 0, 1) * 255 + 0.5).astype(np.uint8)
    with io.BytesIO() as stream:
        Image.fromarray(pixels).save(stream, "png", optimize=False)
        image = Image.open(io.BytesIO(stream.getvalue()))
    material = trimesh.visual.material.PBRMaterial(
        name=name, baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0
    )
    mesh = trimesh.Trimesh(
        baked.vertices,
        baked.triangles,
        vertex_normals=baked.normals,
        visual=trimesh.visual.TextureVisuals(uv=baked.uvs, material=material),
        process=False,
    )
    scene = trimesh.Scene()
    scene.add_geometry(mesh, geom_name=name)
    content = trimesh.exchange.gltf.export_glb(
        scene, include_normals=True, tree_postprocessor=_unlit
    )
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def _unlit(tree: dict[str, Any]) -> None:
    tree.setdefault("extensionsUsed", []).append("KHR_materials_unlit")
    for material in tree["materials"]:
        material.setdefault("extensions", {})["KHR_materials_unlit"] = {}
