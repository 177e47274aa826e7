"""Composite with Scene: what is nearer covers, colours stay, doing it twice and undoing it."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy")

import bpy

from pav_blender.bridge import compositing, final, render, sequence, shot
from pav_blender.bridge import scene as bridge_scene
from pav_blender.core import images
from pav_blender.core.collection import read_collection
from pav_blender.core.errors import InputError

RED, GREEN = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)


@pytest.fixture
def made(scene, files):
    found = bridge_scene.build_scene(
        files / "small.pav", read_collection(files / "collection"), "walk"
    )
    scene.pav.quality = "PREVIEW"
    return found


def picture(path):
    bpy.context.scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return images.read_rgba(path).astype(int)


def composite():
    bpy.ops.pav.composite()
    scene = bpy.context.scene
    assert scene.render.engine == "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 4, False
    scene.cycles.pixel_filter_type, scene.cycles.device = "BOX", "CPU"


def glowing(colour):
    material = bpy.data.materials.new("glowing")
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    light, out = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeOutputMaterial")
    light.inputs["Color"].default_value = (*colour, 1)
    tree.links.new(light.outputs[0], out.inputs["Surface"])
    bpy.context.object.data.materials.append(material)
    return bpy.context.object


def box(forward, colour):
    """Right of the middle, `forward` metres before the head's middle (the camera is at -y)."""
    bpy.ops.mesh.primitive_cube_add(size=1, location=(0.05, -forward, 0.0))
    bpy.context.object.scale = (0.05, 0.05, 0.6)
    return glowing(colour)


def wall():
    bpy.ops.mesh.primitive_plane_add(size=4, location=(0, 0.6, 0), rotation=(np.pi / 2, 0, 0))
    return glowing(GREEN)


def same(found, expected, where, within=2):
    assert where.any()
    return np.abs(found[where] - np.asarray(expected)[where]).max() <= within


def test_nearer_covers_farther_both_ways(made, scene, tmp_path):
    alone = picture(tmp_path / "alone.png")
    solid, empty = alone[..., 3] == 255, alone[..., 3] == 0
    wall()
    near = box(0.3, RED)
    composite()
    before = picture(tmp_path / "before.png")
    assert (before[..., 3] == 255).all()
    assert same(before, np.full_like(before, (0, 255, 0, 255)), empty & (before[..., 0] == 0))
    covered = (before == (255, 0, 0, 255)).all(-1)
    assert (covered & solid).sum() > 50
    left = np.arange(covered.shape[1]) < np.flatnonzero(covered.any(0)).min() - 1
    assert same(before, alone, solid & left)

    near.location.y = 0.3  # behind the head
    behind = picture(tmp_path / "behind.png")
    assert same(behind, alone, solid & left)
    red = (behind == (255, 0, 0, 255)).all(-1)
    assert red.any()  # seen beside the head
    assert not (red & solid).any()
    assert same(behind, alone, solid & ~edge(alone))

    near.hide_render = True
    assert same(picture(tmp_path / "none.png"), alone, solid & ~edge(alone))


def edge(rgba):
    """Pixels beside ones that are not opaque."""
    soft = rgba[..., 3] < 255
    return np.logical_or.reduce(
        [np.roll(soft, (y, x), (0, 1)) for y in (-1, 0, 1) for x in (-1, 0, 1)]
    )


def test_a_wall_through_the_head_shows_of_it_what_is_nearer(made, scene, tmp_path):
    """Depth by depth: the head's own against the wall's, which is the same everywhere."""
    alone = picture(tmp_path / "alone.png")
    head_depth = render.draw(sequence.read_frame(scene.name, scene.frame_current)).depth
    solid = (alone[..., 3] == 255) & ~edge(alone)
    middle = float(np.median(head_depth[solid]))
    plane = wall()
    plane.location.y = made.camera.matrix_world.translation.y + middle
    composite()
    found = picture(tmp_path / "cut.png")
    nearer = head_depth < middle
    clear = np.abs(head_depth - middle) > 1e-3
    for rolled in (np.roll(nearer, (y, x), (0, 1)) for y in (-1, 0, 1) for x in (-1, 0, 1)):
        clear &= rolled == nearer  # off the line where they meet
    assert min((clear & solid & nearer).sum(), (clear & solid & ~nearer).sum()) > 30
    assert same(found, alone, clear & solid & nearer)
    assert same(found, np.full_like(found, (0, 255, 0, 255)), clear & solid & ~nearer)


def test_soft_edges_and_colours_are_those_of_f12(made, scene, tmp_path):
    """Nothing but the head, on a transparent film: to the byte the same as without compositing."""
    alone = picture(tmp_path / "alone.png")
    composite()
    found = picture(tmp_path / "composited.png")
    assert np.abs(found[..., 3] - alone[..., 3]).max() <= 1
    assert ((alone[..., 3] > 20) & (alone[..., 3] < 235)).sum() > 20
    weight = alone[..., 3:] / 255
    assert (np.abs(found[..., :3] - alone[..., :3]) * weight).max() <= 1


def test_soft_edges_over_a_wall_are_mixed_once(made, scene, tmp_path):
    from pav_blender.core.rendering.colour import linear_to_srgb, srgb_to_linear

    alone = picture(tmp_path / "alone.png") / 255
    wall()
    composite()
    found = picture(tmp_path / "wall.png")
    alpha = alone[..., 3:]
    linear = srgb_to_linear(alone[..., :3]) * alpha + (1 - alpha) * np.asarray(GREEN)
    expected = np.rint(linear_to_srgb(linear) * 255)
    assert np.abs(found[..., :3] - expected).max() <= 2


def test_size_and_border_follow_the_outer_scene(made, scene, tmp_path):
    composite()
    whole = picture(tmp_path / "whole.png")
    settings = scene.render
    settings.use_border = settings.use_crop_to_border = True
    settings.border_min_x, settings.border_max_x = 0.25, 0.76
    settings.border_min_y, settings.border_max_y = 0.3, 0.9
    part = picture(tmp_path / "part.png")
    assert np.abs(part - whole[4:28, 12:36]).max() <= 1
    settings.use_border = False
    settings.resolution_percentage = 50
    half = picture(tmp_path / "half.png")
    assert half.shape == (20, 24, 4)
    assert half[..., 3].max() == 255


def contents():
    tree = compositing._tree_of(bpy.context.scene)
    links = {
        (link.from_socket.node.name, link.from_socket.name, link.to_node.name, link.to_socket.name)
        for link in tree.links
    }
    return sorted(node.name for node in tree.nodes), links, sorted(bpy.data.scenes.keys())


def test_twice_gives_the_same_set_up_and_removing_it_what_was_before(made, scene, tmp_path):
    """The user's own nodes keep their part: what they make of the scene goes into the join."""
    tree = compositing._tree(scene)
    layers, target = compositing._ends(tree, scene)
    filtered = tree.nodes.new("CompositorNodeBlur")
    tree.links.new(layers.outputs["Image"], filtered.inputs["Image"])
    tree.links.new(filtered.outputs["Image"], target)
    before = contents()
    composite()
    once, groups = contents(), len(bpy.data.node_groups)
    join = tree.nodes[compositing.NODE_JOIN]
    assert join.inputs["Scene"].links[0].from_node == filtered
    assert target.links[0].from_node == join
    assert not made.mesh.visible_camera
    composite()
    assert (contents(), len(bpy.data.node_groups)) == (once, groups)
    other = bpy.data.objects.new("other", bpy.data.cameras.new("other"))
    scene.collection.objects.link(other)
    scene.camera = other
    inner = compositing.head_scene(scene)
    with pytest.raises(InputError, match="press Composite with Scene there again"):
        shot.shown_in(inner)
    composite()
    assert shot.shown_in(inner) == scene
    scene.pav.quality = "FINAL"
    assert sequence.read_frame(inner.name, 3).quality == "final"
    assert set(inner.objects) == {made.mesh, other}
    bpy.ops.pav.separate()
    assert contents() == before
    assert made.mesh.visible_camera
    with pytest.raises(RuntimeError, match="not composited"):
        bpy.ops.pav.separate()


def test_what_cannot_be_composited_is_told(scene, files):
    with pytest.raises(RuntimeError, match="no head with an avatar"):
        bpy.ops.pav.composite()
    bpy.ops.pav.add_head(filepath=str(files / "small.pav"))
    with pytest.raises(RuntimeError, match="no camera"):
        bpy.ops.pav.composite()
    assert len(bpy.data.scenes) == 1
    assert compositing._tree_of(scene) is None
    assert bpy.context.object.visible_camera


def test_pav_as_the_outer_engine_is_refused(made, scene, tmp_path):
    """`-E PAV` on a composited file: it would show the heads alone, and end well."""
    composite()
    scene.render.engine = "PAV"
    scene.frame_end = scene.frame_start
    scene.render.filepath = str(tmp_path) + "/"
    with pytest.raises(RuntimeError, match="leave out `-E PAV`"):
        bpy.ops.render.render(animation=True)
    assert list(tmp_path.iterdir()) == []
    composite()
    assert picture(tmp_path / "a.png")[..., 3].max() == 255


def test_a_linked_head_is_told_and_an_override_of_it_taken(made, scene, files, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(files / "library.blend"), copy=True)
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    scene = bpy.context.scene
    with bpy.data.libraries.load(str(files / "library.blend"), link=True) as (_, wanted):
        wanted.objects = ["small", "small camera"]
    for thing in wanted.objects:
        scene.collection.objects.link(thing)
    scene.camera = wanted.objects[1]
    with pytest.raises(RuntimeError, match="make a library override"):
        bpy.ops.pav.composite()
    assert len(bpy.data.scenes) == 1
    head = wanted.objects[0].override_create(remap_local_usages=True)
    assert head.library is None
    bpy.ops.pav.composite()
    assert not head.visible_camera
    assert scene.render.engine != "PAV"  # the scene's own stays


def test_a_nested_scene_of_another_size_is_an_error(made, scene):
    class Engine:
        resolution_x, resolution_y = 100, 40

    depsgraph = bpy.context.evaluated_depsgraph_get()
    with pytest.raises(InputError, match=r"48x40 pixels .* 100x40"):
        final._check_size(Engine, depsgraph, shot.read_shot(None, depsgraph))
