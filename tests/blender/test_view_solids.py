"""The other meshes of a scene: which are copied, when again, and where they stand."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy")

import bpy
import small
from mathutils import Matrix

from pav_blender.bridge import axes, solids
from pav_blender.bridge.scene import build_head
from pav_blender.core.rendering.cameras import Camera
from pav_blender.core.rendering.solids import picture


def collect(copies=None, shown=lambda evaluated: True):
    bpy.context.view_layer.update()
    return (copies or solids.Copies()).collect(bpy.context.evaluated_depsgraph_get(), shown)


def cube(name="cube", **settings):
    data = bpy.data.meshes.get("box")
    if data is None:
        data = bpy.data.meshes.new("box")
        corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
        faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        data.from_pydata(corners, [], faces)
    thing = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(thing)
    for key, value in settings.items():
        setattr(thing, key, value)
    return thing


def world(solid):
    """Vertices of a solid in Blender's axes."""
    points = solid.shape.vertices @ solid.place[:3, :3].T + solid.place[:3, 3]
    return axes.points_to_blender(points)


def test_a_cube_stands_where_blender_has_it(scene):
    thing = cube(location=(1, 2, 3), scale=(0.5, 1, 2))
    thing.rotation_euler = 0.1, 0.2, 0.3
    (found,) = collect()
    assert len(found.shape.triangles) == 12
    expected = [thing.matrix_world @ v.co for v in thing.data.vertices]
    np.testing.assert_allclose(world(found), expected, atol=1e-5)
    corners = found.shape.vertices[found.shape.triangles]
    wound = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = found.shape.normals[found.shape.normal_of][:, 0]
    assert ((wound * flat).sum(1) > 0.9 * np.linalg.norm(wound, axis=1)).all()
    np.testing.assert_allclose(found.colours, [[0.8, 0.8, 0.8]])


def test_all_that_has_a_mesh_is_seen_once_and_nothing_else(scene, tmp_path):
    cube("seen")
    cube("wire", display_type="WIRE")
    cube("bounds", display_type="BOUNDS")
    cube("off", hide_viewport=True)
    cube("eye").hide_set(True)
    bpy.ops.object.text_add()
    bpy.ops.curve.primitive_bezier_circle_add()
    bpy.context.object.data.bevel_depth = 0.1
    bpy.ops.object.metaball_add(type="BALL")
    bpy.ops.surface.primitive_nurbs_surface_sphere_add()
    bpy.ops.object.empty_add()
    bpy.ops.object.light_add()
    bpy.ops.object.camera_add()
    assert len(collect()) == 5
    group = bpy.data.collections.new("group")
    for name in ("a", "b"):
        inner = cube(name)
        group.objects.link(inner)
        scene.collection.objects.unlink(inner)
    bpy.ops.object.collection_instance_add(collection="group", location=(0, 0, 9))
    found = collect()
    assert len(found) == 7
    assert sum(world(solid)[:, 2].mean() > 8 for solid in found) == 2
    rig = build_head(small.write_avatar(tmp_path / "small.pav"))
    assert len(collect()) == 7
    rig.mesh.pav.avatar = ""
    assert len(collect()) == 8
    assert len(collect(shown=lambda evaluated: evaluated.name != "seen")) == 7


def test_only_what_changed_is_copied_again(scene, monkeypatch):
    read = []
    real = solids._copy_of
    monkeypatch.setattr(
        solids, "_copy_of", lambda mesh, last: read.append(mesh) or real(mesh, last)
    )
    copies, one, other = solids.Copies(), cube("one"), cube("other", location=(0, 4, 0))
    other.data = other.data.copy()
    found = []

    def update(_scene, depsgraph):
        """As the engine is told: while Blender still knows what changed."""
        found[:] = copies.collect(depsgraph, lambda evaluated: True)

    def updated():
        bpy.context.view_layer.update()
        return tuple(found)

    bpy.app.handlers.depsgraph_update_post.append(update)
    try:
        before = updated()
        assert len(read) == 2
        one.location.x = 1
        moved = updated()
        assert len(read) == 2
        other.data.vertices[0].co.x = -3
        other.data.update()
        bent = updated()
        assert len(read) == 3
        other.data.polygons[0].use_smooth = True
        other.data.update()
        smoothed = updated()
        one.data.update()  # nothing is different
        same = updated()
    finally:
        bpy.app.handlers.depsgraph_update_post.remove(update)
    assert [a.shape is b.shape for a, b in zip(before, moved, strict=True)] == [True, True]
    assert [a.equals(b) for a, b in zip(before, moved, strict=True)] == [False, True]
    assert [a.shape is b.shape for a, b in zip(moved, bent, strict=True)] == [True, False]
    assert bent[1].shape.triangles is before[1].shape.triangles
    assert len(smoothed[1].shape.normals) == 24
    assert [a.equals(b) for a, b in zip(smoothed, same, strict=True)] == [True, True]


def test_materials_colour_their_faces(scene):
    thing = cube()
    for name, colour in (("red", (0.9, 0.1, 0.1, 1)), ("green", (0.1, 0.6, 0.2, 1))):
        material = bpy.data.materials.new(name)
        material.diffuse_color = colour
        thing.data.materials.append(material)
    thing.data.polygons[4].material_index = 1
    (found,) = collect()
    np.testing.assert_allclose(found.colours, [[0.9, 0.1, 0.1], [0.1, 0.6, 0.2]], atol=1e-6)
    assert sorted(np.bincount(found.shape.material)) == [2, 10]


@pytest.mark.parametrize("smooth", ["POINT", "CORNER"])
def test_smooth_surfaces_have_smooth_normals(scene, smooth):
    bpy.ops.mesh.primitive_uv_sphere_add(segments=32, ring_count=16)
    bpy.ops.object.shade_smooth()
    data = bpy.context.object.data
    if smooth == "CORNER":
        data.polygons[0].use_smooth = False
    assert data.normals_domain == smooth
    (found,) = collect()
    corners = found.shape.vertices[found.shape.triangles]
    normals = found.shape.normals[found.shape.normal_of]
    assert ((corners * normals).sum(-1) > 0.98).mean() > 0.99


def test_what_is_being_edited_is_seen(scene):
    thing = cube()
    bpy.context.view_layer.objects.active = thing
    bpy.ops.object.mode_set(mode="EDIT")
    (found,) = collect()
    assert len(found.shape.triangles) == 12
    bpy.ops.object.mode_set(mode="OBJECT")


def test_meshes_without_faces_and_flattened_ones_do_no_harm(scene):
    empty = bpy.data.objects.new("empty", bpy.data.meshes.new("nothing"))
    scene.collection.objects.link(empty)
    points = bpy.data.meshes.new("points")
    points.from_pydata([(0, 0, 0), (1, 0, 0)], [(0, 1)], [])
    scene.collection.objects.link(bpy.data.objects.new("points", points))
    cube(scale=(1, 0, 1), location=(0, 3, 0))
    found = collect()
    assert len(found) == 1
    camera = Camera(20, 10, np.array([[10.0, 0, 10], [0, 10, 5], [0, 0, 1]]),
                    axes.camera_to_core(np.array(Matrix.Rotation(np.pi / 2, 4, "X"))))  # fmt: skip
    colour, depth = picture(found, camera)
    np.testing.assert_allclose(depth[5, 10], 3.0, rtol=1e-5)
    assert colour[5, 10].min() > 0.05
