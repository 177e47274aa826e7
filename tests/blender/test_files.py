"""The life of files: undo, save, copy, link, pack, and nothing left behind."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy")

import bpy
import small
from open_files import add, contents, evaluated, heads, picture, reopen, save

from pav_blender.bridge import avatars, links, packing, shot
from pav_blender.bridge.pose_keys import POSE_KEYS, pose_keys
from pav_blender.bridge.rig import find_armature
from pav_blender.core.errors import InputError

ROOT = Path(__file__).resolve().parents[2]


# ---- undo, save, copy, rename, delete


def test_undo_and_redo(scene, files):
    empty = contents()
    bpy.ops.ed.undo_push(message="start")
    add(scene, files)
    bpy.ops.ed.undo_push(message="added")
    added = contents()
    bpy.context.scene.pav.collection = str(files / "collection")
    bpy.ops.pav.import_track()
    bpy.ops.ed.undo_push(message="tracked")
    tracked, before = contents(), picture(bpy.context.scene)
    assert added != empty
    assert tracked != added
    for wanted in (added, empty):
        bpy.ops.ed.undo()
        assert contents() == wanted
    for wanted in (added, tracked):
        bpy.ops.ed.redo()
        assert contents() == wanted
    np.testing.assert_array_equal(picture(bpy.context.scene), before)


def test_save_and_load_lose_nothing(scene, files, here):
    save(here / "scene.blend")
    head = add(scene, here, files)
    head.pav.appearance = "evening"
    keys = head.data.shape_keys.key_blocks
    keys["neck_turn"].value = 0.5
    keys["neck_turn"].keyframe_insert("value", frame=4)
    before, counted = picture(scene), contents()
    assert head.pav.avatar == "//small.pav"
    save(here / "scene.blend")
    scene = reopen(here / "scene.blend")
    (head,) = heads()
    assert (head.pav.avatar, head.pav.appearance) == ("//small.pav", "evening")
    assert contents() == counted
    assert pose_keys(head, find_armature(head)) == list(POSE_KEYS)
    np.testing.assert_array_equal(picture(scene), before)


def test_a_duplicate_is_a_head_of_its_own(scene, files):
    head = add(scene, files, files)
    armature = head.parent
    for object_ in (head, armature):
        object_.select_set(True)
    alone = picture(scene)
    bpy.ops.object.duplicate()
    copy = next(object_ for object_ in heads() if object_ != head)
    assert copy.parent == find_armature(copy) != armature
    assert copy.data.shape_keys != head.data.shape_keys
    assert copy.pav.avatar == head.pav.avatar
    # its pose keys turn its own bones, and the other's stay
    rest = evaluated(head)
    scene.frame_set(4)
    rest = evaluated(head)
    copy.data.shape_keys.key_blocks["neck_turn"].value = 1.0
    np.testing.assert_array_equal(evaluated(head), rest)
    assert np.abs(evaluated(copy) - rest).max() > 0.02
    copy.parent.location.x = 0.1
    copy.pav.appearance = "evening"
    assert len(shot.find_actors(bpy.context.evaluated_depsgraph_get())) == 2
    assert np.abs(picture(scene) - alone).max() > 0.05
    for object_ in (copy, copy.parent):
        bpy.data.objects.remove(object_)
    np.testing.assert_allclose(picture(scene), alone, atol=1e-6)


def test_renaming_everything_changes_nothing(scene, files):
    head = add(scene, files, files)
    before = picture(scene)
    head.name, head.data.name, head.parent.name = "Ann", "Ann's mesh", "Ann's bones"
    head.data.shape_keys.name, scene.camera.name = "Ann's keys", "Ann's camera"
    scene.name = "Act 1"
    np.testing.assert_array_equal(picture(scene), before)
    head.data.shape_keys.key_blocks["jaw_open"].value = 1.0
    assert np.abs(picture(scene) - before).max() > 0.01
    bpy.ops.pav.import_track()
    assert len([o for o in scene.objects if o.type == "CAMERA"]) == 1


def test_deleting_leaves_nothing_behind(scene, files):
    empty = contents()
    head = add(scene, files, files)
    camera = scene.camera
    for object_ in (head.parent, head, camera):
        bpy.data.objects.remove(object_)
    bpy.data.orphans_purge(do_recursive=True)
    assert contents() == empty
    with pytest.raises(InputError, match="no camera"):
        shot.read_shot(None, bpy.context.evaluated_depsgraph_get())
    assert not bpy.ops.pav.import_track.poll()
    # a head whose armature was deleted is still a head, at rest
    head = add(scene, files)
    bpy.data.objects.remove(head.parent)
    assert pose_keys(head, find_armature(head)) == []
    bpy.context.view_layer.update()
    with pytest.raises(RuntimeError, match="has no armature"):
        bpy.ops.pav.import_track()


# ---- paths


def test_paths_follow_the_file_that_is_saved(scene, files, here):
    head = add(scene, here)
    assert Path(head.pav.avatar) == here / "small.pav"
    save(here / "scene.blend")
    assert head.pav.avatar == "//small.pav"  # beside it, so relative
    (here / "below").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(here / "below" / "copy.blend"), copy=True)
    assert head.pav.avatar == "//small.pav"  # the open file is not the copy
    save(here / "below" / "scene.blend")
    assert head.pav.avatar == "//../small.pav"
    for name in ("copy", "scene"):
        reopen(here / "below" / f"{name}.blend")
        (head,) = heads()
        assert head.pav.avatar == "//../small.pav"
        assert avatars.path_of(head.pav).samefile(here / "small.pav")


def test_paths_outside_stay_absolute(scene, files, here):
    head = add(scene, files)
    save(here / "scene.blend")
    assert Path(head.pav.avatar) == files / "small.pav"


def test_both_moved_together_still_fit(scene, files, here):
    save(here / "scene.blend")
    add(scene, here, files)
    before = picture(scene)
    save(here / "scene.blend")
    moved = here / "elsewhere"
    moved.mkdir()
    for name in ("scene.blend", "small.pav"):
        shutil.move(here / name, moved / name)
    np.testing.assert_array_equal(picture(reopen(moved / "scene.blend")), before)


def test_missing_avatars_are_found_again(scene, files, here):
    save(here / "scene.blend")
    add(scene, here, files)
    bpy.context.object.pav.appearance = "evening"
    before = picture(scene)
    save(here / "scene.blend")
    new = here / "archive" / "2019"
    new.mkdir(parents=True)
    shutil.move(here / "small.pav", new / "small.pav")
    (here / "archive" / "small.pav").write_text("no avatar")
    scene = reopen(here / "scene.blend")
    with pytest.raises(InputError, match=r"small\.pav: no such avatar file"):
        picture(scene)
    with pytest.raises(RuntimeError, match="no such folder"):
        bpy.ops.pav.relink_avatars(directory=str(here / "nowhere"))
    mended, missing = links.relink(files / "collection")
    assert (mended, missing) == ([], ["small: //small.pav"])
    bpy.ops.pav.relink_avatars(directory=str(here / "archive"))
    (head,) = heads()
    assert head.pav.avatar == "//archive/2019/small.pav"
    assert head.pav.appearance == "evening"
    np.testing.assert_array_equal(picture(scene), before)
    # under another name too, where only one fits; an avatar without the appearance does not
    shutil.move(new / "small.pav", new / "renamed.pav")
    small.write_avatar(new / "stranger.pav", appearances=["noon"])
    assert links.relink(here / "archive") == ([head.name], [])
    assert head.pav.avatar == "//archive/2019/renamed.pav"


# ---- packing


def test_a_packed_avatar_needs_no_file(scene, files, here):
    save(here / "scene.blend")
    head = add(scene, here, files)
    before = picture(scene)
    bpy.ops.pav.pack_avatar()
    assert not bpy.ops.pav.pack_avatar.poll()
    save(here / "scene.blend")
    (here / "small.pav").unlink()
    moved = here / "moved"
    moved.mkdir()
    shutil.move(here / "scene.blend", moved / "scene.blend")
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    shutil.rmtree(Path(bpy.app.tempdir) / "pav", ignore_errors=True)
    scene = reopen(moved / "scene.blend")
    (head,) = heads()
    assert head.pav.appearance == "morning"  # the menu reads the packed file
    np.testing.assert_array_equal(picture(scene), before)
    # undo steps and copies share the one text
    for object_ in (head, head.parent):
        object_.select_set(True)
    bpy.ops.object.duplicate()
    assert len(bpy.data.texts) == 1
    assert bpy.data.texts[0].users == 2
    bpy.ops.pav.unpack_avatar()
    assert (moved / "small.pav").read_bytes() == (files / "small.pav").read_bytes()
    assert {object_.pav.avatar for object_ in heads()} == {"//small.pav"}
    assert len(bpy.data.texts) == 0
    assert len(shot.find_actors(bpy.context.evaluated_depsgraph_get())) == 2


def test_packing_says_what_is_wrong(scene, files, here):
    head = add(scene, here)
    bpy.ops.pav.pack_avatar()
    with pytest.raises(RuntimeError, match=r"save the \.blend first"):
        bpy.ops.pav.unpack_avatar()
    save(here / "scene.blend")
    (here / "small.pav").write_text("another file")
    with pytest.raises(RuntimeError, match="another file is there already"):
        bpy.ops.pav.unpack_avatar()
    assert (here / "small.pav").read_text() == "another file"
    assert head.pav.pack.text is not None
    text = head.pav.pack.text
    shutil.rmtree(Path(bpy.app.tempdir) / "pav", ignore_errors=True)
    text["pav_bytes"] = text["pav_bytes"][:-1]
    with pytest.raises(InputError, match="is damaged"):
        avatars.path_of(head.pav)
    text["pav_sha256"] = "../../elsewhere"
    with pytest.raises(InputError, match="holds no packed avatar"):
        avatars.path_of(head.pav)
    head.pav.pack.text = None
    head.pav.avatar = str(here / "small.pav")
    with pytest.raises(RuntimeError, match=r"small\.pav"):
        bpy.ops.pav.pack_avatar()
    assert len([t for t in bpy.data.texts if "pav_bytes" in t]) == 1


def test_a_packed_name_cannot_leave_its_folder(scene, files, here):
    head = add(scene, here)
    text = packing.pack(head, here / "small.pav")
    text["pav_name"] = "../../../evil name.pav"
    path = packing.unpacked(text)
    assert path.name == "evil_name.pav"
    assert path.is_relative_to(Path(bpy.app.tempdir) / "pav")


# ---- the add-on comes and goes


def test_factory_settings_leave_nothing(scene, files):
    add(scene, files, files)
    picture(scene)
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    assert heads() == []
    scene = bpy.context.scene
    assert not bpy.ops.pav.import_track.poll()
    with pytest.raises(InputError, match="shows no avatar"):
        shot.read_shot(None, bpy.context.evaluated_depsgraph_get())


COMES_AND_GOES = """
import os, sys
import bpy, numpy as np
sys.path.insert(0, sys.argv[1])
import small
from pathlib import Path
folder = Path(sys.argv[2])
def ours():
    lists = [getattr(bpy.app.handlers, name) for name in dir(bpy.app.handlers)]
    return [h for one in lists if isinstance(one, list) for h in one
            if getattr(h, "__module__", "").startswith("pav_blender")]
def stop(kind, value, trace):
    sys.__excepthook__(kind, value, trace)
    os._exit(1)  # a wheel with a class registered never ends
sys.excepthook = stop
import pav_blender
pav_blender.register()
assert ours()
small.write_avatar(folder / "small.pav")
bpy.ops.pav.add_head(filepath=str(folder / "small.pav"))
bpy.context.object.pav.appearance = "evening"
bpy.ops.pav.pack_avatar()
bpy.ops.wm.save_as_mainfile(filepath=str(folder / "a.blend"))
pav_blender.unregister()
assert not ours(), ours()
left = [name for name in dir(bpy.types) if "PAV_" in name]
assert not left and not hasattr(bpy.types.Object, "pav"), left
# a file saved without the add-on keeps what the add-on stored
bpy.ops.wm.open_mainfile(filepath=str(folder / "a.blend"))
bpy.ops.wm.save_as_mainfile(filepath=str(folder / "b.blend"))
pav_blender.register()
bpy.ops.wm.open_mainfile(filepath=str(folder / "b.blend"))
(head,) = [o for o in bpy.data.objects if o.pav.avatar]
assert head.pav.appearance == "evening"
assert head.pav.pack.text is not None
bpy.ops.wm.read_factory_settings()
pav_blender.unregister()
pav_blender.register()
assert hasattr(bpy.ops.pav, "add_head") and bpy.ops.pav.add_head.poll()
bpy.ops.script.reload()
pav_blender.unregister()
assert not ours(), ours()
print("came and went", flush=True)
os._exit(0)  # Blender's own classes, registered again by the reload, would keep the wheel waiting
"""


def test_the_add_on_comes_and_goes(tmp_path):
    environment = {
        **os.environ,
        "BLENDER_USER_RESOURCES": str(tmp_path / "resources"),
        "PYTHONPATH": str(ROOT),
    }
    (tmp_path / "resources").mkdir()
    done = subprocess.run(
        [sys.executable, "-c", COMES_AND_GOES, str(Path(__file__).parent), str(tmp_path)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert "came and went" in done.stdout, done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    assert done.returncode == 0
