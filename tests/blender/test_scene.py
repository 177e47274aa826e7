"""`pav scene`, the operators, and writing sequences."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy")

import bpy
import small

from pav_blender.bridge import jobs, mesh, sequence
from pav_blender.bridge import scene as bridge_scene
from pav_blender.core import images
from pav_blender.core.collection import read_collection
from pav_blender.core.errors import InputError

ROOT = Path(__file__).resolve().parents[2]


def pav(*arguments, cwd):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, "-m", "pav_blender", *map(str, arguments)],
        env=environment,
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_verb_writes_a_blend_that_opens_with_everything_set(registered, files):
    out = files / "blends" / "walk.blend"
    out.parent.mkdir()
    arguments = ("--track", "collection:walk", "--out", "blends/walk.blend")
    done = pav("scene", "small.pav", *arguments, "--appearance", "evening", "--fps", 30, cwd=files)
    assert done.returncode == 0, done.stderr
    assert [path.name for path in out.parent.iterdir()] == ["walk.blend"]

    bpy.ops.wm.open_mainfile(filepath=str(out))
    scene = bpy.context.scene
    assert scene.render.engine == "PAV"
    assert (scene.frame_start, scene.frame_end, scene.render.fps) == (3, 6, 30)
    assert (scene.render.resolution_x, scene.render.resolution_y) == (48, 40)
    assert scene.view_settings.view_transform == "Standard"
    assert scene.render.film_transparent
    (head,) = [object_ for object_ in scene.objects if object_.pav.avatar]
    assert (head.pav.avatar, head.pav.appearance) == ("//../small.pav", "evening")
    (background,) = scene.camera.data.background_images
    assert background.image.filepath == "//../collection/clips/walk/images/000003.png"
    assert Path(bpy.path.abspath(background.image.filepath)).is_file()

    collection = read_collection(files / "collection")
    clip = collection.clip("walk")
    posed = collection.posed(clip, np.arange(len(clip)))
    for row, frame in enumerate(clip.frame_id):
        scene.frame_set(int(frame))
        evaluated = head.evaluated_get(bpy.context.evaluated_depsgraph_get())
        distance = np.linalg.norm(mesh.evaluated_vertices(evaluated) - posed[row], axis=1)
        assert distance.max() < 5e-5
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("gone.pav", "--track", "collection:walk", "--out", "a.blend"), "gone.pav"),
        (("small.pav", "--track", "collection:run", "--out", "a.blend"), "no clip named 'run'"),
        (("small.pav", "--track", "nowhere:walk", "--out", "a.blend"), "no such collection"),
        (("small.pav", "--track", "collection", "--out", "a.blend"), "COLLECTION:CLIP"),
        (("small.pav", "--track", "collection:walk", "--out", "a.png"), "ends in .blend"),
        (("small.pav", "--track", "collection:walk", "--out", "no/a.blend"), "no such folder"),
        (
            ("small.pav", "--track", "collection:walk", "--out", "a.blend", "--appearance", "x"),
            "morning, evening",
        ),
        (("small.pav", "--track", "collection:walk", "--out", "a.blend", "--fps", "0"), "above 0"),
    ],
)
def test_verb_refuses_wrong_input_in_one_line(scene, files, arguments, message, monkeypatch, capfd):
    from pav_blender.cli import main

    monkeypatch.chdir(files)
    before = sorted(files.rglob("*"))
    assert main(["scene", *arguments]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert message in line
    assert sorted(files.rglob("*")) == before


def test_operators_add_a_head_and_import_a_track(scene, files):
    bpy.ops.pav.add_head(filepath=str(files / "small.pav"))
    head = bpy.context.object
    assert head.pav.appearance == "morning"
    assert scene.render.engine == "PAV"
    scene.pav.collection = str(files / "collection")
    bpy.ops.pav.import_track()
    assert scene.camera is not None
    assert head.data.shape_keys.animation_data.action is not None
    bpy.ops.pav.import_track()  # again: replaces, adds no second camera
    assert len([object_ for object_ in scene.objects if object_.type == "CAMERA"]) == 1
    assert len(scene.camera.data.background_images) == 1


def _shown(scene, background, frame):
    """The red of what Blender shows of an image sequence at a frame, as the world's light."""
    world = scene.world = bpy.data.worlds.new("Shown")
    world.use_nodes = True
    tree = world.node_tree
    node = tree.nodes.new("ShaderNodeTexEnvironment")
    node.image = background.image
    for name in ("frame_start", "frame_offset", "frame_duration"):
        setattr(node.image_user, name, getattr(background.image_user, name))
    node.image_user.use_auto_refresh = True
    tree.links.new(node.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    render = scene.render
    kept = render.engine, render.film_transparent, render.filepath
    render.engine, render.film_transparent = "CYCLES", False
    scene.cycles.samples = 1
    with tempfile.TemporaryDirectory() as folder:
        render.filepath = str(Path(folder) / "shown.png")
        scene.frame_set(frame)
        bpy.ops.render.render(write_still=True)
        red = images.read_rgba(render.filepath)[0, 0, 0]
    render.engine, render.film_transparent, render.filepath = kept
    bpy.data.worlds.remove(world)
    return int(red)


def test_the_clips_pictures_stand_behind_the_head(scene, files):
    path = files / "pictures"
    small.write_collection(path)
    collection = read_collection(path)
    clip = collection.clip("walk")
    for row, frame in enumerate(clip.frame_id):  # told apart by their red
        picture = np.full((clip.height, clip.width, 4), 255, np.uint8)
        picture[..., 0] = 40 * frame
        images.write_rgba(collection.image_path(clip, row), picture)
    made = bridge_scene.build_scene(files / "small.pav", collection, "walk")
    camera = made.camera.data
    (background,) = camera.background_images
    assert camera.show_background_images
    assert background.image.source == "SEQUENCE"
    assert [round(_shown(scene, background, frame) / 40) for frame in (3, 6)] == [3, 6]
    mine = camera.background_images.new()
    before = len(bpy.data.images)
    bridge_scene.import_track(made.mesh, collection, "walk")
    assert len(camera.background_images) == 2  # the user's stays, ours is replaced
    assert mine.image is None
    assert len(bpy.data.images) == before


def test_the_clip_menu_lists_the_collection(scene, files):
    from pav_blender.bridge.properties import clip_names

    scene.pav.collection = str(files / "collection")
    assert clip_names(scene.pav, None, "WA") == ["walk"]
    assert clip_names(scene.pav, None, "x") == []
    scene.pav.collection = str(files / "nowhere")
    assert clip_names(scene.pav, None, "") == []


def test_importing_leaves_other_cameras_alone(scene, files):
    mine = bpy.data.objects.new("Mine", bpy.data.cameras.new("Mine"))
    scene.collection.objects.link(mine)
    scene.camera = mine
    made = bridge_scene.build_scene(
        files / "small.pav", read_collection(files / "collection"), "walk"
    )
    assert scene.camera == made.camera != mine
    assert mine.animation_data is None


def test_operators_say_what_is_wrong(scene, files):
    with pytest.raises(RuntimeError, match=r"gone\.pav: no such avatar file"):
        bpy.ops.pav.add_head(filepath=str(files / "gone.pav"))
    assert len(bpy.data.objects) == 0
    bpy.ops.pav.add_head(filepath=str(files / "small.pav"))
    with pytest.raises(RuntimeError, match="choose the collection"):
        bpy.ops.pav.import_track()
    scene.pav.collection = str(files)
    with pytest.raises(RuntimeError, match="not a collection"):
        bpy.ops.pav.import_track()
    scene.pav.collection, scene.pav.clip = str(files / "collection"), "run"
    with pytest.raises(RuntimeError, match="no clip named 'run'"):
        bpy.ops.pav.import_track()
    with pytest.raises(RuntimeError, match="avatar file to write"):
        bpy.ops.pav.train()


def test_a_track_of_another_head_is_refused(scene, files):
    bpy.ops.pav.add_head(filepath=str(files / "small.pav"))
    head = bpy.context.object
    head.data.shape_keys.key_blocks["jawOpen"].name = "mouth"
    with pytest.raises(InputError, match="no shape key 'jawOpen'"):
        bridge_scene.import_track(head, read_collection(files / "collection"), "walk")


def test_writing_frames_goes_on_where_it_stopped(scene, files, tmp_path):
    collection = read_collection(files / "collection")
    bridge_scene.build_scene(files / "small.pav", collection, "walk")
    scene.pav.quality = "PREVIEW"
    scene.render.filepath = str(tmp_path / "frames") + "/"
    bpy.ops.pav.write_sequence()
    names = [f"{frame:06d}.png" for frame in (3, 4, 5, 6)]
    assert sorted(path.name for path in (tmp_path / "frames").iterdir()) == names
    first, second, third, _ = (tmp_path / "frames" / name for name in names)
    scene.render.filepath = str(tmp_path / "f12.png")
    scene.frame_set(4)
    bpy.ops.render.render(write_still=True)
    difference = images.read_rgba(second).astype(int) - images.read_rgba(tmp_path / "f12.png")
    assert np.abs(difference).max() <= 1

    whole = second.read_bytes()
    first.write_bytes(b"")  # a placeholder left behind
    second.write_bytes(whole[: len(whole) // 2])  # and a torn file
    untouched = third.stat().st_mtime_ns
    scene.render.filepath = str(tmp_path / "frames") + "/"
    work = sequence.begin(scene, tmp_path / "frames")
    while not work.step():
        work.wait()
    assert (work.kept, work.error) == (2, "")
    assert second.read_bytes() == whole
    assert third.stat().st_mtime_ns == untouched
    assert images.read_rgba(first).shape == (40, 48, 4)


def test_writing_frames_stops_at_the_first_fault(scene, files, tmp_path):
    collection = read_collection(files / "collection")
    made = bridge_scene.build_scene(files / "small.pav", collection, "walk")
    made.mesh.pav.avatar = str(files / "gone.pav")
    scene.render.filepath = str(tmp_path) + "/"
    with pytest.raises(RuntimeError, match=r"frame 3: .*gone\.pav"):
        bpy.ops.pav.write_sequence()
    assert list(tmp_path.iterdir()) == []
    assert jobs.current().status.startswith("frame 3")


def test_opaque_frames_hold_the_world_as_f12_does(scene, files, tmp_path):
    collection = read_collection(files / "collection")
    bridge_scene.build_scene(files / "small.pav", collection, "walk")
    scene.pav.quality, scene.render.film_transparent = "PREVIEW", False
    scene.world = bpy.data.worlds.new("World")
    scene.world.color = 0.2, 0.5, 0.05
    scene.frame_end = scene.frame_start
    scene.render.filepath = str(tmp_path / "frames")
    bpy.ops.pav.write_sequence()
    scene.render.filepath = str(tmp_path / "f12.png")
    bpy.ops.render.render(write_still=True)
    frames = [tmp_path / "frames" / "000003.png", tmp_path / "f12.png"]
    written, rendered = (images.read_rgba(path).astype(int) for path in frames)
    assert np.abs(written - rendered).max() <= 1


def test_a_head_that_is_remembered_comes_with_its_persons_offset(
    registered, files, tmp_path, monkeypatch
):
    """As of an imported FLAME track: the avatar has a fingerprint and an offset, no model."""
    from pav_blender.core.field.avatar import Avatar
    from pav_blender.core.head import builtin_head, read_head, remember_head, write_head

    monkeypatch.setenv("PAV_CONFIG", str(tmp_path / "config"))
    write_head(tmp_path / "other.npz", builtin_head(), step=2e-6)
    avatar = Avatar.load(files / "small.pav")
    head = read_head(tmp_path / "other.npz")
    avatar.head_name, avatar.head_fingerprint = "other", head.fingerprint
    avatar.head_offset = np.full((head.vertex_count, 3), 0.01, np.float32)
    avatar.save(tmp_path / "other.pav")
    with pytest.raises(InputError, match=r"other\.pav: the head 'other'.*pav import --head"):
        bridge_scene.build_head(tmp_path / "other.pav")
    remember_head(tmp_path / "other.npz")
    rig = bridge_scene.build_head(tmp_path / "other.pav")
    found = mesh.vertices(rig.mesh.data)
    expected = head.shaped(avatar.betas) + avatar.head_offset
    assert np.abs(found - expected).max() < 1e-6
