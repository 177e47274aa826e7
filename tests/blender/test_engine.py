"""The render engine on a tiny avatar: pixels, depth, borders, sizes, films, errors."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy")

import bpy
import small

from pav_blender.bridge import scene as bridge_scene
from pav_blender.core import images
from pav_blender.core.collection import read_collection
from pav_blender.core.field.avatar import Avatar
from pav_blender.core.rendering.cameras import Camera
from pav_blender.core.rendering.render import RenderSettings, render


@pytest.fixture
def made(scene, files):
    """The scene of the clip "walk"; renders quickly."""
    collection = read_collection(files / "collection")
    found = bridge_scene.build_scene(files / "small.pav", collection, "walk")
    scene.pav.quality = "PREVIEW"
    found.collection = collection
    return found


def core_picture(files, collection, row, appearance="morning", **changes):
    """The same frame without Blender."""
    clip = collection.clip("walk")
    camera = Camera(
        clip.width, clip.height, clip.intrinsics[row], clip.camera_to_world[row]
    ).resized(changes.pop("width", clip.width), changes.pop("height", clip.height))
    return render(
        Avatar.load(files / "small.pav"),
        collection.posed(clip, np.array([row]))[0],
        camera,
        appearance,
        RenderSettings.preset("preview"),
        expression=clip.expression[row],
        **changes,
    )


def render_png(path):
    """F12 with the picture written; uint8 [H, W, 4]."""
    bpy.context.scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return images.read_rgba(path)


def render_exr(path):
    """Combined and depth of a render through a multilayer file: [H, W, 4], [H, W]."""
    import OpenImageIO as oiio

    settings = bpy.context.scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format, settings.color_depth = "OPEN_EXR_MULTILAYER", "32"
    bpy.context.view_layer.use_pass_z = True
    bpy.context.scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    source = oiio.ImageInput.open(str(path))
    channel, part = {}, 0
    while source.seek_subimage(part, 0):  # Blender 5 writes a part a pass
        names = source.spec().channelnames
        pixels = source.read_image(part, 0, 0, len(names), "float")
        channel |= {name.split(".", 1)[-1]: pixels[..., i] for i, name in enumerate(names)}
        part += 1
    source.close()
    combined = np.stack([channel[f"Combined.{c}"] for c in "RGBA"], axis=-1)
    return combined, channel["Depth.Z"]


def as_bytes(rgba):
    return np.floor(np.clip(rgba, 0, 1) * 255 + 0.5).astype(int)


def assert_same(found, expected):
    """Within 1 of 255, colours compared where something is seen."""
    found, expected = found.astype(int), as_bytes(expected)
    assert np.abs(found[..., 3] - expected[..., 3]).max() <= 1
    weight = expected[..., 3:] / 255
    assert (np.abs(found[..., :3] - expected[..., :3]) * weight).max() <= 1.0


def test_f12_writes_what_the_core_renders(made, files, tmp_path):
    for row, frame in ((0, 3), (2, 5)):
        bpy.context.scene.frame_set(frame)
        picture = core_picture(files, made.collection, row)
        assert picture.rgba[..., 3].max() > 0.9  # something opaque, or nothing is compared
        assert picture.rgba[..., 3].min() == 0
        assert_same(render_png(tmp_path / f"{frame}.png"), picture.rgba)


def test_combined_is_linear_premultiplied_and_depth_is_along_the_axis(made, files, tmp_path):
    combined, depth = render_exr(tmp_path / "a.exr")
    picture = core_picture(files, made.collection, 0)
    colour = picture.rgba[..., :3].astype(np.float64)
    linear = np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(combined[..., :3], linear * picture.rgba[..., 3:], atol=2e-3)
    np.testing.assert_allclose(combined[..., 3], picture.rgba[..., 3], atol=2e-3)
    empty = ~np.isfinite(picture.depth)
    assert empty.any()
    assert (depth[empty] == 1e10).all()
    assert 0.5 < depth[~empty].mean() < 0.9
    np.testing.assert_allclose(depth[~empty], picture.depth[~empty], atol=1e-3)


def test_animation_renders_every_frame_and_appearance_keys(made, files, tmp_path):
    scene = bpy.context.scene
    for frame, name in ((3, "morning"), (5, "evening")):
        made.mesh.pav.appearance = name
        made.mesh.pav.keyframe_insert("appearance", frame=frame)
    scene.render.filepath = str(tmp_path) + "/"
    bpy.ops.render.render(animation=True)
    written = sorted(path.name for path in tmp_path.iterdir())
    assert written == ["0003.png", "0004.png", "0005.png", "0006.png"]
    for row, name in ((1, "morning"), (3, "evening")):
        expected = core_picture(files, made.collection, row, name).rgba
        assert_same(images.read_rgba(tmp_path / f"{row + 3:04d}.png"), expected)
    other = core_picture(files, made.collection, 3, "morning").rgba
    assert np.abs(other - expected).max() > 0.1  # the appearances do differ


def test_percentage_gives_the_smaller_picture(made, files, tmp_path):
    bpy.context.scene.render.resolution_percentage = 50
    picture = core_picture(files, made.collection, 0, width=24, height=20)
    assert_same(render_png(tmp_path / "half.png"), picture.rgba)


@pytest.mark.parametrize("crop", [True, False])
def test_border(made, files, tmp_path, crop):
    settings = bpy.context.scene.render
    settings.use_border, settings.use_crop_to_border = True, crop
    settings.border_min_x, settings.border_max_x = 0.25, 0.76
    settings.border_min_y, settings.border_max_y = 0.3, 0.9
    whole = core_picture(files, made.collection, 0).rgba
    x0, x1, y0, y1 = 12, 36, 40 - 36, 40 - 12
    found = render_png(tmp_path / "border.png")
    if crop:
        assert_same(found, whole[y0:y1, x0:x1])
        return
    expected = np.zeros_like(whole)
    expected[y0:y1, x0:x1] = whole[y0:y1, x0:x1]
    assert_same(found, expected)


@pytest.mark.parametrize("nodes", [False, True])
def test_opaque_film_shows_the_world(made, files, tmp_path, nodes):
    scene = bpy.context.scene
    scene.render.film_transparent = False
    scene.world = bpy.data.worlds.new("World")
    if nodes or bpy.app.version >= (5, 0, 0):
        if bpy.app.version < (5, 0, 0):
            scene.world.use_nodes = True
        inputs = scene.world.node_tree.nodes["Background"].inputs
        inputs["Color"].default_value = 0.0, 0.25, 0.125, 1.0
        inputs["Strength"].default_value = 2.0
    else:
        scene.world.color = 0.0, 0.5, 0.25
    combined, _ = render_exr(tmp_path / "a.exr")
    assert (combined[..., 3] == 1).all()
    alpha = core_picture(files, made.collection, 0).rgba[..., 3]
    np.testing.assert_allclose(combined[alpha == 0][:, :3], [[0, 0.5, 0.25]] * (alpha == 0).sum())


def test_moved_and_scaled_head_seen_by_a_moved_camera(made, files, tmp_path):
    """Moving everything alike changes nothing; a doubled head at double the distance neither."""
    from mathutils import Matrix

    made.camera.animation_data.action = None
    before = render_png(tmp_path / "before.png")
    turn = Matrix.Translation((0.3, -2, 1)) @ Matrix.Rotation(1.1, 4, "Z")
    turn = turn @ Matrix.Diagonal((2, 2, 2, 1))
    made.armature.matrix_world = turn @ made.armature.matrix_world
    moved = turn @ made.camera.matrix_world
    location, rotation, _ = moved.decompose()
    made.camera.matrix_world = Matrix.LocRotScale(location, rotation, None)
    _, depth = render_exr(tmp_path / "a.exr")
    bridge_scene.use_engine(bpy.context.scene)
    after = render_png(tmp_path / "after.png")
    assert np.abs(before.astype(int) - after.astype(int)).max() <= 3
    assert 1.0 < depth[depth < 1e9].mean() < 1.8  # metres of the world, not of the head


def test_two_heads_cover_each_other_by_depth(scene, files, tmp_path):
    near = bridge_scene.build_scene(
        files / "small.pav", read_collection(files / "collection"), "walk"
    )
    scene.pav.quality = "PREVIEW"
    alone = render_png(tmp_path / "near.png")
    far = bridge_scene.build_head(files / "small.pav", "evening")
    far.armature.location.y = 0.5  # behind
    both = render_png(tmp_path / "both.png")
    opaque = alone[..., 3] == 255
    assert opaque.any()
    np.testing.assert_array_equal(both[opaque], alone[opaque])
    far.armature.location.y = -0.15  # in front now
    assert np.abs(render_png(tmp_path / "c.png").astype(int) - both)[opaque].max() > 20
    assert near.mesh.name != far.mesh.name


def missing_file(made, files):
    made.mesh.pav.avatar = str(files / "gone.pav")
    return r"gone\.pav: no such avatar file"


def not_an_avatar(made, files):
    made.mesh.pav.avatar = str(files / "collection" / "collection.json")
    return "not an avatar file"


def other_mesh(made, files):
    made.mesh.modifiers.new("Mirror", "MIRROR")
    return r"has \d+ vertices, the head of .* has \d+"


def other_faces(made, files):
    data = made.mesh.data
    corners = np.empty(len(data.loops), np.int32)
    data.loops.foreach_get("vertex_index", corners)
    data.loops.foreach_set("vertex_index", np.roll(corners.reshape(-1, 3), 1, axis=1).ravel())
    return "its faces are not those"


def unknown_appearance(made, files):
    small.write_avatar(files / "renamed.pav", appearances=["noon"])
    made.mesh.pav.avatar = str(files / "renamed.pav")
    return "the appearance chosen there is not in .*renamed.pav; it has noon"


def other_keys(made, files):
    for key in made.mesh.data.shape_keys.key_blocks[1:]:
        key.name = f"x {key.name}"
    return "none of its shape keys"


def no_camera(made, files):
    bpy.context.scene.camera = None
    return "[Nn]o camera"


def no_avatar(made, files):
    made.mesh.hide_render = True
    return "shows no avatar"


def flat_scale(made, files):
    made.armature.scale.x = 0
    return "scale is zero"


def orthographic(made, files):
    made.camera.data.type = "ORTHO"
    return "perspective"


FAULTS = (
    missing_file,
    not_an_avatar,
    other_mesh,
    other_faces,
    unknown_appearance,
    other_keys,
    no_camera,
    no_avatar,
    flat_scale,
    orthographic,
)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_faults_raise_and_write_no_frame(made, files, tmp_path, fault):
    message = fault(made, files)
    bpy.context.scene.render.filepath = str(tmp_path) + "/"
    with pytest.raises(RuntimeError, match=message):
        bpy.ops.render.render(animation=True)
    assert list(tmp_path.iterdir()) == []


def test_an_unforeseen_fault_stops_the_render_too(made, monkeypatch, tmp_path):
    from pav_blender.bridge import final

    def fail(*_args):
        raise ZeroDivisionError("seven")

    monkeypatch.setattr(final, "draw", fail)
    bpy.context.scene.render.filepath = str(tmp_path) + "/"
    with pytest.raises(RuntimeError, match="ZeroDivisionError: seven"):
        bpy.ops.render.render(animation=True)
    assert list(tmp_path.iterdir()) == []


def test_appearance_numbers_do_not_depend_on_their_order(made, files):
    small.write_avatar(files / "swapped.pav", appearances=["noon", "evening", "morning"])
    made.mesh.pav.appearance = "evening"
    made.mesh.pav.avatar = str(files / "swapped.pav")
    assert made.mesh.pav.appearance == "evening"


def test_avatar_is_read_again_when_its_file_changed(made, files, tmp_path):
    path = small.write_avatar(tmp_path / "own.pav", seed=1)
    made.mesh.pav.avatar = str(path)
    first = render_png(tmp_path / "a.png")
    small.write_avatar(path, seed=2)
    assert (render_png(tmp_path / "b.png") != first).any()
