"""Small folders in the formats of other programs, written from their descriptions alone."""

from __future__ import annotations

import json
import pickle
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from flame_fixture import (
    SIZE,
    VERTICES,
    flame,
    picture,
    posed,
    project_cv,
    project_gl,
    waves,
    write_companions,
    write_model,
)

from pav_blender.core.head.oracle import rotation_matrix
from pav_blender.core.images import write_gray, write_rgba

FOCAL = 190.0
CENTRE = (50.25, 38.5)
FRAMES = 6

__all__ = ["flame", "posed", "write_companions", "write_model"]


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
    static[:VERTICES] = 2e-3 * waves(points, 1, random)[0]
    static[VERTICES:] = 0.5
    moving = np.zeros_like(static)
    moving[:VERTICES] = 5e-4 * np.sin(frame) * waves(points, 1, random)[0]
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
