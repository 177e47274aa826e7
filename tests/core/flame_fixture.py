"""A head shaped like FLAME, its files, and posing and projecting as the tools do.

5023 vertices, 5 joints, 300 + 100 directions, cut from the built-in head. Posing and projecting are
written here again, so that what importers make of a folder is compared with pixels they had no
part in.
"""

from __future__ import annotations

import pickle
import struct
import sys
import types
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from pav_blender.core.head import HeadModel, builtin_head
from pav_blender.core.rendering.cameras import Camera
from pav_blender.core.rendering.rasterise import rasterise

VERTICES = 5023
SIZE = (80, 96)  # height, width
SOFTER = 0.3  # its expressions are so much of the built-in head's


@dataclass
class Flame:
    """The model's arrays as FLAME's files name them, and what lies beside them."""

    arrays: dict[str, np.ndarray]
    uvs: np.ndarray
    uv_faces: np.ndarray
    masks: dict[str, np.ndarray]
    eyelids: tuple[np.ndarray, np.ndarray]
    kept: np.ndarray  # the built-in head's vertex that each vertex is
    order: np.ndarray  # the built-in head's expression that each of the first 52 is


@lru_cache(maxsize=2)
def flame(seed: int = 0) -> Flame:
    """A head with FLAME's numbers, cut from the built-in one; another seed, other expressions."""
    random = np.random.default_rng(7 + seed)
    head = builtin_head()
    spare = [head.regions[name] for name in ("torso", "tongue", "mouth_interior")]
    order = np.argsort(sum(mask.astype(int) * 2**i for i, mask in enumerate(spare[::-1])))
    torso = np.flatnonzero(head.regions["torso"])
    others = [v for v in order[::-1] if v not in set(torso.tolist())]
    drop = np.concatenate([torso, others])[: len(head.template) - VERTICES]
    kept = np.setdiff1d(np.arange(len(head.template)), drop)
    new = np.full(len(head.template), -1)
    new[kept] = np.arange(VERTICES)
    whole = (new[head.triangles] >= 0).all(1)
    faces = new[head.triangles[whole]].astype(np.uint32)
    template = head.template[kept].astype(np.float64)
    shapes = np.zeros((300, VERTICES, 3))
    shapes[:64] = head.shape_basis[:, kept]
    mix = random.normal(0, 0.2, (236, 64)) / np.arange(1, 237)[:, None] ** 0.5
    shapes[64:] = np.tensordot(mix, shapes[:64], 1) + 2e-4 * waves(template, 236, random)
    expressions = np.zeros((100, VERTICES, 3))
    order = random.permutation(52)
    expressions[:52] = SOFTER * head.expression_basis[order][:, kept]
    expressions[52:] = np.tensordot(random.normal(0, 0.2, (48, 52)), expressions[:52], 1)
    expressions[52:] += 2e-4 * waves(template, 48, random)
    arrays = {
        "v_template": template,
        "shapedirs": np.moveaxis(np.concatenate([shapes, expressions]), 0, 2).copy(),
        "posedirs": np.moveaxis(5e-4 * waves(template, 36, random), 0, 2).copy(),
        "J_regressor": (regressor := joint_regressor(head, kept)),
        "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]], np.uint32),
        "weights": head.skinning_weights[kept].astype(np.float64),
        "f": faces,
        "J": regressor @ template,
    }
    names = {"left_eyeball": "eyeballs", "left_ear": "ears"}
    masks = {
        name: np.flatnonzero(head.regions[names.get(name, name)][kept])
        for name in ("face", "lips", "neck", "scalp", "left_eyeball", "left_ear")
    }
    keys = head.expression_names
    lids = [
        head.expression_basis[keys.index(k)][kept].astype(np.float64)
        for k in ("eyeBlinkLeft", "eyeBlinkRight")
    ]
    return Flame(arrays, head.uvs, head.uv_triangles[whole], masks, (lids[0], lids[1]), kept, order)


def joint_regressor(head: HeadModel, kept: np.ndarray) -> np.ndarray:
    """[5, V]: reads the built-in head's joints off vertices near them, whatever its identity; its
    expressions move none."""
    template = head.template[kept].astype(np.float64)
    rows = np.zeros((5, len(kept)))
    for joint, place in enumerate(head.joints(np.zeros(4))):
        near = cKDTree(template).query(place, k=900)[1]
        bases = np.concatenate(
            [head.template[None], head.shape_basis, head.expression_basis]
        ).astype(np.float64)
        moves = head.joint_regressor[joint] @ bases
        moves[1 + len(head.shape_basis) :] = 0
        columns = np.moveaxis(bases[:, kept[near]], 1, 2).reshape(-1, len(near))
        columns = np.concatenate([np.ones((1, len(near))), columns])
        wanted = np.concatenate([[1], moves.ravel()])
        start = np.full(len(near), 1 / len(near))
        rows[joint, near] = (
            start + np.linalg.lstsq(columns, wanted - columns @ start, rcond=None)[0]
        )
    return rows


def waves(points: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """Smooth directions [count, V, 3] of about unit size."""
    waves = random.normal(0, 25, (count, 3))
    phase = random.uniform(0, 6, (count, 1, 3))
    return np.sin((points @ waves.T).T[..., None] + phase)


# ---- FLAME's own files


class _Ch:
    """Stands for chumpy.ch.Ch while a pickle is written."""

    def __init__(self, x: np.ndarray) -> None:
        self.x = x
        self._dirty_vars = {"x"}
        self._itr = None


class Python2Pickler(pickle._Pickler):  # type: ignore[name-defined]
    """Writes byte strings and module names as Python 2 did."""

    dispatch: ClassVar = dict(pickle._Pickler.dispatch)  # type: ignore[attr-defined]

    def _text(self, text: str | bytes) -> None:
        data = text.encode("latin1") if isinstance(text, str) else text
        self.write(b"T" + struct.pack("<i", len(data)) + data)
        self.memoize(text)

    dispatch[str] = _text
    dispatch[bytes] = _text

    def save_global(self, obj, name=None):  # type: ignore[no-untyped-def]
        if obj is sparse.csc_matrix:
            self.write(b"cscipy.sparse.csc\ncsc_matrix\n")
            self.memoize(obj)
        else:
            super().save_global(obj, name)

    dispatch[type] = save_global


def write_model(path: Path, *, chumpy: bool = False, seed: int = 0, **changes) -> Path:
    """A model's pickle, protocol 2; chumpy: as the older files, with its objects and Python 2."""
    content: dict = {**flame(seed).arrays, "bs_type": "lrotmin", "bs_style": "lbs", **changes}
    content["J_regressor"] = sparse.csc_matrix(content["J_regressor"])
    if not chumpy:
        path.write_bytes(pickle.dumps(content, protocol=2))
        return path
    package, module = types.ModuleType("chumpy"), types.ModuleType("chumpy.ch")
    made = type("Ch", (_Ch,), {"__module__": "chumpy.ch"})
    module.Ch = made  # type: ignore[attr-defined]
    sys.modules |= {"chumpy": package, "chumpy.ch": module}
    try:
        for key in ("v_template", "shapedirs", "posedirs", "weights"):
            content[key] = made(content[key])
        content["vert_sym_idxs"] = np.arange(VERTICES)
        with path.open("wb") as stream:
            Python2Pickler(stream, protocol=2).dump(content)
    finally:
        del sys.modules["chumpy"], sys.modules["chumpy.ch"]
    return path


def write_companions(folder: Path, *, eyelids: bool = True) -> None:
    """head_template.obj with its faces in another order, the masks, the eyelids."""
    model = flame()
    faces = model.arrays["f"].astype(int)
    lines = ["v " + " ".join(f"{x:.6f}" for x in v) for v in model.arrays["v_template"]]
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in model.uvs]
    for number in np.random.default_rng(1).permutation(len(faces)):
        corners = np.roll(np.stack([faces[number], model.uv_faces[number]], 1), 1, 0) + 1
        lines.append("f " + " ".join(f"{v}/{t}" for v, t in corners))
    (folder / "head_template.obj").write_text("\n".join(lines) + "\n")
    (folder / "FLAME_masks.pkl").write_bytes(pickle.dumps(model.masks, protocol=2))
    if eyelids:
        for side, lid in zip("lr", model.eyelids, strict=True):
            np.save(folder / f"{side}_eyelid.npy", lid.astype(np.float32))


# ---- posing and projecting, as the tools do


def posed(
    shape: np.ndarray,
    expression: np.ndarray,
    turns: np.ndarray,
    translation: np.ndarray | None = None,
    offset: np.ndarray | None = None,
    scale: float = 1.0,
) -> np.ndarray:
    """FLAME's skinning in float64: shape [300], expression [100], turns [5, 3, 3] -> [V, 3].

    The joints are read off the head with its expression and offset, as FLAME's code does.
    """
    model = flame().arrays
    shaped = model["v_template"] + model["shapedirs"] @ np.concatenate([shape, expression])
    if offset is not None:
        shaped = shaped + offset
    shaped = shaped * scale
    joints = model["J_regressor"] @ shaped
    features = (turns[1:] - np.eye(3)).ravel()
    points = shaped + scale * (model["posedirs"] @ features)
    result = np.zeros_like(points)
    chain: list[np.ndarray] = []
    for joint, parent in enumerate((-1, 0, 1, 1, 1)):
        local = np.eye(4)
        local[:3, :3] = turns[joint]
        local[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
        chain.append(local if parent < 0 else chain[parent] @ local)
        motion = chain[joint].copy()
        motion[:3, 3] -= motion[:3, :3] @ joints[joint]
        moved = points @ motion[:3, :3].T + motion[:3, 3]
        result += model["weights"][:, joint, None] * moved
    return result if translation is None else result + translation


def project_cv(points: np.ndarray, world_to_camera: np.ndarray, lens) -> tuple:
    """OpenCV: x right, y down, z forward. lens: fx, fy, cx, cy -> pixels [V, 2], depth [V]."""
    local = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    fx, fy, cx, cy = lens
    z = local[:, 2]
    return np.stack([fx * local[:, 0] / z + cx, fy * local[:, 1] / z + cy], 1), z


def project_gl(points: np.ndarray, world_to_camera: np.ndarray, lens) -> tuple:
    """OpenGL: x right, y up, the camera looks down -z."""
    local = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    fx, fy, cx, cy = lens
    z = -local[:, 2]
    return np.stack([fx * local[:, 0] / z + cx, cy - fy * local[:, 1] / z], 1), z


def picture(pixels: np.ndarray, depth: np.ndarray, size=SIZE) -> np.ndarray:
    """The head at those pixels, coloured by place: uint8 [H, W, 4], straight alpha, soft edges."""
    model = flame()
    fine = 3
    points = np.concatenate([(pixels - 40) / 100 * depth[:, None], depth[:, None]], 1)
    lens = np.array([[100.0, 0, 40], [0, 100, 40], [0, 0, 1]])
    camera = Camera(size[1], size[0], lens, np.eye(4)).resized(size[1] * fine, size[0] * fine)
    faces = model.arrays["f"].astype(np.int32)
    _, triangle, weights = rasterise(points, faces, camera)
    colour = (_paint()[faces[triangle]] * weights[..., None]).sum(2)
    alpha = (triangle >= 0).astype(np.float64)
    cells = (size[0], fine, size[1], fine)
    covered = alpha.reshape(cells).mean((1, 3))
    summed = (colour * alpha[..., None]).reshape(*cells, 3).mean((1, 3))
    straight = summed / np.maximum(covered, 1e-6)[..., None]
    return np.round(np.concatenate([straight, covered[..., None]], 2) * 255).astype(np.uint8)


@lru_cache(maxsize=1)
def _paint() -> np.ndarray:
    model = flame()
    y = model.arrays["v_template"][:, 1]
    colour = np.tile([0.85, 0.63, 0.52], (VERTICES, 1)) * (0.9 + 0.1 * np.sin(y * 300))[:, None]
    colour[model.masks["lips"]] = [0.7, 0.25, 0.25]
    colour[model.masks["scalp"]] = [0.25, 0.15, 0.1]
    colour[model.masks["left_eyeball"]] = [0.95, 0.95, 0.95]
    return colour
