"""Rays that are not followed, or not from their beginning: nothing that they would show is lost."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from pav_blender.core import kernels
from pav_blender.core.field.directions import spherical_harmonics
from pav_blender.core.kernels.cpu.views import views_of
from pav_blender.core.kernels.reference import sparing as reference
from pav_blender.core.rendering import render as rendering
from pav_blender.core.rendering.cameras import Camera
from pav_blender.core.rendering.footprint import footprint
from pav_blender.core.rendering.rays import camera_rays
from pav_blender.core.rendering.render import RenderSettings, render_scene
from pav_blender.core.training.frames import camera_of

STEP = 1e-3
NAMES = ["filmed", "a part", "nearer, skewed", "of a rounded rotation", "parallel"]


@pytest.fixture(scope="module")
def scene(toy, toy_avatar):
    clip = toy.clip("plain")
    vertices = toy.posed(clip, np.array([7]))[0]
    return rendering.pose_scene(toy_avatar, vertices, "plain", clip.expression[7])


def cameras(toy):
    filmed = camera_of(toy.clip("plain"), 7).resized(72, 72)
    near = filmed.camera_to_world.copy()
    near[:3, 3] -= 0.2 * near[:3, 2]
    rounded = filmed.camera_to_world.copy()
    rounded[:3, :3] @= np.array([[1.03, 0.03, 0.0], [0.0, 1.03, 0.0], [0.0, 0.0, 0.97]])
    scale = np.array([[120.0, 0, 36], [0, 120, 36], [0, 0, 1]])
    skewed = filmed.intrinsics + np.array([[0, 15.0, 0], [0, 0, 0], [0, 0, 0]])
    return {
        "filmed": filmed,
        "a part": filmed.window(20, 10, 61, 37),
        "nearer, skewed": replace(filmed, camera_to_world=near, intrinsics=skewed),
        "of a rounded rotation": replace(filmed, camera_to_world=rounded),
        "parallel": Camera(72, 72, scale, filmed.camera_to_world, parallel=True),
    }


def all_rays(camera):
    rows, columns = (axis.reshape(-1) for axis in np.indices((camera.height, camera.width)))
    return rows, columns, camera_rays(camera, columns, rows)


@pytest.mark.parametrize("name", NAMES)
def test_all_places_in_bricks_lie_within_the_footprint(name, toy, scene):
    camera = cameras(toy)[name]
    where = footprint(scene.voxels, camera)
    covered = where.covered(camera.height, camera.width)
    assert 0.1 < covered.mean() < 1 or name == "a part"
    rows, columns, rays = all_rays(camera)
    near, far = where.between(rows, columns)
    t = (torch.arange(3000) + 0.5) * STEP  # as far as the person is away, and further
    seen = 0
    for start in range(0, len(rows), 500):
        part = slice(start, start + 500)
        places = rays.origins[part, None] + t[:, None] * rays.directions[part, None]
        inside = _in_bricks(scene.voxels, places)
        ray, k = inside.nonzero().unbind(1)
        ray = ray.numpy() + start
        assert covered[rows[ray], columns[ray]].all()
        assert (near[ray] <= t[k].numpy()).all()
        assert (t[k].numpy() <= far[ray]).all()
        seen += len(ray)
    assert seen > 1000


def _in_bricks(voxels, places):
    at = ((places - voxels.box_min) * voxels.scale).floor().long()
    size = len(voxels.bricks)
    inside = ((at >= 0) & (at < size)).all(-1)
    x, y, z = at.clamp(0, size - 1).unbind(-1)
    return inside & (voxels.bricks[x, y, z] >= 0)


def test_a_camera_among_bricks_follows_every_ray(toy, scene):
    camera = cameras(toy)["filmed"]
    middle = (scene.voxels.bricks >= 0).nonzero().double().mean(0) + 0.5
    pose = camera.camera_to_world.copy()
    pose[:3, 3] = (scene.voxels.box_min.double() + middle / scene.voxels.scale).numpy()
    where = footprint(scene.voxels, replace(camera, camera_to_world=pose))
    assert (where.near == 0).all()
    assert np.isinf(where.far).all()


def test_a_camera_that_looks_away_follows_none(toy, scene):
    camera = cameras(toy)["filmed"]
    away = camera.camera_to_world @ np.diag([-1.0, 1, -1, 1])
    assert not footprint(scene.voxels, replace(camera, camera_to_world=away)).covered(72, 72).any()


@pytest.mark.parametrize("preset", ["preview", "final"])
def test_pictures_are_the_same_where_every_ray_is_followed(preset, toy, scene, monkeypatch):
    camera, settings = cameras(toy)["filmed"], RenderSettings.preset(preset)
    own = render_scene(scene, camera, settings)
    assert 0.1 < (own.rgba[..., 3] > 0.5).mean() < 0.9
    everything = footprint(scene.voxels, camera)
    everything.near[:], everything.far[:] = 0, np.inf
    monkeypatch.setattr(rendering, "footprint", lambda *_: everything)
    whole = render_scene(scene, camera, settings)
    assert own.evaluations == whole.evaluations
    np.testing.assert_array_equal(own.rgba, whole.rgba)
    np.testing.assert_array_equal(own.depth, whole.depth)


def test_rays_enter_where_the_first_voxel_holds_something(toy, scene):
    """And end, or pass, where no voxel does."""
    camera = cameras(toy)["filmed"]
    _, _, rays = all_rays(camera)
    voxels, known = scene.voxels, scene.known
    nothing, far = torch.zeros(len(rays)), torch.full((len(rays),), 3.0)
    tracing = kernels.select("cpu").tracing
    first, last = tracing.enter(voxels, known, rays.origins, rays.directions, nothing, far, STEP)
    t = (torch.arange(3000) + 0.5) * STEP
    hit = 0
    for ray in range(0, len(rays), 37):
        places = rays.origins[ray] + t[:, None] * rays.directions[ray]
        at = (places - voxels.box_min) * voxels.scale
        size = len(voxels.bricks)
        inside = ((at >= 0) & (at < size)).all(1)
        x, y, z = at.long().clamp(0, size - 1).unbind(1)
        row = voxels.bricks[x, y, z].long()
        u, v, w = ((at - at.floor()) * 4).long().unbind(1)
        held = inside & (row >= 0) & (known.density[row.clamp(min=0), u, v, w] >= 0)
        k = held.nonzero()[:, 0]
        if len(k) == 0:
            assert first[ray] > last[ray]
            continue
        hit += 1
        assert abs(int(first[ray]) - int(k[0])) <= 1  # by rounding
        assert last[ray] >= k[-1] - 1
    assert hit > 20


def test_what_is_known_of_voxels(scene):
    density, held = scene.known
    cells = scene.voxels.cells.long()
    want = torch.where(cells >= 0, scene.wearing.guide.view(-1)[cells.clamp(min=0)], -1.0)
    torch.testing.assert_close(density, want, rtol=0, atol=0)
    bits = (held[:, None] >> torch.arange(64)) & 1
    assert torch.equal(bits.bool(), cells.view(-1, 64) >= 0)


def test_where_nothing_is_filled_a_picture_is_empty(toy, toy_avatar):
    clip, empty = toy.clip("plain"), copy.copy(toy_avatar)
    empty.occupied = np.zeros_like(toy_avatar.occupied)
    vertices = toy.posed(clip, np.array([7]))[0]
    picture = rendering.render(empty, vertices, cameras(toy)["filmed"], "plain")
    assert not picture.rgba.any()
    assert np.isinf(picture.depth).all()
    assert picture.evaluations == 0


def test_cover_as_the_reference():
    rng = np.random.default_rng(0)
    low = rng.integers(0, 9, (40, 2))
    corners = np.concatenate([low, low + rng.integers(0, 4, (40, 2))], 1)
    corners = corners.clip(0, [11, 7, 11, 7])
    near = rng.random(40).astype(np.float32)
    both = [
        k.cover(corners, near, near + 1, (7, 11))
        for k in (reference, kernels.select("cpu").sparing)
    ]
    np.testing.assert_array_equal(*(found[0] for found in both))
    np.testing.assert_array_equal(*(found[1] for found in both))
    assert 0.2 < np.isfinite(both[0][0]).mean() < 1


def test_views_are_harmonics_of_the_turned_directions():
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator), dim=1)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator))[0]
    view = torch.randn(16, 21, generator=generator)
    got = torch.from_numpy(views_of(directions, rotation, view))
    want = spherical_harmonics(directions @ rotation) @ view
    assert got.shape == (50, 32)
    torch.testing.assert_close(got[:, :21], want, rtol=1e-5, atol=1e-5)
    assert (got[:, 21:] == 0).all()
