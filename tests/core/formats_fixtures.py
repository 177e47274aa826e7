"""Small folders in the formats of other programs, written from their descriptions alone."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
from flame_fixture import (
    VERTICES,
    flame,
    posed,
    project_cv,
    project_gl,
    waves,
    write_companions,
    write_model,
)
from formats_files import obj_text, opaque, ply_bytes, rewrite_json, save_frame, write_json
from scipy.spatial.transform import Rotation
from takes import FRAMES, INSTA_CODES, PARSING_CODES, Take, coded, looking_cv, sixes, take

from pav_blender.core.head.oracle import rotation_matrix
from pav_blender.core.images import write_gray, write_rgba

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

__all__ = [
    "FRAMES",
    "flame",
    "obj_text",
    "ply_bytes",
    "posed",
    "rewrite_json",
    "save_frame",
    "write_companions",
    "write_model",
]


def lid_offset(lids: np.ndarray) -> np.ndarray:
    left, right = flame().eyelids
    return lids[0] * left + lids[1] * right


CANONICAL_TURNS = np.stack(
    [rotation_matrix(np.array([np.radians(12) * (j == 2), 0, 0])) for j in range(5)]
)


# ---- the formats


def begun(path: Path, folders: tuple[str, ...], act: Take) -> tuple[Take, int]:
    """Makes the folders of a format; the take and how many frames it has."""
    for folder in folders:
        (path / folder).mkdir(parents=True)
    return act, len(act)


def metrical_frame(act: Take, frame: int) -> tuple[dict, np.ndarray, np.ndarray]:
    """A checkpoint's content, the posed mesh, world to camera."""
    turns = act.turns(frame, root=False, neck=False)
    world = act.filmed.resting[frame] if act.filmed else looking_cv(act.root[frame])
    vertices = posed(act.shape, act.expression[frame], turns) + lid_offset(act.lids[frame])
    fx, fy, cx, cy = act.lens
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
        "img_size": np.array(act.size),
        "frame_id": f"{frame:05d}",
        "global_step": 40,
    }
    return content, vertices, world


def write_metrical(
    path: Path,
    *,
    seed: int = 0,
    meshes: bool = True,
    matte: bool = False,
    frames: int = FRAMES,
    act: Take | None = None,
) -> Take:
    """matte: a folder of a user's own beside it, for the tracker writes none."""
    act, frames = begun(
        path,
        ("checkpoint", "input", "mesh", "depth", *(["matte"] if matte else [])),
        act or take(seed, frames),
    )
    for frame in range(frames):
        content, vertices, world = metrical_frame(act, frame)
        save_frame(path / f"checkpoint/{frame:05d}.frame", content)
        pixels, depth = project_cv(vertices, world, act.lens)
        act.truth[frame] = pixels
        rgba = act.picture(frame, pixels, depth)
        write_rgba(path / f"input/{frame:05d}.png", opaque(rgba, 70))
        if matte:
            write_gray(path / f"matte/{frame:05d}.png", rgba[..., 3])
        if meshes:
            (path / f"mesh/{frame:05d}.ply").write_bytes(ply_bytes(vertices))
    return act


def write_flashavatar(
    path: Path,
    *,
    seed: int = 0,
    frames: int = FRAMES,
    act: Take | None = None,
) -> Take:
    """Its pictures are numbered from 1, the checkpoints from 0."""
    act, frames = begun(path, ("checkpoint", "imgs", "alpha", "parsing"), act or take(seed, frames))
    act.truth = {}
    for frame in range(frames):
        content, vertices, world = metrical_frame(act, frame)
        save_frame(path / f"checkpoint/{frame:05d}.frame", content)
        pixels, depth = project_cv(vertices, world, act.lens)
        act.truth[frame] = pixels
        rgba = act.picture(frame, pixels, depth)
        write_rgba(path / f"imgs/{frame + 1:05d}.png", opaque(rgba, 90))
        write_gray(path / f"alpha/{frame + 1:05d}.png", rgba[..., 3])
        inside = (rgba[..., 3] > 127).astype(np.uint8) * 255
        mouth = np.zeros_like(inside)
        if act.filmed:
            inside = coded(act.labels(frame), dict.fromkeys(PARSING_CODES, 255) | {"cloth": 0})
            mouth = coded(act.labels(frame), {"mouth": 255})
        write_gray(path / f"parsing/{frame + 1:05d}_neckhead.png", inside)
        write_gray(path / f"parsing/{frame + 1:05d}_mouth.png", mouth)
    return act


def write_insta(
    path: Path,
    *,
    seed: int = 0,
    split: bool = True,
    frames: int = FRAMES,
    act: Take | None = None,
    canonical: bool = True,
) -> Take:
    act, frames = begun(
        path, ("images", "seg_mask", "meshes", "flame/exp"), act or take(seed, frames)
    )
    fx, fy, cx, cy = act.lens
    height, width = act.size
    top = {"w": float(width), "h": float(height), "cx": cx, "cy": cy, "fl_x": fx, "fl_y": fy}
    top |= {"camera_angle_x": 2 * np.arctan(width / fx / 2), "integer_depth_scale": 0.001}
    entries = []
    for frame in range(frames):
        _, vertices, world = metrical_frame(act, frame)
        pixels, depth = project_cv(vertices, world, act.lens)
        act.truth[frame] = pixels
        name = f"{frame:05d}"
        rgba = act.picture(frame, pixels, depth)
        write_rgba(path / f"images/{name}.png", rgba)
        mask = np.zeros((*act.size, 4), np.uint8)
        mask[..., 0] = np.where(rgba[..., 3] > 127, 250, 0)
        mask[: height // 3, :, 0] = np.where(rgba[: height // 3, :, 3] > 127, 80, 0)
        if act.filmed:
            mask[..., 0] = coded(act.labels(frame), INSTA_CODES)
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
        write_json(path / "transforms_train.json", top | {"frames": entries[: -act.held]})
        write_json(path / "transforms_test.json", top | {"frames": entries[-act.held :]})
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
    if act.filmed:
        static, moving, translation = 0 * static, 0 * moving, act.filmed.translation[frame]
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


def before_camera(act: Take, frame: int, world_to_camera: np.ndarray) -> tuple[dict, np.ndarray]:
    """A filmed frame's parameters for a camera that rests there: the head moves instead."""
    assert act.filmed
    move = np.linalg.inv(world_to_camera) @ act.filmed.world_to_camera[frame]
    model, shaping = flame().arrays, np.concatenate([act.shape, act.expression[frame]])
    root = model["J_regressor"][0] @ (model["v_template"] + model["shapedirs"] @ shaping)
    turned = dataclasses.replace(act, root=act.root.copy())
    turned.root[frame] = Rotation.from_matrix(
        move[:3, :3] @ rotation_matrix(act.root[frame])
    ).as_rotvec()
    shift = move[:3, :3] @ (root + act.filmed.translation[frame]) + move[:3, 3] - root
    turned.filmed = dataclasses.replace(act.filmed, translation=np.tile(shift, (len(act), 1)))
    return vhap_rows(turned, frame, dynamic=False)


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
    act: Take | None = None,
) -> Take:
    act, frames = begun(path, ("images", "fg_masks", "flame_param"), act or take(seed, frames))
    fx, fy, cx, cy = act.lens
    entries = []
    for frame in range(frames):
        content, vertices = vhap_rows(act, frame, dynamic)
        np.savez(path / f"flame_param/{frame:05d}.npz", **content)
        for camera in range(cameras):
            to_world = vhap_camera(camera)
            if act.filmed:
                to_world = np.linalg.inv(act.filmed.world_to_camera[frame]) @ OPENGL
            pixels, depth = project_gl(vertices, np.linalg.inv(to_world), act.lens)
            act.truth[1000 * camera + frame] = pixels
            name = f"{frame:05d}_{camera:02d}.png"
            rgba = act.picture(frame, pixels, depth)
            write_rgba(path / f"images/{name}", opaque(rgba, 255))
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
                    "h": act.size[0],
                    "w": act.size[1],
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
        seen = [e for e in entries if e["timestep_index"] < frames - act.held]
        held = [e for e in entries if e["timestep_index"] >= frames - act.held]
        train = [e for e in seen if cameras == 1 or e["camera_index"] != last]
        val = [e for e in seen if cameras > 1 and e["camera_index"] == last]
        for name, part in (("train", train), ("val", val), ("test", held)):
            write_json(path / f"transforms_{name}.json", top | {"frames": part})
    return act


def write_combined(
    parent: Path, name: str = "UNION", *, filmed: tuple[Take, Take] | None = None
) -> dict[str, Take]:
    """Two exports beside each other and GaussianAvatars' folder that only points to them."""
    first, second = filmed or (take(1), take(2))
    acts = {"EMO-1": write_vhap(parent / "EMO-1", split=False, act=first)}
    acts["SEN-2"] = write_vhap(parent / "SEN-2", split=False, act=second)
    (parent / name).mkdir()
    steps = 0
    for division, sequence in (("train", "EMO-1"), ("test", "SEN-2")):
        content = json.loads((parent / sequence / "transforms.json").read_text())
        for frame in content["frames"]:
            del frame["timestep_id"], frame["timestep_index_original"]
            frame["timestep_index"] += steps
            for key in ("file_path", "fg_mask_path", "flame_param_path"):
                frame[key] = f"../{sequence}/{frame[key]}"
        steps += len(acts[sequence])
        write_json(parent / name / f"transforms_{division}.json", content)
    write_json(parent / name / "transforms_val.json", {"frames": []})
    return acts


def write_vhap_track(
    path: Path,
    *,
    seed: int = 0,
    frames: int = FRAMES,
    act: Take | None = None,
) -> Take:
    """The tracker's own file: frames stacked, a focal length relative to the longer side."""
    act, frames = begun(path, ("images", "alpha_maps", "run"), act or take(seed, frames))
    to_world = np.eye(4)
    to_world[2, 3] = 1
    height, width = act.size
    focal = act.lens[0] / max(act.size)
    rows = []
    for frame in range(frames):
        if act.filmed:
            content, vertices = before_camera(act, frame, OPENGL @ np.linalg.inv(to_world))
        else:
            content, vertices = vhap_rows(act, frame, dynamic=False)
            vertices = vertices + np.array([0, 0, 0.15])
            content["translation"] = content["translation"] + np.float32([0, 0, 0.15])
        rows.append(content)
        centred = (act.lens[0], act.lens[0], width / 2, height / 2)
        pixels, depth = project_gl(vertices, np.linalg.inv(to_world), centred)
        act.truth[frame] = pixels
        rgba = act.picture(frame, pixels, depth)
        write_rgba(path / f"images/{frame:05d}.png", opaque(rgba, 200))
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
        "image_size": np.array(act.size),
    }
    np.savez(path / "run/tracked_flame_params_30.npz", **stacked)
    np.savez(path / "run/tracked_flame_params_3.npz", focal_length=np.zeros(1))
    return act


def write_imavatar(
    path: Path,
    *,
    seed: int = 0,
    pixels_512: bool = False,
    act: Take | None = None,
) -> Take:
    """FLAME times four, a camera that looks down -z, names without an ending, from 1."""
    act = act or take(seed)
    act.shape[100:] = 0
    act.expression[:, 50:] = 0
    side = act.size[1]
    for folder in ("image", "mask", "semantic"):
        (path / folder).mkdir(parents=True)
    world = np.eye(4)
    world[:3, 3] = [0.05, 0.1, -3.2]
    relative = np.array([-2.0, 2.02, 0.51, 0.47])
    if act.filmed:
        fx, fy, cx, cy = np.array(act.lens) / side
        relative = np.array([-fx, fy, cx, cy])
    entries = []
    for frame in range(len(act)):
        vertices = posed(act.shape, act.expression[frame], act.turns(frame), scale=4.0)
        if act.filmed:
            seen = act.filmed.world_to_camera[frame].copy()
            seen[:3, 3] += seen[:3, :3] @ act.filmed.translation[frame]
            seen[:3, 3] *= 4
            world = OPENGL @ seen
        local = vertices @ world[:3, :3].T + world[:3, 3]
        fx, fy, cx, cy = relative * side
        z = local[:, 2]  # negative before the camera, as fx is
        pixels = np.stack([cx + fx * local[:, 0] / z, cy + fy * local[:, 1] / z], 1)
        act.truth[frame + 1] = pixels
        name = str(frame + 1)
        rgba = act.picture(frame, pixels, -z / 4, (side, side))
        write_rgba(path / f"image/{name}.png", opaque(rgba, 120))
        write_gray(path / f"mask/{name}.png", rgba[..., 3])
        semantic = np.where(rgba[..., 3] > 127, 1, 0).astype(np.uint8)
        semantic[: side // 3] *= 17
        if act.filmed:
            semantic = coded(act.labels(frame), PARSING_CODES)
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
