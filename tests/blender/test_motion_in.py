"""Tracks of others and recordings onto the rig."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("bpy")

import bpy
import small

from pav_blender.bridge import mesh
from pav_blender.bridge import scene as bridge_scene
from pav_blender.core.collection import identity_distance, read_collection, relative_clip
from pav_blender.core.errors import InputError
from pav_blender.core.head import builtin_head
from pav_blender.core.head.livelink import ARKIT_NAMES


@pytest.fixture(scope="module")
def files(registered, tmp_path_factory):
    """small.pav, its own collection, and `other`, the same clip of another person."""
    folder = tmp_path_factory.mktemp("motion")
    small.write_avatar(folder / "small.pav")
    for name in ("collection", "other"):
        small.write_collection(folder / name)
    path = folder / "other" / "collection.json"
    meta = json.loads(path.read_text(encoding="utf-8"))
    betas = np.random.default_rng(3).normal(0, 1, len(meta["head"]["betas"]))
    meta["head"]["betas"] = betas.tolist()
    path.write_text(json.dumps(meta), encoding="utf-8")
    return folder


def add_head(scene, files, collection):
    bpy.ops.pav.add_head(filepath=str(files / "small.pav"))
    scene.pav.collection = str(files / collection)
    return bpy.context.object


def evaluated(object_, frame):
    bpy.context.scene.frame_set(frame)
    found = object_.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return mesh.evaluated_vertices(found)


def test_faces_are_measured_after_a_rigid_move():
    head = builtin_head()
    rng = np.random.default_rng(0)
    first = head.shaped(rng.normal(0, 1, len(head.shape_basis)))
    from scipy.spatial.transform import Rotation

    moved = Rotation.from_rotvec([0.3, -0.2, 0.5]).apply(first) + np.array([0.1, 0.2, -0.3])
    assert identity_distance(head, first, moved) < 1e-6
    second = head.shaped(rng.normal(0, 1, len(head.shape_basis)))
    assert 0.002 < identity_distance(head, first, second) < 0.01


def test_another_persons_track_asks_first(scene, files):
    head = add_head(scene, files, "other")
    with pytest.raises(RuntimeError, match=r"tracked on another person, whose face is \d\.\d mm"):
        bpy.ops.pav.import_track()
    assert head.data.shape_keys.animation_data is None
    assert scene.camera is None
    bpy.ops.pav.import_track(confirm_identity=True)
    assert head.data.shape_keys.animation_data.action is not None
    # asked again the next time: the answer is not kept
    with pytest.raises(RuntimeError, match="another person"):
        bpy.ops.pav.import_track()


def test_a_relative_track_moves_from_the_rest(scene, files):
    """Where the other person is at their neutral, the avatar is at rest; elsewhere it is moved by
    what differs."""
    head = add_head(scene, files, "other")
    bpy.ops.pav.import_track(confirm_identity=True, relative=True, neutral=4)
    avatar_rest = builtin_head().shaped(np.zeros(1))
    clip = read_collection(files / "other").clip("walk")
    root_turn = clip.pose[1, 0]
    assert not root_turn.any()
    np.testing.assert_allclose(evaluated(head, 4), avatar_rest, atol=2e-6)
    assert np.abs(evaluated(head, 6) - avatar_rest).max() > 0.01
    # the camera sees the neutral head from where it saw the other person's
    camera = np.array(scene.camera.matrix_world)[:3, 3]
    first = clip.camera_to_world[1, :3, 3] - clip.translation[1]
    np.testing.assert_allclose(camera, [first[0], -first[2], first[1]], atol=1e-6)
    bpy.ops.pav.import_track(confirm_identity=True, relative=True)
    values = [
        head.data.shape_keys.key_blocks["jawOpen"].value
        for frame in (3, 4, 5, 6)
        if scene.frame_set(frame) is None
    ]
    assert np.median(values) == pytest.approx(0, abs=1e-6)
    with pytest.raises(RuntimeError, match=r"no frame 99 to take for the neutral; it has 3 to 6"):
        bpy.ops.pav.import_track(confirm_identity=True, relative=True, neutral=99)


def test_relative_turns_undo_the_neutrals(files):
    from scipy.spatial.transform import Rotation

    clip = read_collection(files / "collection").clip("walk")
    rng = np.random.default_rng(1)
    pose = rng.normal(0, 0.4, clip.pose.shape).astype(np.float32)
    relative = relative_clip(replace(clip, pose=pose), 5)
    np.testing.assert_allclose(relative.pose[2, 1:], 0, atol=1e-6)
    np.testing.assert_array_equal(relative.pose[:, 0], pose[:, 0])
    for joint in range(1, pose.shape[1]):
        again = Rotation.from_rotvec(pose[2, joint]) * Rotation.from_rotvec(relative.pose[0, joint])
        expected = Rotation.from_rotvec(pose[0, joint])
        assert (again * expected.inv()).magnitude() < 1e-5


def test_the_command_line_asks_too(scene, files, monkeypatch, capfd, tmp_path):
    from pav_blender.cli import main

    monkeypatch.chdir(files)
    arguments = ["scene", "small.pav", "--track", "other:walk", "--out", str(tmp_path / "a.blend")]
    assert main(arguments) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert "another person" in line
    assert "--other-identity" in line
    assert list(tmp_path.iterdir()) == []
    assert main([*arguments, "--other-identity", "--relative"]) == 0
    assert (tmp_path / "a.blend").is_file()
    out = str(tmp_path / "####.png")
    picture = ["render", "small.pav", "--track", "other:walk", "--appearance", "morning"]
    assert main([*picture, "--out", out, "--frames", "3"]) == 2
    assert "another person" in capfd.readouterr().err
    assert main([*picture, "--out", out, "--frames", "3", "--relative", "--other-identity"]) == 0
    assert (tmp_path / "0003.png").is_file()


def write_take(path, jaw):
    angles = [p + a for p in ("Head", "LeftEye", "RightEye") for a in ("Yaw", "Pitch", "Roll")]
    columns = [name[0].upper() + name[1:] for name in ARKIT_NAMES] + angles
    lines = [",".join(["Timecode", "BlendShapeCount", *columns])]
    for number, value in enumerate(jaw):
        table = dict.fromkeys(columns, 0.0) | {"JawOpen": value, "HeadYaw": -value}
        second, frame = divmod(2 * number, 60)
        code = f"10:00:{second:02d}:{frame:02d}.0"
        lines.append(",".join([code, "61", *(f"{v:.6f}" for v in table.values())]))
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def test_a_livelink_recording_becomes_keyframes(scene, files, tmp_path):
    head = add_head(scene, files, "collection")
    bpy.ops.pav.import_track()
    path = write_take(tmp_path / "take.csv", np.linspace(0, 0.9, 91))  # three seconds
    scene.render.fps = 24
    bpy.ops.pav.import_livelink(filepath=str(path), start=10)
    assert (scene.frame_start, scene.frame_end) == (10, 10 + 72)
    key = head.data.shape_keys.key_blocks["jawOpen"]
    neck = head.parent.pose.bones["neck"]
    for frame, expected in ((10, 0.0), (34, 0.3), (46, 0.45), (82, 0.9)):
        scene.frame_set(frame)
        assert key.value == pytest.approx(expected, abs=1e-4)
        turn = neck.rotation_quaternion.to_axis_angle()
        assert turn[1] * np.sign(turn[0].y or 1) == pytest.approx(expected, abs=1e-4)
    assert head.parent.pose.bones["root"].location.length == 0  # the old track is gone
    bpy.ops.pav.import_livelink(filepath=str(path), turn_head=False)
    scene.frame_set(40)
    assert neck.rotation_quaternion.angle == pytest.approx(0, abs=1e-6)


def test_livelink_says_what_is_wrong(scene, files, tmp_path):
    head = add_head(scene, files, "collection")
    (tmp_path / "no.csv").write_text("a,b\n")
    with pytest.raises(RuntimeError, match=r"no\.csv: not a recording of Live Link Face"):
        bpy.ops.pav.import_livelink(filepath=str(tmp_path / "no.csv"))
    path = write_take(tmp_path / "take.csv", [0.1, 0.2])
    for name in ARKIT_NAMES:
        head.data.shape_keys.key_blocks[name].name = f"other {name}"
    with pytest.raises(RuntimeError, match="none of ARKit's expressions"):
        bpy.ops.pav.import_livelink(filepath=str(path))
    assert head.data.shape_keys.animation_data is None


def test_a_track_of_another_head_model_is_refused(scene, files, tmp_path, monkeypatch):
    from pav_blender.core.field.avatar import Avatar

    head = add_head(scene, files, "collection")
    avatar = Avatar.load(files / "small.pav")
    avatar.head_fingerprint = "0" * 64
    avatar.save(tmp_path / "foreign.pav")
    head.pav.avatar = str(tmp_path / "foreign.pav")
    with pytest.raises(RuntimeError, match="another mesh"):
        bpy.ops.pav.import_track(confirm_identity=False)
    with pytest.raises(InputError, match="another mesh"):
        bridge_scene.check_person(head, read_collection(files / "collection"))
