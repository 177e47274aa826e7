"""Alembic and USD files, read back by Blender's own importers."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy")

import bpy
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector
from small import write_collection

from pav_blender.bridge.exchange import export_animated
from pav_blender.core.collection import read_collection
from pav_blender.core.errors import InputError
from pav_blender.core.rendering.cameras import Camera


@pytest.fixture(scope="module")
def collection(tmp_path_factory):
    found = read_collection(write_collection(tmp_path_factory.mktemp("export") / "collection"))
    # a number that no frame has: vertices go straight there
    found.clips[0].frame_id = np.array([3, 4, 6, 7], np.int32)
    return found


@pytest.mark.parametrize("kind", ["abc", "usd"])
def test_the_file_moves_and_films_as_the_clip(scene, collection, kind, tmp_path):
    clip, out = collection.clips[0], tmp_path / f"walk.{kind}"
    assert export_animated(collection, clip, out, kind, 30.0) == (3, 7)
    assert [path.name for path in tmp_path.iterdir()] == [out.name]
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = 30
    if kind == "abc":
        bpy.ops.wm.alembic_import(filepath=str(out), as_background_job=False)
    else:
        bpy.ops.wm.usd_import(filepath=str(out))
    mesh = next(thing for thing in scene.objects if thing.type == "MESH")
    camera = next(thing for thing in scene.objects if thing.type == "CAMERA")
    scene.render.resolution_x, scene.render.resolution_y = clip.width, clip.height
    posed = collection.posed(clip, np.arange(len(clip)))
    expected = {3: posed[0], 4: posed[1], 5: (posed[1] + posed[2]) / 2, 6: posed[2], 7: posed[3]}
    size = np.array([clip.width, clip.height])
    for number, vertices in expected.items():
        scene.frame_set(number)
        evaluated = mesh.evaluated_get(bpy.context.evaluated_depsgraph_get())
        world = np.array([mesh.matrix_world @ v.co for v in evaluated.data.vertices])
        np.testing.assert_allclose(world, vertices[:, [0, 2, 1]] * (1, -1, 1), atol=1e-5)
        if number == 5:
            continue
        row = clip.frame_id.tolist().index(number)
        lens = Camera(clip.width, clip.height, clip.intrinsics[row], clip.camera_to_world[row])
        pixels, _ = lens.project(vertices[::500])
        seen = [world_to_camera_view(scene, camera, Vector(p))[:2] for p in world[::500]]
        found = np.array([[x, 1 - y] for x, y in seen]) * size
        assert np.abs(found - pixels).max() < 0.1


def test_wrong_names_leave_nothing(scene, collection, tmp_path):
    clip = collection.clips[0]
    for out, fps in ((tmp_path / "a.txt", 25), (tmp_path / "x" / "a.abc", 25)):
        with pytest.raises(InputError):
            export_animated(collection, clip, out, "abc", fps)
    with pytest.raises(InputError, match="fps"):
        export_animated(collection, clip, tmp_path / "a.abc", "abc", 0)
    assert list(tmp_path.iterdir()) == []
