"""What only a whole Blender shows: its command line, its exit codes, its files."""

from __future__ import annotations

import shutil

import numpy as np
import small
from places import ROOT, WORK


def frames_in(folder):
    return sorted(path.name for path in (ROOT / folder).glob("*.png"))


def test_command_help_and_exit_codes(blender):
    assert "VERB" in blender("--command", "pav", "--help").stdout
    for arguments, code in (
        (["--help"], 0),
        (["scene", "--help"], 0),
        (["no-such-verb"], 2),
        (["info", "no-such-file.pav"], 2),
    ):
        done = blender("--command", "pav", *arguments)
        assert done.returncode == code, done.stdout + done.stderr


def test_animation_equals_the_core_without_blender(blender, files):
    from pav_blender.core import images
    from pav_blender.core.collection import read_collection
    from pav_blender.core.field.avatar import Avatar
    from pav_blender.core.rendering.cameras import Camera
    from pav_blender.core.rendering.render import RenderSettings, render

    done = blender("-b", files / "walk.blend", "-E", "PAV", "-o", f"{WORK}/frames/####", "-a")
    assert done.returncode == 0, done.stdout + done.stderr
    assert frames_in(WORK / "frames") == ["0003.png", "0004.png", "0005.png", "0006.png"]
    collection = read_collection(ROOT / files / "collection")
    clip = collection.clip("walk")
    for row in (0, 3):
        picture = render(
            Avatar.load(ROOT / files / "small.pav"),
            collection.posed(clip, np.array([row]))[0],
            Camera(clip.width, clip.height, clip.intrinsics[row], clip.camera_to_world[row]),
            "morning",
            RenderSettings.preset("final"),
            expression=clip.expression[row],
        )
        found = images.read_rgba(ROOT / WORK / "frames" / f"{row + 3:04d}.png") / 255
        weight = picture.rgba[..., 3:]
        assert weight.max() > 0.9
        np.testing.assert_allclose(found[..., 3:], weight, atol=1.01 / 255)
        np.testing.assert_allclose(
            found[..., :3] * weight, picture.rgba[..., :3] * weight, atol=1.01 / 255
        )


def test_the_scene_moves_together_with_its_avatar(blender, files):
    other = WORK / "moved"
    (ROOT / other).mkdir()
    for name in ("walk.blend", "small.pav"):
        shutil.copy(ROOT / files / name, ROOT / other / name)
    (ROOT / files / "small.pav").rename(ROOT / files / "away.pav")
    try:
        done = blender("-b", other / "walk.blend", "-E", "PAV", "-o", f"{other}/f####", "-f", "3")
    finally:
        (ROOT / files / "away.pav").rename(ROOT / files / "small.pav")
    assert done.returncode == 0, done.stdout + done.stderr
    assert frames_in(other) == ["f0003.png"]


def test_a_missing_avatar_ends_with_code_1_and_no_frame(blender, files):
    lonely = WORK / "lonely"
    (ROOT / lonely).mkdir()
    shutil.copy(ROOT / files / "walk.blend", ROOT / lonely / "walk.blend")
    done = blender("-b", lonely / "walk.blend", "-E", "PAV", "-o", f"{lonely}/f####", "-a")
    assert done.returncode == 1, done.stdout + done.stderr
    assert "small.pav: no such avatar file" in done.stdout + done.stderr
    assert frames_in(lonely) == []


def test_a_damaged_avatar_ends_with_code_1_and_no_frame(blender, files):
    broken = WORK / "broken"
    (ROOT / broken).mkdir()
    shutil.copy(ROOT / files / "walk.blend", ROOT / broken / "walk.blend")
    whole = (ROOT / files / "small.pav").read_bytes()
    (ROOT / broken / "small.pav").write_bytes(whole[: len(whole) // 2])
    done = blender("-b", broken / "walk.blend", "-E", "PAV", "-o", f"{broken}/f####", "-a")
    assert done.returncode == 1, done.stdout + done.stderr
    assert frames_in(broken) == []


NEST = """
import bpy
inner = bpy.context.scene
head = next(thing for thing in inner.objects if thing.pav.avatar)
head.pav.avatar = "//later.pav"
outer = bpy.data.scenes.new("outer")
outer.render.resolution_x, outer.render.resolution_y = 48, 40
outer.camera = inner.camera
outer.collection.objects.link(inner.camera)
outer.use_nodes = True
tree = outer.node_tree
tree.nodes.clear()
layers = tree.nodes.new("CompositorNodeRLayers")
layers.scene = inner
out = tree.nodes.new("CompositorNodeComposite")
tree.links.new(layers.outputs["Image"], out.inputs["Image"])
bpy.context.window.scene = outer
outer.frame_start = outer.frame_end = 3
outer.render.filepath = "//nested####"
bpy.ops.wm.save_as_mainfile(filepath="{path}", copy=True)
"""


def test_an_error_in_a_nested_scene_ends_with_code_1(blender, files):
    """Composited into another scene, the avatar's failure must not pass silently."""
    nested = WORK / "nested"
    (ROOT / nested).mkdir()
    script = ROOT / nested / "nest.py"
    script.write_text(NEST.format(path=nested / "nested.blend"))
    made = blender("-b", files / "walk.blend", "--python", nested / "nest.py")
    assert made.returncode == 0, made.stdout + made.stderr
    assert (ROOT / nested / "nested.blend").is_file(), made.stdout + made.stderr
    done = blender("-b", nested / "nested.blend", "-a")
    assert done.returncode == 1, done.stdout + done.stderr
    assert frames_in(nested) == []
    small.write_avatar(ROOT / files / "later.pav")  # the path follows the file that is saved
    done = blender("-b", nested / "nested.blend", "-a")
    assert done.returncode == 0, done.stdout + done.stderr
    assert frames_in(nested) == ["nested0003.png"]


PROBE = """
import bpy, sys
from bl_ext.user_default import pav_blender
import addon_utils
name = pav_blender.__name__
for _ in range(2):
    addon_utils.disable(name)
    assert not hasattr(bpy.types.Object, "pav")
    addon_utils.enable(name)
    assert hasattr(bpy.types.Object, "pav")
print("probe done", name)
"""


def test_disable_and_enable_again(blender):
    script = ROOT / WORK / "probe.py"
    script.write_text(PROBE)
    done = blender("-b", "--python-exit-code", "3", "--python", WORK / "probe.py")
    assert "probe done bl_ext.user_default.pav_blender" in done.stdout, done.stdout + done.stderr
    assert done.returncode == 0


def test_the_open_files_head_becomes_a_head_file_and_a_clip_alembic(blender, files):
    from pav_blender.core.head import builtin_head, read_head

    head = WORK / "walk_head.npz"
    done = blender("-b", files / "walk.blend", "--command", "pav", "head", "--out", head)
    assert done.returncode == 0, done.stdout + done.stderr
    found, built_in = read_head(ROOT / head), builtin_head()
    assert found.expression_names == built_in.expression_names
    assert found.joint_names == built_in.joint_names
    np.testing.assert_array_equal(found.triangles, built_in.triangles)
    # at rest, although the scene's first frame is not
    np.testing.assert_allclose(found.template, built_in.template, atol=1e-5)
    out = WORK / "walk.abc"
    done = blender(
        "--command", "pav", "export", f"{WORK / 'collection'}:walk", "--to", "abc", "--out", out
    )
    if "built without ABC" in done.stderr:  # Debian's is
        assert done.returncode == 2
        return
    assert done.returncode == 0, done.stdout + done.stderr
    assert (ROOT / out).stat().st_size > 100_000
