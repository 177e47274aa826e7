"""Whole rays compiled (`kernels/cpu/tracing`) against the field itself, step by step."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
import torch
from numba import njit

from pav_blender.core import kernels
from pav_blender.core.config import Config
from pav_blender.core.evaluation.metrics import over, psnr
from pav_blender.core.field.field import condition
from pav_blender.core.field.frozen import freeze
from pav_blender.core.kernels.cpu import frozen_pairs, marching, pairs, tracing
from pav_blender.core.kernels.reference.marching import occupied
from pav_blender.core.kernels.structures import Layers
from pav_blender.core.rendering import render as rendering
from pav_blender.core.rendering.render import RenderSettings, render
from pav_blender.core.training.frames import camera_of
from pav_blender.core.training.prepare import load_training_frames, new_avatar

EVERY = RenderSettings(probe=1, longest=1, agreement=0.0, brief=False)
SMALL = Config(levels=6, log2_entries=12, finest_resolution=128, occupancy_resolution=48)
FIELDS = {
    "default": {},
    "no shoulders": {"shoulder_levels": 0},
    "texture": {"appearance": "surface", "latent_size": 32},
    "one vector": {"appearance": "global", "global_channels": 24},
    "no appearance": {"appearance": "none"},
    "no offset": {"density_offset": False},
    "offset without geometry": {"offset_sees_geometry": False},
    "expression": {"sees_expression": True},
    "deep": {"density_layers": 2, "colour_layers": 3, "offset_layers": 2, "hidden": 32},
    "rigid frames": {"frames": "rigid"},
    "fog": {"start_on_mesh": False, "density_bias": -3.0},
    "no code": {"appearance_code": False},
}


@pytest.fixture(scope="module")
def frames(toy):
    return load_training_frames(toy)


@pytest.fixture(scope="module")
def pose(toy):
    clip = toy.clip("plain")
    camera = camera_of(clip, 7).resized(40, 40)
    vertices = toy.posed(clip, np.array([7]))[0]
    return {"vertices": vertices, "camera": camera, "expression": clip.expression[7]}


def stirred(toy, frames, changes):
    """An untrained avatar of these settings, every number of which matters."""
    torch.manual_seed(0)
    avatar = new_avatar(toy, frames, dataclasses.replace(SMALL, **changes))
    with torch.no_grad():
        for name, value in avatar.field.named_parameters():
            value.add_(torch.randn_like(value) * (0.3 if "latent" in name else 0.1))
        if avatar.field.offset is not None:
            avatar.field.offset.weights[-1].mul_(3)
    return avatar


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("worn", ["one", "several"])
def test_every_kind_of_field_looks_the_same(toy, frames, pose, name, worn, monkeypatch):
    avatar = stirred(toy, frames, FIELDS[name])
    height = avatar.canonical_vertices[:, 1]
    upper = (height > np.median(height)) * np.float32(0.7)
    blend = {"plain": 1 - upper, "bushy": upper} if worn == "several" else "plain"
    whole = render(avatar, appearance=blend, settings=EVERY, **pose)
    brief = render(avatar, appearance=blend, settings=replace(EVERY, brief=True), **pose)
    monkeypatch.setattr(rendering, "_whole", rendering._by_waves)
    steps = render(avatar, appearance=blend, settings=EVERY, **pose)
    assert (steps.rgba[..., 3] > 0.5).mean() > 0.05
    assert steps.rgba[..., :3][steps.rgba[..., 3] > 0.5].std() > 0.01
    assert psnr(over(whole.rgba, 1.0), over(steps.rgba, 1.0)) > 75
    assert whole.evaluations == pytest.approx(steps.evaluations, rel=1e-3)
    assert psnr(over(brief.rgba, 1.0), over(whole.rgba, 1.0)) > 55
    assert pairs.available() != np.array_equal(brief.rgba, whole.rgba)


def test_evaluations_are_those_of_the_field(toy_avatar, pose, monkeypatch):
    """Counted at the field itself, where every place is walked to."""
    usual = render(toy_avatar, appearance="plain", **pose)  # the guide is known from here on
    counted, field = [0], toy_avatar.field
    geometry = field.geometry

    def count(samples, *rest):
        counted[0] += len(samples.canonical)
        return geometry(samples, *rest)

    monkeypatch.setattr(field, "geometry", count)
    walked = RenderSettings(skip=False)
    dense = render(toy_avatar, appearance="plain", settings=walked, **pose)
    assert dense.evaluations == counted[0] > 1000
    assert 100 < usual.evaluations < dense.evaluations / 2


@pytest.mark.parametrize("name", ["default", "one vector", "offset without geometry"])
def test_a_frozen_field_is_the_field(toy, frames, name):
    """Folded biases and widened weights, in float64, against the networks as they are."""
    avatar = stirred(toy, frames, FIELDS[name])
    field = avatar.field.double()
    seen = condition(avatar.config, np.zeros(len(avatar.expression_names)), np.ones(3)).double()
    worn = field.wearing([1])
    frozen = freeze(field, seen, worn)
    geometry = torch.randn(5, avatar.config.geometry_channels, dtype=torch.float64)
    with torch.no_grad():
        weight, bias = frozen.density.weights[0], frozen.density.biases[0]
        x = torch.randn(5, weight.shape[1], dtype=torch.float64)
        whole = x @ field.density.weights[0].T + field.density.biases[0]
        whole = whole + field.density.group_weight @ seen
        torch.testing.assert_close(x @ weight.T + bias, whole)
        rows = frozen.latent[0, :1].expand(5, -1)
        embedding = worn.latent[0, :1] if avatar.config.appearance == "vertex" else worn.latent
        if worn.code.shape[1]:
            embedding = embedding + worn.code
        embedding = embedding.expand(5, -1)
        sees = [embedding, geometry[:, 1:]][: 1 + avatar.config.offset_sees_geometry]
        own = torch.cat(sees, 1) @ field.offset.weights[0].T + field.offset.biases[0]
        own = own + field.offset.group_weight @ seen
        folded = torch.cat([rows, geometry], 1) @ frozen.offset.weights[0].T
        torch.testing.assert_close(folded + frozen.offset.biases[0], own)


@pytest.mark.parametrize("sizes", [(5, 16, 3), (36, 64, 16), (8, 1), (7, 33, 50, 17)])
def test_networks_in_bfloat16_are_those_of_rounded_numbers(sizes):
    """Against float64 sums of numbers rounded as the kernel says it rounds them."""
    if not pairs.available():
        pytest.skip("this processor does not multiply pairs of bfloat16 numbers")
    rng = np.random.default_rng(0)
    shapes = list(zip(sizes[1:], sizes[:-1], strict=True))
    layers = Layers(
        [torch.tensor(rng.normal(size=s), dtype=torch.float32) for s in shapes],
        [torch.tensor(rng.normal(size=s[0]), dtype=torch.float32) for s in shapes],
    )
    network, count = pairs.pack(layers), 23
    x = rng.normal(size=(count + pairs.BLOCK, sizes[0] + sizes[0] % 2)).astype(np.float32)
    x[:, sizes[0] :] = 0
    found = through(network, pairs.rounded(x).view(np.int32), count)[:, : sizes[-1]]

    def short(values):
        bits = pairs.rounded(values).view(np.uint16).astype(np.uint32) << 16
        return bits.view(np.float32).astype(np.float64)

    hidden = short(x[:count, : sizes[0]])
    for k, (weight, bias) in enumerate(zip(layers.weights, layers.biases, strict=True)):
        hidden = hidden @ short(weight.numpy()).T + bias.double().numpy()
        if k < len(layers.weights) - 1:
            hidden = short(np.maximum(hidden, 0).astype(np.float32))
    # a sum on the edge of two bfloat16 numbers may be rounded to the other
    scale = np.abs(hidden).max()
    assert np.abs(found - hidden).max() < 1e-2 * scale
    assert np.median(np.abs(found - hidden)) < 1e-4 * scale


def through(network, x, count):
    """A network's answers [count, padded]."""
    work = pairs.workspace(network.plan)
    none = np.zeros(0, np.float32), np.zeros(0, np.int32)
    at, step, stride = (np.int64(n) for n in (0, x.shape[1], 1))
    pairs.through_layers(at, np.int64(count), x.reshape(-1), at, step, stride, network, *none, work)
    wide = network.plan[-1, pairs.OUT_PAD]
    return work[2][: count * wide].reshape(count, wide)


def test_numbers_beyond_bfloat16_stay_in_float32(toy, frames, pose):
    avatar = stirred(toy, frames, {})
    with torch.no_grad():
        avatar.field.colour.weights[0][0, 0] = 3e38
    still = np.zeros(len(avatar.expression_names), np.float32), np.zeros(3, np.float32)
    field = freeze(avatar.field, condition(avatar.config, *still), avatar.field.wearing([0]))
    assert not frozen_pairs.fits(field)


@njit
def filled_near(points, voxels, grid):
    found = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        brick = tracing._brick_at(x, y, z, voxels)
        found[i] = tracing._filled_near(x, y, z, brick, voxels[2], grid)
    return found


def test_bricks_spare_searches_and_hide_next_to_nothing(toy_avatar, pose):
    scene = rendering.pose_scene(toy_avatar, pose["vertices"], "plain", pose["expression"])
    voxels, space, ops = scene.voxels, scene.clearance, kernels.select("cpu")
    rng = np.random.default_rng(0)
    bricks = np.argwhere(voxels.bricks.numpy() >= 0)
    inside = bricks[rng.integers(0, len(bricks), 20_000)] + rng.random((20_000, 3))
    points = (inside / voxels.scale + voxels.box_min.numpy()).astype(np.float32)
    flat = marching.flat
    found = filled_near(
        points,
        (voxels.bricks.view(-1).numpy(), len(voxels.bricks), flat(voxels.maps),
         flat(voxels.box_min), np.float32(voxels.scale)),
        marching.grid_of(space),
    )  # fmt: skip
    # a place on the box's far corner, by rounding, is one of the last brick
    side = len(voxels.bricks) / voxels.scale
    corner = (voxels.box_min.numpy() + side * (1 + 1e-6))[None].astype(np.float32)
    last = (np.array([-1], np.int32), 1, flat(voxels.maps), flat(voxels.box_min),
            np.float32(1 / side))  # fmt: skip
    assert filled_near(corner, last, marching.grid_of(space)).all()
    where = torch.from_numpy(points)
    triangle, barycentric, _ = ops.nearest.nearest(scene.mesh.search, where)
    canonical = ops.marching.canonicalise(where, triangle, barycentric, scene.mesh)
    filled = occupied(canonical, space).numpy()
    assert 0.1 < filled.mean() < 0.9
    assert (filled & ~found).sum() < 2e-3 * filled.sum()
    assert (~found).sum() > 0.6 * (~filled).sum()
