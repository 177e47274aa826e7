"""Layers of appearances over a head's own: what they say, what they render, how they are kept."""

from __future__ import annotations

import numpy as np
import pytest
import small

bpy = pytest.importorskip("bpy")

from pav_blender.bridge import looks, thumbnails  # noqa: E402
from pav_blender.bridge.animation import render_blend  # noqa: E402
from pav_blender.bridge.looks import Layer, worn  # noqa: E402
from pav_blender.bridge.scene import build_scene  # noqa: E402
from pav_blender.bridge.sequence import read_frame  # noqa: E402
from pav_blender.core import images  # noqa: E402
from pav_blender.core.collection import read_collection  # noqa: E402
from pav_blender.core.errors import InputError  # noqa: E402
from pav_blender.core.field.avatar import Avatar  # noqa: E402
from pav_blender.core.head import builtin_head  # noqa: E402
from pav_blender.core.head.areas import AREAS, area  # noqa: E402
from pav_blender.core.rendering.cameras import Camera  # noqa: E402
from pav_blender.core.rendering.render import RenderSettings, render  # noqa: E402


@pytest.fixture
def made(scene, files):
    avatar, collection = files / "small.pav", read_collection(files / "collection")
    made = build_scene(avatar, collection, "walk", appearance="morning")
    made.avatar, made.collection = Avatar.load(avatar), collection
    return made


def f12(path):
    bpy.context.scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return images.read_rgba(path) / 255


def core(made, appearance, row=0):
    clip = made.collection.clip("walk")
    return render(
        made.avatar,
        made.collection.posed(clip, np.array([row]))[0],
        Camera(clip.width, clip.height, clip.intrinsics[row], clip.camera_to_world[row]),
        appearance,
        RenderSettings.preset("final"),
        expression=clip.expression[row],
    ).rgba


def assert_same(found, expected):
    weight = expected[..., 3:]
    np.testing.assert_allclose(found[..., 3:], weight, atol=1.01 / 255)
    assert (np.abs(found[..., :3] - expected[..., :3]) * weight).max() <= 1.01 / 255


def test_layers_hide_what_is_below_as_paint_does():
    mask = np.array([0, 0.5, 1], np.float32)
    assert worn("a", ()) == "a"
    found = worn("a", (Layer("b", 0.5, mask), Layer("a", 0.2, None)))
    np.testing.assert_allclose(found["b"], 0.8 * 0.5 * mask)
    np.testing.assert_allclose(found["a"], 1 - 0.8 * 0.5 * mask)


def test_a_keyframed_layer_renders_as_the_core_blends(made, tmp_path):
    layer = made.mesh.pav.layers.add()
    layer.appearance = "evening"
    for frame, weight in ((3, 0.0), (5, 1.0)):
        layer.weight = weight
        layer.keyframe_insert("weight", frame=frame)
    scene = bpy.context.scene
    for frame, appearance in ((3, "morning"), (5, "evening")):
        scene.frame_set(frame)
        assert_same(f12(tmp_path / f"{frame}.png"), core(made, appearance, frame - 3))
    scene.frame_set(4)
    share = read_frame(scene.name, 4).actors[0].layers[0].weight
    assert 0.4 < share < 0.6
    expected = core(made, {"morning": 1 - share, "evening": share}, 1)
    assert_same(f12(tmp_path / "4.png"), expected)


def test_a_painted_region_wears_its_own(made, tmp_path):
    head = builtin_head()
    mask = (head.template[:, 0] > 0).astype(np.float32)
    group = made.mesh.vertex_groups.new(name="left")
    group.add(np.flatnonzero(mask).tolist(), 1.0, "REPLACE")
    layer = made.mesh.pav.layers.add()
    layer.appearance, layer.region = "evening", "left"
    bpy.context.scene.frame_set(3)
    expected = core(made, {"morning": 1 - mask, "evening": mask})
    assert_same(f12(tmp_path / "a.png"), expected)
    assert np.abs(expected - core(made, "morning")).max() > 0.1
    assert np.abs(expected - core(made, "evening")).max() > 0.1


def test_operators_add_move_and_remove_layers(made):
    bpy.context.view_layer.objects.active = made.mesh
    pav = made.mesh.pav
    assert bpy.ops.pav.add_layer(area="HAIR") == {"FINISHED"}
    assert bpy.ops.pav.add_layer() == {"FINISHED"}
    assert [(layer.appearance, layer.region) for layer in pav.layers] == [
        ("evening", "area.hair"),
        ("evening", ""),
    ]
    hair = looks.mesh.group_weights(made.mesh)[:, made.mesh.vertex_groups["area.hair"].index]
    expected = area("hair", builtin_head().shaped(made.avatar.betas), builtin_head().regions)
    np.testing.assert_allclose(hair, expected, atol=2e-3)
    assert bpy.ops.pav.move_layer(down=False) == {"FINISHED"}
    assert [layer.region for layer in pav.layers] == ["", "area.hair"]
    assert pav.active_layer == 0
    assert bpy.ops.pav.remove_layer() == {"FINISHED"}
    assert [layer.region for layer in pav.layers] == ["area.hair"]
    assert bpy.ops.pav.paint_region() == {"FINISHED"}
    assert bpy.context.mode == "PAINT_WEIGHT"
    assert made.mesh.vertex_groups.active.name == "area.hair"
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.pav.remove_layer()
    with pytest.raises(RuntimeError, match="has no layer to work on"):
        bpy.ops.pav.remove_layer()


@pytest.mark.parametrize(
    ("appearance", "region", "words"),
    [("", "", "layer 1 has no appearance"), ("evening", "nose", "vertex group 'nose', which is")],
)
def test_wrong_layers_are_named_and_nothing_is_written(made, tmp_path, appearance, region, words):
    layer = made.mesh.pav.layers.add()
    layer.region = region
    if appearance:
        layer.appearance = appearance
    with pytest.raises(RuntimeError, match=words):
        f12(tmp_path / "a.png")
    assert not list(tmp_path.iterdir())


def test_layers_of_no_weight_cost_nothing(made):
    layer = made.mesh.pav.layers.add()
    layer.appearance, layer.weight, layer.region = "evening", 0.0, "nowhere"
    assert read_frame(bpy.context.scene.name, 3).actors[0].layers == ()


def test_actors_with_other_layers_are_others(made):
    layer = made.mesh.pav.layers.add()
    layer.appearance = "evening"
    one, same = (read_frame(bpy.context.scene.name, 3).actors[0] for _ in range(2))
    assert one.equals(same)
    layer.weight = 0.9
    assert not one.equals(read_frame(bpy.context.scene.name, 3).actors[0])


def test_layers_are_saved_and_duplicated(made, files, tmp_path):
    bpy.context.view_layer.objects.active = made.mesh
    bpy.ops.pav.add_layer(area="BEARD")
    made.mesh.pav.layers[0].weight = 0.25
    copy = made.mesh.copy()
    assert (copy.pav.layers[0].appearance, copy.pav.layers[0].weight) == ("evening", 0.25)
    name = made.mesh.name
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "kept.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "kept.blend"))
    layer = bpy.data.objects[name].pav.layers[0]
    assert (layer.appearance, layer.region, layer.weight) == ("evening", "area.beard", 0.25)


def test_a_blend_file_renders_as_it_is_or_in_one_appearance(made, tmp_path):
    layer = made.mesh.pav.layers.add()
    layer.appearance, layer.weight = "evening", 0.5
    made.mesh.pav.keyframe_insert("appearance", frame=3)
    layer.keyframe_insert("weight", frame=3)
    bpy.context.scene.frame_end = 3
    blend = tmp_path / "kept.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(blend), copy=True)
    expected = [core(made, {"morning": 0.5, "evening": 0.5}), core(made, "evening")]
    for appearance, rgba in zip((None, "evening"), expected, strict=True):
        (written,) = render_blend(blend, appearance, str(tmp_path / f"{appearance}.png"))
        assert_same(images.read_rgba(written) / 255, rgba)


def test_thumbnails_show_each_appearance(files):
    morning, evening = (thumbnails.draw(files / "small.pav", name) for name in small.APPEARANCES)
    assert morning.shape == (thumbnails.SIZE, thumbnails.SIZE, 4)
    head = morning[..., 3] > 0.5
    rows, columns = np.flatnonzero(head.any(1)), np.flatnonzero(head.any(0))
    assert np.ptp(rows) > 0.5 * thumbnails.SIZE  # the head fills the picture
    assert abs(columns.mean() - thumbnails.SIZE / 2) < 8
    assert np.abs(morning - evening)[head].max() > 0.1
    assert thumbnails.icons(files / "small.pav", small.APPEARANCES) == [
        0,
        0,
    ]  # none without a window


def test_the_menu_has_the_areas_there_are():
    assert tuple(AREAS) == looks.AREAS


def test_a_head_without_regions_has_no_areas():
    with pytest.raises(InputError, match="no region 'scalp', which the area 'hair' needs"):
        area("hair", np.zeros((3, 3)), {})
