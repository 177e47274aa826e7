"""Heads that are appended, linked and overridden in other files."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

pytest.importorskip("bpy")

import bpy
import small
from open_files import add, evaluated, heads, picture, reopen, save

from pav_blender.bridge import avatars, links


@pytest.fixture
def library(scene, files, here):
    """A saved file with a moving head in the collection "Ann"; its folder, and its picture."""
    folder = here / "library"
    folder.mkdir()
    shutil.move(here / "small.pav", folder / "small.pav")
    save(folder / "library.blend")
    head = add(scene, folder, files)
    group = bpy.data.collections.new("Ann")
    scene.collection.children.link(group)
    for object_ in (head, head.parent, scene.camera):
        group.objects.link(object_)
        scene.collection.objects.unlink(object_)
    drawn = picture(scene)
    save(folder / "library.blend")
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    save(here / "main.blend")
    return folder, drawn


def load(folder, link):
    """The collection "Ann" appended or linked, as the window's File menu does it."""
    bpy.ops.wm.append(
        filepath=str(folder / "library.blend" / "Collection" / "Ann"),
        directory=str(folder / "library.blend") + "/Collection/",
        filename="Ann",
        link=link,
        instance_collections=link,
    ) if not link else bpy.ops.wm.link(
        filepath=str(folder / "library.blend" / "Collection" / "Ann"),
        directory=str(folder / "library.blend") + "/Collection/",
        filename="Ann",
        instance_collections=True,
    )
    scene = bpy.context.scene
    scene.camera = next(o for o in bpy.data.objects if o.type == "CAMERA")
    scene.render.resolution_x, scene.render.resolution_y = small.WIDTH, small.HEIGHT
    scene.render.film_transparent = True
    return scene


def test_an_appended_head_renders_the_same(library, here):
    folder, drawn = library
    scene = load(folder, link=False)
    (head,) = heads()
    assert head.library is None
    if hasattr(bpy.app.handlers, "blend_import_post"):
        assert head.pav.avatar == "//library/small.pav"
    np.testing.assert_array_equal(picture(scene), drawn)
    before = evaluated(head)
    head.data.shape_keys.key_blocks["neck_turn"].value = 1.0
    assert np.abs(evaluated(head) - before).max() > 0.02
    save(here / "main.blend")
    np.testing.assert_array_equal(heads()[0].data.name, head.data.name)


def test_a_linked_head_renders_the_same(library, here):
    folder, drawn = library
    scene = load(folder, link=True)
    np.testing.assert_array_equal(picture(scene), drawn)
    save(here / "main.blend")
    np.testing.assert_array_equal(picture(reopen(here / "main.blend")), drawn)
    (linked,) = (object_ for object_ in bpy.data.objects if object_.pav.avatar)
    assert linked.pav.avatar == "//small.pav"  # the library's own, untouched
    (folder / "small.pav").rename(folder / "gone.pav")
    mended, missing = links.relink(folder)
    assert mended == []
    assert "linked from" in missing[0]


def test_an_override_keeps_its_edits(library, here):
    folder, drawn = library
    scene = load(folder, link=True)
    (instance,) = (o for o in scene.objects if o.instance_type == "COLLECTION")
    root = instance.instance_collection.override_hierarchy_create(
        scene, bpy.context.view_layer, do_fully_editable=True
    )
    bpy.data.objects.remove(instance)
    assert root is not None
    (head,) = heads()
    assert head.override_library is not None
    scene.camera = next(o for o in scene.objects if o.type == "CAMERA")
    np.testing.assert_array_equal(picture(scene), drawn)  # its path is the library's
    head.pav.appearance = "evening"
    changed = picture(scene)
    assert np.abs(changed - drawn).max() > 0.02
    save(here / "main.blend")
    scene = reopen(here / "main.blend")
    (head,) = heads()
    assert head.pav.appearance == "evening"
    np.testing.assert_array_equal(picture(scene), changed)
    # a file of its own
    shutil.copy(folder / "small.pav", here / "own.pav")
    head.pav.avatar = "//own.pav"
    save(here / "main.blend")
    scene = reopen(here / "main.blend")
    (head,) = heads()
    assert avatars.path_of(head.pav) == here / "own.pav"
    np.testing.assert_array_equal(picture(scene), changed)


def test_an_overridden_head_can_be_animated(library, here, files):
    folder, _ = library
    scene = load(folder, link=True)
    (instance,) = (o for o in scene.objects if o.instance_type == "COLLECTION")
    bpy.context.view_layer.objects.active = instance
    bpy.ops.pav.override_head()
    (head,) = heads()
    assert bpy.context.object == head
    assert head.override_library is not None
    scene.pav.collection = str(files / "collection")
    bpy.ops.pav.import_track()
    assert scene.camera.library is None  # the library's camera stays as it is
    assert scene.camera.override_library is None
    block = head.data.shape_keys.key_blocks["neck_turn"]
    block.value = 0.8
    block.keyframe_insert("value", frame=6)
    drawn = picture(scene, 6)
    posed = evaluated(head)
    block.value = 0.0
    save(here / "main.blend")
    scene = reopen(here / "main.blend")
    (head,) = heads()
    assert head.pav.camera == scene.camera
    np.testing.assert_array_equal(picture(scene, 6), drawn)
    np.testing.assert_array_equal(evaluated(head), posed)
    head.data.shape_keys.animation_data.action = None
    head.data.shape_keys.key_blocks["neck_turn"].value = 0.0
    assert np.abs(evaluated(head) - posed).max() > 0.02  # the drivers read the override's keys
    with pytest.raises(RuntimeError, match="not linked from another file"):
        bpy.ops.pav.override_head()


def test_animating_a_linked_head_is_refused(library, here, files):
    folder, _ = library
    scene = load(folder, link=True)
    (instance,) = (o for o in scene.objects if o.instance_type == "COLLECTION")
    # Blender's own override leaves the shape keys linked: keyframes there would be lost
    instance.instance_collection.override_hierarchy_create(
        scene, bpy.context.view_layer, do_fully_editable=True
    )
    bpy.data.objects.remove(instance)
    (head,) = heads()
    bpy.context.view_layer.objects.active = head
    scene.pav.collection = str(files / "collection")
    with pytest.raises(RuntimeError, match="use Override Linked Head first"):
        bpy.ops.pav.import_track()
    bpy.ops.pav.override_head()
    bpy.ops.pav.import_track()


def test_a_packed_avatar_comes_along_when_linked_and_appended(scene, files, here):
    save(here / "library.blend")
    head = add(scene, here)
    bpy.ops.pav.pack_avatar()
    name = head.name
    save(here / "library.blend")
    (here / "small.pav").unlink()
    for link in (False, True):
        bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
        with bpy.data.libraries.load(str(here / "library.blend"), link=link) as (_, target):
            target.objects = [name]
        bpy.context.scene.collection.objects.link(target.objects[0])
        (found,) = heads()
        assert avatars.header(avatars.path_of(found.pav))["appearances"] == small.APPEARANCES
