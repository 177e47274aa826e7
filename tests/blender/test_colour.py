"""What was trained is what Standard shows; other views are Blender's own transform of it."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy")

import bpy

from pav_blender.bridge import render, sequence, view
from pav_blender.bridge import scene as bridge_scene
from pav_blender.core import images
from pav_blender.core.collection import read_collection


@pytest.fixture
def made(scene, files):
    found = bridge_scene.build_scene(
        files / "small.pav", read_collection(files / "collection"), "walk"
    )
    scene.pav.quality = "PREVIEW"
    return found


def f12(scene, path):
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return images.read_rgba(path).astype(int)


def through_blender(scene, path, linear):
    """Scene-linear premultiplied pixels [H, W, 4], row 0 the top, saved by Blender in its view."""
    height, width = linear.shape[:2]
    image = bpy.data.images.new("linear", width, height, alpha=True, float_buffer=True)
    image.colorspace_settings.name = "Linear Rec.709"
    image.alpha_mode = "PREMUL"
    image.pixels.foreach_set(np.ascontiguousarray(linear[::-1], np.float32).ravel())
    image.save_render(str(path), scene=scene)
    return images.read_rgba(path).astype(int)


def seen(found, expected):
    """The largest difference, weighed by how much is seen."""
    assert np.abs(found[..., 3] - expected[..., 3]).max() <= 1
    return (np.abs(found - expected)[..., :3] * expected[..., 3:] / 255).max()


def test_standard_shows_what_the_core_draws(made, scene, tmp_path):
    pixels = render.draw(sequence.read_frame(scene.name, 3))
    expected = np.floor(np.clip(pixels.display, 0, 1) * 255 + 0.5)
    assert expected[..., 3].max() == 255
    assert seen(f12(scene, tmp_path / "a.png"), expected) <= 1
    assert view.is_standard(scene)


@pytest.mark.parametrize(
    ("name", "look"),
    [("Standard", "None"), ("AgX", "None"), ("AgX", "AgX - Punchy"), ("Filmic", "None")],
)
@pytest.mark.parametrize("film", ["transparent", "opaque"])
def test_other_views_are_blenders_own(made, scene, tmp_path, name, look, film):
    """The same scene-linear pixels, read as a picture and saved in the same view."""
    scene.render.film_transparent = film == "transparent"
    scene.world = bpy.data.worlds.new("World")
    scene.world.color = 0.18, 0.4, 0.6
    pixels = render.draw(sequence.read_frame(scene.name, 3))
    scene.view_settings.view_transform = name
    scene.view_settings.look = look
    expected = through_blender(scene, tmp_path / "expected.png", pixels.combined)
    found = f12(scene, tmp_path / "found.png")
    assert seen(found, expected) <= 1
    straight = np.floor(sequence.display(sequence.read_frame(scene.name, 3), pixels) * 255 + 0.5)
    changed = seen(found, straight)
    assert (changed <= 1) if name == "Standard" else (changed > 10)


@pytest.mark.parametrize(
    ("owner", "name", "value"),
    [
        ("view_settings", "view_transform", "AgX"),
        ("view_settings", "look", "High Contrast"),
        ("view_settings", "exposure", 0.5),
        ("view_settings", "gamma", 1.2),
        ("view_settings", "use_curve_mapping", True),
    ],
)
def test_the_button_brings_the_trained_colours_back(made, scene, owner, name, value):
    assert view.is_standard(scene)
    setattr(getattr(scene, owner), name, value)
    assert not view.is_standard(scene)
    bpy.ops.pav.use_standard_view()
    assert view.is_standard(scene)


def test_the_compositor_keeps_views_too(made, scene, tmp_path):
    bpy.ops.pav.composite()
    scene.cycles.samples, scene.cycles.device = 1, "CPU"
    pixels = render.draw(sequence.read_frame("Scene heads", 3))
    for name in ("Standard", "AgX"):
        scene.view_settings.view_transform = name
        expected = through_blender(scene, tmp_path / f"{name}-expected.png", pixels.combined)
        assert seen(f12(scene, tmp_path / f"{name}.png"), expected) <= 1
