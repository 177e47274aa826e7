import dataclasses

import numpy as np
import pytest

from pav_blender.core.errors import Cancelled, InputError
from pav_blender.core.evaluation.metrics import over, psnr
from pav_blender.core.rendering import render as rendering
from pav_blender.core.rendering.render import RenderSettings, render
from pav_blender.core.training.frames import camera_of


@pytest.fixture(scope="module")
def pose(toy):
    clip = toy.clip("plain")
    vertices = toy.posed(clip, np.array([7]))[0]
    return {"vertices": vertices, "camera": camera_of(clip, 7), "expression": clip.expression[7]}


def picture(avatar, pose, appearance="plain", settings=None, **rest):
    return render(avatar, appearance=appearance, settings=settings, **(pose | rest))


def test_a_picture_has_a_head_before_nothing(toy_avatar, pose):
    shown = picture(toy_avatar, pose)
    assert shown.rgba.shape == (64, 64, 4)
    assert shown.rgba.min() >= 0
    assert shown.rgba.max() <= 1
    assert shown.rgba[0, 0, 3] == 0
    assert np.isinf(shown.depth[0, 0])
    assert (shown.rgba[..., 3] > 0.9).mean() > 0.1
    solid = shown.rgba[..., 3] > 0.9
    assert 0.5 < np.median(shown.depth[solid]) < 0.9


def test_depth_is_where_the_tracked_face_is(toy, toy_avatar, pose):
    from pav_blender.core.rendering.rasterise import rasterise

    shown = picture(toy_avatar, pose)
    mesh, triangle, _ = rasterise(pose["vertices"], toy.head.triangles, pose["camera"])
    face = toy.head.regions["face"][toy.head.triangles].all(1)
    seen = (triangle >= 0) & face[triangle] & (shown.rgba[..., 3] > 0.95)
    assert np.median(np.abs(shown.depth[seen] - mesh[seen])) < 0.02


def test_a_region_is_that_part_of_the_whole(toy_avatar, pose):
    box = (10, 5, 50, 45)
    every = RenderSettings(agreement=0.0)
    whole = picture(toy_avatar, pose, settings=every)
    part = picture(toy_avatar, pose, region=box, settings=every)
    np.testing.assert_allclose(part.rgba, whole.rgba[5:45, 10:50], atol=1e-5)
    np.testing.assert_allclose(part.depth, whole.depth[5:45, 10:50], rtol=1e-5)
    # which pixels are the mean of others depends on where a picture begins
    spared = picture(toy_avatar, pose, region=box)
    difference = over(spared.rgba, 1.0) - over(whole.rgba[5:45, 10:50], 1.0)
    assert 0 < np.abs(difference).max() < RenderSettings().agreement


# looks at every place that is in some voxel
EVERY = RenderSettings(probe=1, longest=1, agreement=0.0, brief=False)


def test_skipping_empty_space_changes_next_to_nothing(toy_avatar, pose):
    skipped = picture(toy_avatar, pose, settings=EVERY)
    walked = picture(toy_avatar, pose, settings=dataclasses.replace(EVERY, skip=False))
    assert psnr(over(skipped.rgba, 1.0), over(walked.rgba, 1.0)) > 50
    assert np.abs(skipped.rgba[..., 3] - walked.rgba[..., 3]).max() < 0.02


def test_looking_at_the_middles_of_runs_changes_little(toy_avatar, pose):
    usual, every = picture(toy_avatar, pose), picture(toy_avatar, pose, settings=EVERY)
    assert psnr(over(usual.rgba, 1.0), over(every.rgba, 1.0)) > 46
    # no more than a run may add where it is not taken apart
    assert np.abs(usual.rgba[..., 3] - every.rgba[..., 3]).max() <= RenderSettings().tolerance
    blind = picture(toy_avatar, pose, settings=RenderSettings(tolerance=1.0))
    assert psnr(over(blind.rgba, 1.0), over(every.rgba, 1.0)) < psnr(
        over(usual.rgba, 1.0), over(every.rgba, 1.0)
    )


def test_what_thin_places_add_changes_little(toy_avatar, pose):
    thin = picture(toy_avatar, pose, settings=RenderSettings(probe=1))
    every = picture(toy_avatar, pose, settings=EVERY)
    assert not np.array_equal(thin.rgba, every.rgba)
    assert psnr(over(thin.rgba, 1.0), over(every.rgba, 1.0)) > 48


def test_compiled_rays_are_those_that_go_step_by_step(toy_avatar, pose, monkeypatch):
    whole = picture(toy_avatar, pose, settings=EVERY)
    monkeypatch.setattr(rendering, "_whole", rendering._by_waves)
    steps = picture(toy_avatar, pose, settings=EVERY)
    assert np.abs(over(whole.rgba, 1.0) - over(steps.rgba, 1.0)).max() < 2e-3
    seen = np.isfinite(steps.depth) & (steps.rgba[..., 3] > 0.5)
    np.testing.assert_allclose(whole.depth[seen], steps.depth[seen], atol=1e-4)


def test_ending_opaque_rays_changes_next_to_nothing(toy_avatar, pose):
    ended = picture(toy_avatar, pose, settings=RenderSettings())
    whole = picture(toy_avatar, pose, settings=RenderSettings(transmittance=0.0))
    assert psnr(over(ended.rgba, 1.0), over(whole.rgba, 1.0)) > 50


def test_leaving_out_what_hardly_shows_changes_next_to_nothing(toy_avatar, pose):
    usual = picture(toy_avatar, pose)
    every = picture(toy_avatar, pose, settings=RenderSettings(negligible=0.0))
    assert not np.array_equal(usual.rgba, every.rgba)
    assert psnr(over(usual.rgba, 1.0), over(every.rgba, 1.0)) > 50


def test_waves_and_chunks_do_not_show(toy_avatar, pose):
    usual = picture(toy_avatar, pose)
    chunks = picture(toy_avatar, pose, settings=RenderSettings(chunk=1000))
    assert np.abs(over(usual.rgba, 1.0) - over(chunks.rgba, 1.0)).max() < 2e-3
    # where a wave ends, places that would go together are parted
    waves = picture(toy_avatar, pose, settings=RenderSettings(wave=8))
    assert psnr(over(usual.rgba, 1.0), over(waves.rgba, 1.0)) > 46
    # a ray ends where a wave does: with little left of it, it does not matter where
    far = dataclasses.replace(EVERY, transmittance=1e-3)
    alone = [picture(toy_avatar, pose, settings=dataclasses.replace(far, wave=w)) for w in (3, 9)]
    assert np.abs(over(alone[0].rgba, 1.0) - over(alone[1].rgba, 1.0)).max() < 2e-3


def test_a_picture_may_be_asked_for_only_by_its_thread(toy_avatar, pose):
    import threading

    asked = set()

    def ask(*_):
        asked.add(threading.get_ident())
        return False

    settings = RenderSettings(chunk=256)
    picture(toy_avatar, pose, settings=settings, should_stop=ask, progress=ask)
    assert asked == {threading.get_ident()}


def test_finer_steps_come_closer_to_the_dense_reference(toy_avatar, pose):
    small = {"camera": pose["camera"].resized(32, 32)}
    dense = picture(toy_avatar, pose | small, settings=RenderSettings(step=2.5e-4))
    errors = []
    for step in (4e-3, 2e-3, 1e-3):
        coarse = picture(toy_avatar, pose | small, settings=RenderSettings(step=step))
        # the colour of what is next to transparent says nothing
        errors.append(psnr(over(coarse.rgba, 1.0), over(dense.rgba, 1.0)))
    assert errors == sorted(errors)
    assert errors[-1] > 35


def test_the_same_input_gives_the_same_bits(toy_avatar, pose):
    a, b = picture(toy_avatar, pose), picture(toy_avatar, pose)
    np.testing.assert_array_equal(a.rgba, b.rgba)


def test_blends_lie_between_their_appearances(toy_avatar, pose):
    half = picture(toy_avatar, pose, {"plain": 1.0, "bushy": 1.0})
    ends = [picture(toy_avatar, pose, name) for name in ("plain", "bushy")]
    assert psnr(ends[0].rgba, ends[1].rgba) < 30
    for end in ends:
        assert psnr(half.rgba, end.rgba) < 60
    alone = picture(toy_avatar, pose, {"bushy": 3.0})
    np.testing.assert_allclose(alone.rgba, ends[1].rgba, atol=1e-5)


def test_moving_everything_moves_nothing_in_the_picture(toy_avatar, pose):
    """Head and camera turned and carried off together: the same picture."""
    shown = picture(toy_avatar, pose)
    angle = 0.7
    turn = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    shift = np.array([0.5, -0.2, 0.3])
    to_world = np.eye(4)
    to_world[:3, :3], to_world[:3, 3] = turn, shift
    camera = pose["camera"]
    moved = {
        "vertices": (pose["vertices"] @ turn.T + shift).astype(np.float32),
        "camera": dataclasses.replace(camera, camera_to_world=to_world @ camera.camera_to_world),
    }
    again = picture(toy_avatar, pose | moved)
    assert psnr(over(again.rgba, 1.0), over(shown.rgba, 1.0)) > 45


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"vertices": np.zeros((3, 3))}, "3 vertices"),
        ({"vertices": None}, "not finite"),
        ({"expression": np.zeros(3)}, "expression"),
        ({"expression": np.full(52, np.nan)}, "expression 'browDownLeft' is nan"),
        ({"expression": np.full(52, 3e38)}, "expression 'browDownLeft' is 3e.38"),
        ({"appearance": "bald"}, "unknown appearance 'bald'"),
        ({"appearance": {"plain": -1.0}}, "weights"),
        ({"appearance": {}}, "weights"),
    ],
)
def test_what_does_not_fit_is_told(toy_avatar, pose, change, words):
    if "vertices" in change and change["vertices"] is None:
        change = {"vertices": np.full_like(pose["vertices"], np.nan)}
    with pytest.raises(InputError, match=words):
        picture(toy_avatar, pose, **change)


def test_rendering_can_be_stopped_and_watched(toy_avatar, pose):
    seen = []
    picture(toy_avatar, pose, settings=RenderSettings(chunk=1024), progress=seen.append)
    assert seen == sorted(seen)
    assert seen[-1] == 1
    with pytest.raises(Cancelled):
        picture(toy_avatar, pose, should_stop=lambda: True)


def test_a_camera_that_sees_nothing_gives_an_empty_picture(toy_avatar, pose):
    away = pose["camera"].camera_to_world.copy()
    away[:3, :3] = away[:3, :3] @ np.diag([-1.0, 1, -1])
    camera = dataclasses.replace(pose["camera"], camera_to_world=away)
    shown = picture(toy_avatar, pose, camera=camera)
    assert not shown.rgba.any()


def cut_by_plane(avatar, pose, limit, step=1e-3):
    """The quadrature over whole rays, of which only samples nearer than `limit` are kept: RGBA
    before black [H, W, 4]."""
    import torch

    from pav_blender.core import kernels
    from pav_blender.core.rendering.rays import camera_rays, pack, samples_of

    camera, ops = pose["camera"], kernels.select("cpu").marching
    with torch.inference_mode():
        scene = rendering.pose_scene(avatar, pose["vertices"], "plain", pose["expression"])
        pixels = np.arange(camera.width * camera.height)
        rays = camera_rays(camera, pixels % camera.width, pixels // camera.width)
        half, reach = torch.full((len(rays),), 0.5), avatar.config.reach
        around = ops.bounds(scene.mesh.vertices, reach, rays.origins, rays.directions)
        first, last = ops.lattice(*around, half, step)
        wave = ops.march(scene.mesh, rays.origins, rays.directions, first, last, half, step,
                         wave=600, clearance=scene.clearance, band=reach)  # fmt: skip
        packed, _ = pack(wave, half, step)
        samples = samples_of(packed, scene.clearance, 0, scene.condition, rays, scene.stance)
        sigma, rgb = avatar.field(samples, scene.wearing.worn)
        along = packed.t * rays.cosine[packed.ray.long()]
        sigma = torch.where(
            along <= torch.from_numpy(limit).reshape(-1)[packed.ray.long()], sigma, 0
        )
        colour, opacity, _, _ = kernels.select("cpu", reference=True).marching.composite(
            sigma, rgb, packed.t, step, packed.ray, len(rays)
        )
    found = torch.cat([colour, opacity[:, None]], 1).numpy()
    return found.reshape(camera.height, camera.width, 4)


@pytest.mark.parametrize("stepwise", [False, True])
def test_a_limit_cuts_the_avatar_as_a_plane_does(toy_avatar, pose, stepwise, monkeypatch):
    small = pose | {"camera": pose["camera"].resized(32, 32)}
    scene = rendering.pose_scene(toy_avatar, pose["vertices"], "plain", pose["expression"])
    if stepwise:
        monkeypatch.setattr(rendering, "_whole", rendering._by_waves)
    whole = rendering.render_scene(scene, small["camera"], EVERY)
    # slanted, through the middle of the face
    limit = np.float32(np.nanmedian(whole.depth[np.isfinite(whole.depth)]))
    limit = limit + np.linspace(-0.04, 0.04, 32, dtype=np.float32)[None].repeat(32, 0)
    cut = rendering.render_scene(scene, small["camera"], EVERY, limit=limit)
    expected = cut_by_plane(toy_avatar, small, limit)
    black = cut.rgba[..., :3] * cut.rgba[..., 3:]
    assert psnr(black, expected[..., :3]) > 46
    assert np.abs(cut.rgba[..., 3] - expected[..., 3]).max() < 0.03
    seen = np.isfinite(cut.depth)
    assert (cut.depth[seen] <= limit[seen]).all()
    assert 0.2 < seen.sum() / np.isfinite(whole.depth).sum() < 0.9
    assert cut.evaluations < whole.evaluations


def test_a_limit_beyond_everything_changes_nothing_and_one_of_zero_leaves_nothing(toy_avatar, pose):
    scene = rendering.pose_scene(toy_avatar, pose["vertices"], "plain", pose["expression"])
    whole = picture(toy_avatar, pose)
    far = rendering.render_scene(scene, pose["camera"], limit=np.full((64, 64), np.inf))
    np.testing.assert_array_equal(far.rgba, whole.rgba)
    none = rendering.render_scene(scene, pose["camera"], limit=np.zeros((64, 64)))
    assert not none.rgba.any()
    assert none.evaluations == 0


def test_a_parallel_camera_is_a_pinhole_infinitely_far_away(toy_avatar, pose):
    near = pose["camera"]
    focal = near.intrinsics[0, 0] / 0.75  # pixels a metre where the face is
    back, centre = near.camera_to_world[:3, 2], near.camera_to_world[:3, 3]
    away = 200.0
    far = near.camera_to_world.copy()
    far[:3, 3] = centre - (away - 0.75) * back
    scale = np.array([[focal * away], [focal * away], [1]])
    pinhole = dataclasses.replace(
        near,
        camera_to_world=far,
        intrinsics=np.hstack([np.diag(scale[:, 0])[:, :2], near.intrinsics[:, 2:]]),
    )
    parallel = dataclasses.replace(
        near,
        parallel=True,
        intrinsics=np.hstack([np.diag([focal, focal, 1])[:, :2], near.intrinsics[:, 2:]]),
    )
    one, other = (picture(toy_avatar, pose, camera=c) for c in (pinhole, parallel))
    assert (other.rgba[..., 3] > 0.9).mean() > 0.1
    assert psnr(over(one.rgba, 1.0), over(other.rgba, 1.0)) > 35
    seen = np.isfinite(one.depth) & np.isfinite(other.depth) & (other.rgba[..., 3] > 0.9)
    assert np.median(np.abs(one.depth[seen] - (away - 0.75) - other.depth[seen])) < 1e-3


@pytest.mark.parametrize("unit", [1e-3, 0.0, 10.0, 1e4])
def test_vertices_that_are_not_metres_are_told(toy_avatar, pose, unit):
    """They would be a speck, or take all memory there is."""
    with pytest.raises(InputError, match=r"m across.*vertices are metres"):
        picture(toy_avatar, pose, vertices=pose["vertices"] * unit)


def test_vertices_of_no_triangle_may_lie_anywhere(toy_avatar, pose):
    from pav_blender.core.deformation import Deformer

    canonical = np.concatenate([toy_avatar.canonical_vertices, np.zeros((2, 3), np.float32)])
    posed = np.concatenate([pose["vertices"], np.full((2, 3), 1e6, np.float32)])
    deformer = Deformer(canonical, toy_avatar.triangles, "smooth")
    assert deformer.referenced.sum() == len(pose["vertices"])
    assert deformer.pose(posed).vertices.abs().max() < 10
    assert posed[-1, 0] == 1e6


def test_far_from_the_origin_and_from_the_camera_is_as_near(toy_avatar, pose):
    usual = picture(toy_avatar, pose)
    shift = np.array([1e6, 2e6, -3e6])
    away = picture(
        toy_avatar,
        pose,
        vertices=pose["vertices"].astype(np.float64) + shift,
        camera=pose["camera"].moved(shift),
    )
    np.testing.assert_allclose(away.rgba, usual.rgba, atol=2e-3)
    back, pictures = pose["camera"].camera_to_world[:3, 2], []
    for distance in (1e5, 1e7):
        longer = pose["camera"].intrinsics.copy()
        longer[[0, 1], [0, 1]] *= (distance + 0.75) / 0.75
        camera = dataclasses.replace(pose["camera"].moved(-distance * back), intrinsics=longer)
        pictures.append(picture(toy_avatar, pose, camera=camera))
    assert (pictures[0].rgba[..., 3] > 0.9).mean() > 0.1
    assert psnr(over(pictures[0].rgba, 1.0), over(pictures[1].rgba, 1.0)) > 50
    seen = pictures[0].rgba[..., 3] > 0.9
    assert np.abs(pictures[0].depth[seen] - 1e5 - 0.75).max() < 0.3


def test_a_limit_is_where_it_says_however_far_the_camera(toy_avatar, pose):
    scene = rendering.pose_scene(toy_avatar, pose["vertices"], "plain", pose["expression"])
    longer = pose["camera"].intrinsics.copy()
    longer[[0, 1], [0, 1]] *= 1000.75 / 0.75
    back = pose["camera"].camera_to_world[:3, 2]
    camera = dataclasses.replace(pose["camera"].moved(-1000 * back), intrinsics=longer)
    whole = rendering.render_scene(scene, camera)
    middle = np.float32(np.median(whole.depth[np.isfinite(whole.depth)]))
    cut = rendering.render_scene(scene, camera, limit=np.full((64, 64), middle))
    seen = np.isfinite(cut.depth)
    assert (cut.depth[seen] <= middle + 1e-3).all()
    assert 0.1 < seen.sum() / np.isfinite(whole.depth).sum() < 0.95


def test_limits_that_do_not_fit_are_told(toy_avatar, pose):
    scene = rendering.pose_scene(toy_avatar, pose["vertices"], "plain", pose["expression"])
    with pytest.raises(InputError, match=r"limit: .*the picture is"):
        rendering.render_scene(scene, pose["camera"], limit=np.zeros((64, 63)))
    with pytest.raises(InputError, match=r"limit: .*not a number"):
        rendering.render_scene(scene, pose["camera"], limit=np.full((64, 64), np.nan))


@pytest.mark.parametrize(
    "change",
    [
        {"step": 0.0}, {"step": -1.0}, {"step": np.nan}, {"step": 1.0}, {"step": 1e-9},
        {"transmittance": np.nan}, {"tolerance": -0.1}, {"share": np.inf}, {"wave": 0},
        {"chunk": 0}, {"probe": 0}, {"longest": -3}, {"negligible": np.nan},
    ],
)  # fmt: skip
def test_settings_that_cannot_be_are_told(change):
    with pytest.raises(InputError, match=next(iter(change))):
        RenderSettings(**change)


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (4, 4), (17, 9), (64, 64), (5, 1)])
def test_tiles_hold_every_pixel_once_and_neighbours_together(size):
    from pav_blender.core.rendering.rays import tiled

    width, height = size
    order = tiled(width, height)
    assert sorted(order.tolist()) == list(range(width * height))
    row, column = np.divmod(order, width)
    for start in range(0, len(order), 16):  # a packet
        part = slice(start, start + 16)
        spread = np.ptp(row[part]) + np.ptp(column[part])
        assert spread <= 6 or min(size) < 4 or max(size) % 4
