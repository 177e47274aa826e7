"""Small folders in the formats of other programs, written from their descriptions alone.

The head is shaped like FLAME (5023 vertices, 5 joints, 300 + 100 directions) and cut from the
built-in one. Posing and projecting are written here again, each as its tool does it, so that what
the importers make of a folder is compared with pixels they had no part in.
"""

from __future__ import annotations

import json
import pickle
import struct
import sys
import types
import zipfile
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from pav_blender.core.head import builtin_head
from pav_blender.core.head.oracle import rotation_matrix
from pav_blender.core.images import write_gray, write_rgba
from pav_blender.core.rendering.cameras import Camera
from pav_blender.core.rendering.rasterise import rasterise

VERTICES = 5023
SIZE = (80, 96)  # height, width
FOCAL = 190.0
CENTRE = (50.25, 38.5)
FRAMES = 6


@dataclass
class Flame:
    """The model's arrays as FLAME's files name them, and what lies beside them."""

    arrays: dict[str, np.ndarray]
    uvs: np.ndarray
    uv_faces: np.ndarray
    masks: dict[str, np.ndarray]
    eyelids: tuple[np.ndarray, np.ndarray]


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
    joints = head.joints(np.zeros(4))
    regressor = np.zeros((5, VERTICES))
    for joint, place in enumerate(joints):
        near = cKDTree(template).query(place, k=40)[1]
        regressor[joint, near] = 1 / 40
    shapes = np.zeros((300, VERTICES, 3))
    shapes[:64] = head.shape_basis[:, kept]
    mix = random.normal(0, 0.2, (236, 64)) / np.arange(1, 237)[:, None] ** 0.5
    shapes[64:] = np.tensordot(mix, shapes[:64], 1) + 2e-4 * _waves(template, 236, random)
    expressions = np.zeros((100, VERTICES, 3))
    expressions[:52] = 0.3 * head.expression_basis[random.permutation(52)][:, kept]
    expressions[52:] = np.tensordot(random.normal(0, 0.2, (48, 52)), expressions[:52], 1)
    expressions[52:] += 2e-4 * _waves(template, 48, random)
    arrays = {
        "v_template": template,
        "shapedirs": np.moveaxis(np.concatenate([shapes, expressions]), 0, 2).copy(),
        "posedirs": np.moveaxis(5e-4 * _waves(template, 36, random), 0, 2).copy(),
        "J_regressor": regressor,
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
    return Flame(arrays, head.uvs, head.uv_triangles[whole], masks, (lids[0], lids[1]))


def _waves(points: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
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


# ---- a performance


@dataclass
class Take:
    """What happens in a clip; truth[frame number] = pixels [V, 2] as the tool projects them."""

    shape: np.ndarray
    expression: np.ndarray  # [F, 100]
    root: np.ndarray  # [F, 3]
    neck: np.ndarray
    jaw: np.ndarray
    eyes: np.ndarray  # [F, 2, 3]
    lids: np.ndarray  # [F, 2]
    truth: dict[int, np.ndarray] = field(default_factory=dict)

    def turns(self, frame: int, *, root: bool = True, neck: bool = True) -> np.ndarray:
        still = np.zeros(3)
        return np.stack(
            [
                rotation_matrix(self.root[frame] if root else still),
                rotation_matrix(self.neck[frame] if neck else still),
                rotation_matrix(self.jaw[frame]),
                rotation_matrix(self.eyes[frame, 0]),
                rotation_matrix(self.eyes[frame, 1]),
            ]
        )


def take(seed: int = 0, frames: int = FRAMES) -> Take:
    random = np.random.default_rng(seed)
    shape = np.zeros(300)
    shape[:80] = random.normal(0, 0.5, 80)
    expression = np.zeros((frames, 100))
    expression[:, :40] = random.normal(0, 0.5, (frames, 40))
    turn = np.linspace(-0.4, 0.4, frames)
    zero = np.zeros(frames)
    return Take(
        shape,
        expression,
        root=np.stack([0.2 * turn, turn, 0.3 * turn], 1),
        neck=np.stack([0.1 * np.cos(5 * turn), 0.2 * turn, zero], 1),
        jaw=np.stack([random.uniform(0, 0.3, frames), 0.03 * turn, zero], 1),
        eyes=random.uniform(-0.25, 0.25, (frames, 2, 3)),
        lids=random.uniform(0, 0.8, (frames, 2)),
    )


def sixes(matrix: np.ndarray) -> np.ndarray:
    """A rotation's first two rows: PyTorch3D's six numbers."""
    return matrix[:2].ravel()


def looking_cv(root: np.ndarray, distance: float = 0.75) -> np.ndarray:
    """World to camera, OpenCV: before a face at the origin's height, turned against the head."""
    centre = np.array([0.0, -0.02, 0.03])
    turn = np.diag([1.0, -1.0, -1.0]) @ rotation_matrix(root)
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    matrix[:3, 3] = -turn @ centre + [0.01, 0.0, distance]
    return matrix


def lens() -> tuple[float, float, float, float]:
    return (FOCAL, FOCAL * 1.01, *CENTRE)


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


def lid_offset(lids: np.ndarray) -> np.ndarray:
    left, right = flame().eyelids
    return lids[0] * left + lids[1] * right


CANONICAL_TURNS = np.stack(
    [rotation_matrix(np.array([np.radians(12) * (j == 2), 0, 0])) for j in range(5)]
)


# ---- the formats


def metrical_frame(act: Take, frame: int) -> tuple[dict, np.ndarray, np.ndarray]:
    """A checkpoint's content, the posed mesh, world to camera."""
    turns = act.turns(frame, root=False, neck=False)
    world = looking_cv(act.root[frame])
    vertices = posed(act.shape, act.expression[frame], turns) + lid_offset(act.lids[frame])
    fx, fy, cx, cy = lens()
    f4 = np.float32
    content = {
        "flame": {
            "exp": act.expression[frame][None].astype(f4),
            "shape": act.shape[None].astype(f4),
            "tex": np.zeros((1, 140), f4),
            "sh": np.zeros((1, 9, 3), f4),
            "eyes": np.concatenate([sixes(turns[3]), sixes(turns[4])])[None].astype(f4),
            "eyelids": act.lids[frame][None].astype(f4),
            "jaw": sixes(turns[2])[None].astype(f4),
        },
        "camera": {
            "R": sixes(world[:3, :3])[None].astype(f4),
            "t": world[None, :3, 3].astype(f4),
            "fl": np.array([[4.0]], f4),
            "pp": np.zeros((1, 2), f4),
        },
        "opencv": {
            "R": world[None, :3, :3].astype(f4),
            "t": world[None, :3, 3].astype(f4),
            "K": np.array([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]], f4),
        },
        "img_size": np.array(SIZE),
        "frame_id": f"{frame:05d}",
        "global_step": 40,
    }
    return content, vertices, world


def write_metrical(
    path: Path, *, seed: int = 0, meshes: bool = True, matte: bool = False, frames: int = FRAMES
) -> Take:
    """matte: a folder of a user's own beside it, for the tracker writes none."""
    act = take(seed, frames)
    for folder in ("checkpoint", "input", "mesh", "depth", *(["matte"] if matte else [])):
        (path / folder).mkdir(parents=True)
    for frame in range(frames):
        content, vertices, world = metrical_frame(act, frame)
        save_frame(path / f"checkpoint/{frame:05d}.frame", content)
        pixels, depth = project_cv(vertices, world, lens())
        act.truth[frame] = pixels
        rgba = picture(pixels, depth)
        write_rgba(path / f"input/{frame:05d}.png", _opaque(rgba, 70))
        if matte:
            write_gray(path / f"matte/{frame:05d}.png", rgba[..., 3])
        if meshes:
            (path / f"mesh/{frame:05d}.ply").write_bytes(ply_bytes(vertices))
    return act


def write_flashavatar(path: Path, *, seed: int = 0, frames: int = FRAMES) -> Take:
    """Its pictures are numbered from 1, the checkpoints from 0."""
    act = take(seed, frames)
    for folder in ("checkpoint", "imgs", "alpha", "parsing"):
        (path / folder).mkdir(parents=True)
    act.truth = {}
    for frame in range(frames):
        content, vertices, world = metrical_frame(act, frame)
        save_frame(path / f"checkpoint/{frame:05d}.frame", content)
        pixels, depth = project_cv(vertices, world, lens())
        act.truth[frame] = pixels
        rgba = picture(pixels, depth)
        write_rgba(path / f"imgs/{frame + 1:05d}.png", _opaque(rgba, 90))
        write_gray(path / f"alpha/{frame + 1:05d}.png", rgba[..., 3])
        inside = (rgba[..., 3] > 127).astype(np.uint8) * 255
        write_gray(path / f"parsing/{frame + 1:05d}_neckhead.png", inside)
        write_gray(path / f"parsing/{frame + 1:05d}_mouth.png", np.zeros_like(inside))
    return act


def write_insta(
    path: Path, *, seed: int = 0, split: bool = True, frames: int = FRAMES, canonical: bool = True
) -> Take:
    act = take(seed, frames)
    for folder in ("images", "seg_mask", "meshes", "flame/exp"):
        (path / folder).mkdir(parents=True)
    fx, fy, cx, cy = lens()
    height, width = SIZE
    top = {"w": float(width), "h": float(height), "cx": cx, "cy": cy, "fl_x": fx, "fl_y": fy}
    top |= {"camera_angle_x": 2 * np.arctan(width / fx / 2), "integer_depth_scale": 0.001}
    entries = []
    for frame in range(frames):
        _, vertices, world = metrical_frame(act, frame)
        pixels, depth = project_cv(vertices, world, lens())
        act.truth[frame] = pixels
        name = f"{frame:05d}"
        rgba = picture(pixels, depth)
        write_rgba(path / f"images/{name}.png", rgba)
        mask = np.zeros((*SIZE, 4), np.uint8)
        mask[..., 0] = np.where(rgba[..., 3] > 127, 250, 0)
        mask[: height // 3, :, 0] = np.where(rgba[: height // 3, :, 3] > 127, 80, 0)
        mask[..., 3] = 255
        write_rgba(path / f"seg_mask/{name}.png", mask)
        (path / f"meshes/{name}.obj").write_text(obj_text(vertices))
        coefficients = "\n".join(f"{x:.8f}" for x in act.expression[frame])
        (path / f"flame/exp/{name}.txt").write_text(coefficients + "\n")
        entries.append(
            {
                "transform_matrix": np.linalg.inv(world).tolist(),
                "file_path": f"images/{name}.png",
                "mesh_path": f"meshes/{name}.obj",
                "exp_path": f"flame/exp/{name}.txt",
                "depth_path": f"depth/{name}.png",
                "seg_mask_path": f"seg_mask/{name}.png",
            }
        )
    if canonical:
        rest = posed(act.shape, np.zeros(100), CANONICAL_TURNS)
        (path / "canonical.obj").write_text(obj_text(rest))
    # INSTA's own script writes frames as its workers finish them
    shuffled = [entries[i] for i in np.random.default_rng(3).permutation(frames)]
    write_json(path / "transforms.json", top | {"frames": shuffled})
    if split:
        write_json(path / "transforms_train.json", top | {"frames": entries[:-2]})
        write_json(path / "transforms_test.json", top | {"frames": entries[-2:]})
        write_json(path / "transforms_val.json", top | {"frames": entries[-1:]})
    return act


def vhap_offsets(frame: int) -> tuple[np.ndarray, np.ndarray]:
    """A static offset and one frame's, [5143, 3], metres: FLAME's vertices and the teeth's."""
    random = np.random.default_rng(11)
    points = flame().arrays["v_template"]
    static = np.zeros((VERTICES + 120, 3))
    static[:VERTICES] = 2e-3 * _waves(points, 1, random)[0]
    static[VERTICES:] = 0.5
    moving = np.zeros_like(static)
    moving[:VERTICES] = 5e-4 * np.sin(frame) * _waves(points, 1, random)[0]
    return static, moving


def vhap_rows(act: Take, frame: int, dynamic: bool) -> tuple[dict, np.ndarray]:
    static, moving = vhap_offsets(frame)
    translation = np.array([0.02, 0.01 * frame, -0.05])
    offset = static + moving if dynamic else static
    vertices = posed(
        act.shape, act.expression[frame], act.turns(frame), translation, offset[:VERTICES]
    )
    content = {
        "translation": translation[None],
        "rotation": act.root[frame][None],
        "neck_pose": act.neck[frame][None],
        "jaw_pose": act.jaw[frame][None],
        "eyes_pose": act.eyes[frame].reshape(1, 6),
        "shape": act.shape,
        "expr": act.expression[frame][None],
        "static_offset": static[None],
    }
    if dynamic:
        content["dynamic_offset"] = moving[None]
    return {k: v.astype(np.float32) for k, v in content.items()}, vertices


def vhap_camera(camera: int) -> np.ndarray:
    """Camera to world, OpenGL: a metre off, others to the side."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(np.array([0, 0.3 * camera, 0]))
    matrix[:3, 3] = matrix[:3, :3] @ [0, 0, 0.8] + [0.02, 0.0, 0.0]
    return matrix


def write_vhap(
    path: Path,
    *,
    seed: int = 0,
    cameras: int = 1,
    dynamic: bool = False,
    split: bool = True,
    frames: int = FRAMES,
) -> Take:
    act = take(seed, frames)
    for folder in ("images", "fg_masks", "flame_param"):
        (path / folder).mkdir(parents=True)
    fx, fy, cx, cy = lens()
    entries = []
    for frame in range(frames):
        content, vertices = vhap_rows(act, frame, dynamic)
        np.savez(path / f"flame_param/{frame:05d}.npz", **content)
        for camera in range(cameras):
            to_world = vhap_camera(camera)
            pixels, depth = project_gl(vertices, np.linalg.inv(to_world), lens())
            act.truth[1000 * camera + frame] = pixels
            name = f"{frame:05d}_{camera:02d}.png"
            rgba = picture(pixels, depth)
            write_rgba(path / f"images/{name}", _opaque(rgba, 255))
            write_gray(path / f"fg_masks/{name}", rgba[..., 3])
            entries.append(
                {
                    "timestep_index": frame,
                    "timestep_index_original": frame,
                    "timestep_id": f"frame_{frame:05d}",
                    "camera_index": camera,
                    "camera_id": str(camera),
                    "cx": cx,
                    "cy": cy,
                    "fl_x": fx,
                    "fl_y": fy,
                    "h": SIZE[0],
                    "w": SIZE[1],
                    "transform_matrix": to_world.tolist(),
                    "file_path": f"images/{name}",
                    "fg_mask_path": f"fg_masks/{name}",
                    "flame_param_path": f"flame_param/{frame:05d}.npz",
                }
            )
    np.savez(path / "canonical_flame_param.npz", shape=act.shape)
    top = {"timestep_indices": list(range(frames)), "camera_indices": list(range(cameras))}
    write_json(path / "transforms.json", top | {"frames": entries})
    if split:
        last = cameras - 1
        seen = [e for e in entries if e["timestep_index"] < frames - 2]
        held = [e for e in entries if e["timestep_index"] >= frames - 2]
        train = [e for e in seen if cameras == 1 or e["camera_index"] != last]
        val = [e for e in seen if cameras > 1 and e["camera_index"] == last]
        for name, part in (("train", train), ("val", val), ("test", held)):
            write_json(path / f"transforms_{name}.json", top | {"frames": part})
    return act


def write_combined(parent: Path, name: str = "UNION") -> dict[str, Take]:
    """Two exports beside each other and GaussianAvatars' folder that only points to them."""
    acts = {"EMO-1": write_vhap(parent / "EMO-1", seed=1, split=False)}
    acts["SEN-2"] = write_vhap(parent / "SEN-2", seed=2, split=False)
    (parent / name).mkdir()
    steps = 0
    for division, sequence in (("train", "EMO-1"), ("test", "SEN-2")):
        content = json.loads((parent / sequence / "transforms.json").read_text())
        for frame in content["frames"]:
            del frame["timestep_id"], frame["timestep_index_original"]
            frame["timestep_index"] += steps
            for key in ("file_path", "fg_mask_path", "flame_param_path"):
                frame[key] = f"../{sequence}/{frame[key]}"
        steps += FRAMES
        write_json(parent / name / f"transforms_{division}.json", content)
    write_json(parent / name / "transforms_val.json", {"frames": []})
    return acts


def write_vhap_track(path: Path, *, seed: int = 0, frames: int = FRAMES) -> Take:
    """The tracker's own file: frames stacked, a focal length relative to the longer side."""
    act = take(seed, frames)
    for folder in ("images", "alpha_maps", "run"):
        (path / folder).mkdir(parents=True)
    to_world = np.eye(4)
    to_world[2, 3] = 1
    height, width = SIZE
    focal = FOCAL / max(SIZE)
    rows = []
    for frame in range(frames):
        content, vertices = vhap_rows(act, frame, dynamic=False)
        vertices = vertices + np.array([0, 0, 0.15])
        content["translation"] = content["translation"] + np.float32([0, 0, 0.15])
        rows.append(content)
        centred = (FOCAL, FOCAL, width / 2, height / 2)
        pixels, depth = project_gl(vertices, np.linalg.inv(to_world), centred)
        act.truth[frame] = pixels
        rgba = picture(pixels, depth)
        write_rgba(path / f"images/{frame:05d}.png", _opaque(rgba, 200))
        write_gray(path / f"alpha_maps/{frame:05d}.png", rgba[..., 3])
    stacked = {
        key: np.concatenate([row[key] for row in rows])
        for key in ("translation", "rotation", "neck_pose", "jaw_pose", "eyes_pose", "expr")
    }
    stacked |= {
        "shape": rows[0]["shape"],
        "static_offset": rows[0]["static_offset"],
        "timestep_id": np.array([f"{frame:05d}" for frame in range(frames)]),
        "focal_length": np.array([focal], np.float32),
        "image_size": np.array(SIZE),
    }
    np.savez(path / "run/tracked_flame_params_30.npz", **stacked)
    np.savez(path / "run/tracked_flame_params_3.npz", focal_length=np.zeros(1))
    return act


def write_imavatar(path: Path, *, seed: int = 0, pixels_512: bool = False) -> Take:
    """FLAME times four, a camera that looks down -z, names without an ending, from 1."""
    act = take(seed)
    act.shape[100:] = 0
    act.expression[:, 50:] = 0
    side = SIZE[1]
    for folder in ("image", "mask", "semantic"):
        (path / folder).mkdir(parents=True)
    world = np.eye(4)
    world[:3, 3] = [0.05, 0.1, -3.2]
    relative = np.array([-2.0, 2.02, 0.51, 0.47])
    entries = []
    for frame in range(FRAMES):
        vertices = posed(act.shape, act.expression[frame], act.turns(frame), scale=4.0)
        local = vertices @ world[:3, :3].T + world[:3, 3]
        fx, fy, cx, cy = relative * side
        z = local[:, 2]  # negative before the camera, as fx is
        pixels = np.stack([cx + fx * local[:, 0] / z, cy + fy * local[:, 1] / z], 1)
        act.truth[frame + 1] = pixels
        name = str(frame + 1)
        rgba = picture(pixels, -z / 4, (side, side))
        write_rgba(path / f"image/{name}.png", _opaque(rgba, 120))
        write_gray(path / f"mask/{name}.png", rgba[..., 3])
        semantic = np.where(rgba[..., 3] > 127, 1, 0).astype(np.uint8)
        semantic[: side // 3] *= 17
        write_gray(path / f"semantic/{name}.png", semantic)
        pose = np.concatenate(
            [act.root[frame], act.neck[frame], act.jaw[frame], act.eyes[frame].ravel()]
        )
        entries.append(
            {
                "file_path": f"./image/{name}",
                "world_mat": world[:3].tolist(),
                "expression": act.expression[frame, :50].tolist(),
                "pose": pose.tolist(),
                "bbox": [-0.5, -0.5, 0.5, 0.5],
                "flame_keypoints": [],
            }
        )
    stored = relative * (512 if pixels_512 else 1)
    content = {
        "frames": entries,
        "shape_params": act.shape[:100].tolist(),
        "intrinsics": stored.tolist(),
    }
    write_json(path / "flame_params.json", content)
    return act


def write_nerface(path: Path) -> None:
    path.mkdir(parents=True)
    frame = {
        "file_path": "./train/f_0000",
        "transform_matrix": np.eye(4).tolist(),
        "expression": [0.0] * 76,
        "bbox": [0, 1, 0, 1],
    }
    content = {"camera_angle_x": 0.3, "intrinsics": [1, 1, 0.5, 0.5], "frames": [frame]}
    write_json(path / "transforms_train.json", content)


def _opaque(rgba: np.ndarray, background: int) -> np.ndarray:
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
