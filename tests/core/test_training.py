import dataclasses
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch

from pav_blender.core import kernels
from pav_blender.core.collection import read_collection
from pav_blender.core.errors import Cancelled, InputError
from pav_blender.core.evaluation.heldout import held_out, score
from pav_blender.core.evaluation.report import figures, measure
from pav_blender.core.field.avatar import Avatar
from pav_blender.core.field.field import Field
from pav_blender.core.rendering.rays import RayBatch, pack, still_of
from pav_blender.core.rendering.render import RenderSettings, pose_scene
from pav_blender.core.training.attention import Attention
from pav_blender.core.training.batches import draw_pixels, pick_samples
from pav_blender.core.training.frames import halved
from pav_blender.core.training.losses import distortion, losses
from pav_blender.core.training.places import checkpoint_path
from pav_blender.core.training.prepare import load_training_frames, new_avatar
from pav_blender.core.training.train import train
from pav_blender.core.training.trainer import Trainer


@pytest.fixture(scope="module")
def frames(toy):
    return load_training_frames(toy)


def test_only_training_frames_are_read(frames, toy):
    assert [f.name for f in frames if f.appearance == 0] == [f"plain/{i:06d}" for i in range(6)]
    assert len(frames) == 12


def test_depth_targets_are_the_tracked_face_and_nothing_else(frames, toy):
    frame = frames[3]
    target = frame.depth > 0
    assert 50 < target.sum() < frame.depth.size / 3
    pixels, depth = frame.camera.project(frame.vertices[toy.head.regions["face"]])
    assert depth.min() - 0.01 < frame.depth[target].min()
    rows = np.argwhere(target)
    assert (rows.min(0) + 1 >= np.floor(pixels.min(0))[::-1]).all()
    assert (rows.max(0) - 1 <= np.ceil(pixels.max(0))[::-1]).all()


def test_rays_are_led_to_where_they_were_wrong(frames):
    frame, random, attention = frames[3], np.random.default_rng(0), Attention()
    assert len(np.unique(attention.draw(frame, 4000, random))) > 0.95 * len(frame.tiles)
    wrong = len(frame.tiles) // 2
    tile = np.arange(len(frame.tiles)).repeat(16)
    squared = np.where(tile == wrong, 1.0, 1e-5)
    attention.note([frame], [0], tile, squared)
    assert (attention.draw(frame, 1000, random) == wrong).mean() > 0.9
    pixels = draw_pixels([frame], 4096, random, attention)
    assert 0.35 < (pixels.tile == wrong).mean() < 0.5
    assert len(np.unique(pixels.tile)) > 50  # nothing starves
    columns, rows = frame.camera.project(
        (pixels.rays.origins + pixels.rays.directions).numpy().astype(float)
    )[0].T
    there = pixels.tile == wrong
    assert (np.floor(rows[there] / 4) == frame.tiles[wrong][0]).all()
    assert (np.floor(columns[there] / 4) == frame.tiles[wrong][1]).all()
    again = Attention()
    again.restore(attention.state())
    np.testing.assert_array_equal(again.of(frame), attention.of(frame))


def test_of_long_clips_some_frames_are_in_use_and_others_follow(
    toy, frames, small_config, monkeypatch
):
    """To pose a frame takes as long as to learn from it."""
    from pav_blender.core.training import trainer as module

    monkeypatch.setattr(module, "KEPT_POSES", 4)
    trainer = Trainer(new_avatar(toy, frames, small_config), frames)
    drawn = [[f.name for f in trainer._choose_frames()] for _ in range(400)]
    for batch in drawn:
        assert len({name.split("/")[0] for name in batch}) == 2  # every appearance, every time
    names = [name for batch in drawn for name in batch]
    assert {f.name for f in frames} == set(names)  # each is used some time
    fresh, recent = 0, []
    for name in names:
        fresh += name not in recent
        recent = [*recent, name][-40:]
    assert fresh < 0.2 * len(names)


def test_the_hull_holds_the_surface_and_leaves_out_what_no_matte_shows(toy, frames, small_config):
    """The second appearance's scalp stands out: its hull must hold it, the first's need not."""
    avatar = new_avatar(toy, frames, small_config)
    cells = small_config.occupancy_resolution

    def filled(which, points):
        at = ((points - avatar.box_min) / avatar.box_size * cells).astype(int)
        inside = ((at >= 0) & (at < cells)).all(1)
        return avatar.occupied[which][tuple(at[inside].T)].mean()

    face = toy.head.canonical(toy.betas)[toy.head.regions["face"]]
    assert filled(0, face) > 0.99
    assert filled(1, face) > 0.99
    assert filled(0, face + np.array([0, 0, 0.06])) < 0.1
    assert 0.02 < avatar.occupied[0].mean() < 0.4
    assert avatar.occupied[1].sum() > avatar.occupied[0].sum()


def test_batches_hold_what_the_pictures_hold(frames):
    pixels = draw_pixels(frames[:3], 512, np.random.default_rng(0))
    assert len(pixels.rays) == len(pixels.alpha) == len(pixels.frame)
    index = 7
    frame = frames[int(pixels.frame[index])]
    points = frame.camera.origin + pixels.rays.directions[index : index + 1].numpy()
    (x, y), _ = frame.camera.project(points)[0][0], None
    expected = frame.rgba[int(y), int(x)] / 255
    np.testing.assert_allclose(pixels.colour[index].numpy(), expected[:3], atol=1e-6)
    np.testing.assert_allclose(float(pixels.alpha[index]), expected[3], atol=1e-6)


def test_the_loss_is_zero_for_the_truth_and_weighs_as_the_paper_says(frames, small_config):
    pixels = draw_pixels(frames[:3], 512, np.random.default_rng(0))
    alpha = pixels.alpha[:, None]
    background = torch.rand(len(alpha), 3)
    distance = pixels.depth / pixels.rays.cosine
    truth = (pixels.colour * alpha, pixels.alpha, distance)
    every = torch.ones(len(alpha), dtype=torch.bool)
    assert float(losses(small_config, pixels, background, *truth, every).total) == pytest.approx(
        0, abs=1e-6
    )
    off = losses(small_config, pixels, background, truth[0] + 0.1, *truth[1:], every)
    assert float(off.total) == pytest.approx(50 * 0.01, rel=1e-3)
    away = distance + 0.1 / pixels.rays.cosine
    far = losses(small_config, pixels, background, *truth[:2], away, every)
    face = float((pixels.depth > 0).float().mean())
    assert face > 0.05
    assert float(far.total) == pytest.approx(10 * 0.1 * face, rel=1e-3)
    none = losses(small_config, pixels, background, truth[0] + 0.1, *truth[1:], ~every)
    assert float(none.total) == 0


def test_a_halved_frame_is_the_mean_of_its_pixels_under_the_same_camera(frames):
    frame = next(f for f in frames if 0 < f.rgba[..., 3].mean() < 255)
    small = halved(frame)
    height, width = small.rgba.shape[:2]
    assert (height, width) == tuple(size // 2 for size in frame.rgba.shape[:2])
    assert (small.camera.width, small.camera.height) == (width, height)
    alpha = frame.rgba[:2, :2, 3].astype(float).sum() / 4
    assert abs(float(small.rgba[0, 0, 3]) - alpha) <= 0.5
    solid = np.argwhere(small.rgba[..., 3] == 255)[0]
    square = frame.rgba[2 * solid[0] : 2 * solid[0] + 2, 2 * solid[1] : 2 * solid[1] + 2, :3]
    np.testing.assert_allclose(small.rgba[tuple(solid)][:3], square.mean((0, 1)), atol=0.51)
    point = frame.vertices[:1]
    large, _ = frame.camera.project(point)
    np.testing.assert_allclose(small.camera.project(point)[0], large / 2, atol=1e-9)


def test_training_sees_a_frame_as_rendering_does(toy, frames, small_config):
    avatar = new_avatar(toy, frames, small_config)
    trainer = Trainer(avatar, frames)
    frame = frames[3]
    pixels = draw_pixels([frame], 512, np.random.default_rng(0))
    picked = pick_samples(
        trainer._poses, pixels, trainer.visibility, small_config, 2e-3, trainer.generator
    )
    name = avatar.appearances[frame.appearance]
    scene = pose_scene(avatar, frame.vertices, name, frame.expression)
    assert scene.condition[-3:].abs().max() > 0.01  # the head is turned
    torch.testing.assert_close(picked.samples.condition[0], scene.condition)
    ray = picked.samples.ray.long()
    points = pixels.rays.origins[ray] + picked.t[:, None] * pixels.rays.directions[ray]
    still = (scene.stance.still(points) - scene.clearance.box_min) * scene.clearance.box_scale
    torch.testing.assert_close(picked.samples.still, still, rtol=0, atol=1e-5)
    assert (still - picked.samples.canonical).abs().max() > 0.01  # they differ in the head
    seen = pixels.rays.directions @ torch.from_numpy(scene.stance.rotation)
    torch.testing.assert_close(picked.samples.direction, seen)
    assert torch.equal(picked.samples.appearance.unique(), torch.tensor([frame.appearance]).int())


def test_small_pictures_come_first(toy, frames, small_config):
    trainer = Trainer(new_avatar(toy, frames, small_config), frames)
    full = frames[0].rgba.shape[0]
    sizes = []
    for done in (0.0, 0.3, 0.9):
        trainer.status.iteration = int(done * small_config.iterations)
        sizes.append(trainer._choose_frames()[0].rgba.shape[0])
    assert sizes == [full // 4, full // 2, full]


def test_rays_ended_by_mistake_teach_nothing(toy, frames, small_config):
    """A guide that is opaque everywhere, a field that is thin everywhere: no weight may move."""
    config = dataclasses.replace(small_config, start_on_mesh=False)
    trainer = Trainer(new_avatar(toy, frames, config), frames)
    before = {k: v.clone() for k, v in trainer.avatar.field.state_dict().items()}
    trainer.visibility.guide.fill_(1e9)
    trainer.iterate()
    for name, value in trainer.avatar.field.state_dict().items():
        assert torch.equal(value, before[name]), name
    trainer.visibility.guide.fill_(1e-3)  # nor is that because there was nothing to learn
    trainer.iterate()
    after = trainer.avatar.field.state_dict()
    assert not torch.equal(after["tables"], before["tables"])


def test_training_learns_the_person_and_tells_the_appearances_apart(toy, toy_avatar):
    measured = measure(toy_avatar, toy, 2)
    numbers = figures(measured)
    assert numbers["psnr"]["head_mean"] > 18, numbers
    for name, own in numbers["psnr"]["picture"].items():
        assert own > max(numbers["switch_psnr"][name].values()) + 2, numbers
    assert toy_avatar.record["iterations"] == 250


def test_space_is_emptied_while_learning(toy, frames, toy_avatar, small_config):
    before = new_avatar(toy, frames, small_config).occupied.mean()
    # what lies beyond the pictures is neither looked at nor emptied
    assert 0.3 * before < toy_avatar.occupied.mean() < 0.99 * before


def test_a_longer_training_empties_space_no_oftener(toy, frames, small_config):
    """Each emptying may take cells that only poses not drawn of late show."""
    times = []
    for iterations in (2_000, 4_000, 40_000):
        config = dataclasses.replace(small_config, iterations=iterations)
        status = (trainer := Trainer(new_avatar(toy, frames, config), frames)).status
        count = 0
        for status.iteration in range(1, iterations + 1):
            if trainer._prunes_now():
                count, status.pruned = count + 1, status.iteration
        times.append(count)
    assert 15 < times[0] <= times[1] == times[2] < 40


def test_the_same_seed_gives_the_same_weights(toy, small_config, tmp_path):
    config = dataclasses.replace(small_config, iterations=6)
    states = []
    for name in ("a", "b"):
        avatar = train(toy, tmp_path / f"{name}.pav", config)
        states.append(avatar.field.state_dict())
    for key, value in states[0].items():
        assert torch.equal(value, states[1][key]), key


def test_a_stopped_training_goes_on_to_the_same_weights(toy, small_config, tmp_path):
    config = dataclasses.replace(small_config, iterations=8)
    whole = train(toy, tmp_path / "whole.pav", config)
    calls = iter(range(100))
    with pytest.raises(Cancelled, match="--resume"):
        train(toy, tmp_path / "b.pav", config, should_stop=lambda: next(calls) == 3)
    assert checkpoint_path(tmp_path / "b.pav").is_file()
    assert not (tmp_path / "b.pav").exists()
    resumed = train(toy, tmp_path / "b.pav", config, resume=True)
    assert not checkpoint_path(tmp_path / "b.pav").exists()
    for key, value in whole.field.state_dict().items():
        torch.testing.assert_close(resumed.field.state_dict()[key], value, msg=key)


def test_checkpoints_of_something_else_are_refused(toy, small_config, tmp_path):
    config = dataclasses.replace(small_config, iterations=8)
    with pytest.raises(Cancelled):
        train(toy, tmp_path / "b.pav", config, should_stop=lambda: True)
    other = dataclasses.replace(config, hidden=32)
    with pytest.raises(InputError, match="other settings"):
        train(toy, tmp_path / "b.pav", other, resume=True)
    path = checkpoint_path(tmp_path / "b.pav")
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match="damaged"):
        train(toy, tmp_path / "b.pav", config, resume=True)


def test_a_killed_training_leaves_no_avatar_and_a_signalled_one_a_checkpoint(toy_path, tmp_path):
    command = [sys.executable, "-m", "pav_blender", "train", str(toy_path), "--json-progress"]
    for kind, code in ((signal.SIGTERM, 1), (signal.SIGKILL, -9)):
        out = tmp_path / f"{kind.name}.pav"
        child = subprocess.Popen([*command, "--out", str(out)], stderr=subprocess.PIPE, text=True)
        for line in child.stderr:
            if '"train"' in line:
                break
        time.sleep(0.5)
        child.send_signal(kind)
        rest = child.stderr.read()
        assert child.wait(timeout=60) == code
        assert not out.exists()
        if kind is signal.SIGTERM:
            assert checkpoint_path(out).is_file()
            assert "Traceback" not in rest
    assert sorted(p.suffix for p in tmp_path.iterdir() if ".partial-" not in p.name) == [
        ".checkpoint"
    ]


def test_an_appearance_without_pictures_is_told(toy_path, small_config, tmp_path):
    copy = shutil.copytree(toy_path, tmp_path / "copy")
    path = copy / "clips" / "bushy" / "frames.npz"
    with np.load(path) as stored:
        arrays = dict(stored)
    arrays["split"] = np.full(8, "test")
    np.savez(path, **arrays)
    with pytest.raises(InputError, match="bushy"):
        train(read_collection(copy), tmp_path / "a.pav", small_config)
    assert not (tmp_path / "a.pav").exists()


def test_bad_batches_do_not_harm(toy, frames, small_config):
    """Frames without an opaque pixel, saturated or noisy ones: the weights stay finite."""
    random = np.random.default_rng(0)
    hostile = []
    for which, frame in enumerate(frames[:3] + frames[-3:]):
        rgba = [
            np.zeros_like(frame.rgba),
            np.full_like(frame.rgba, 255),
            random.integers(0, 256, frame.rgba.shape, np.uint8),
        ][which % 3]
        hostile.append(dataclasses.replace(frame, rgba=rgba))
    trainer = Trainer(new_avatar(toy, frames, small_config), hostile)
    for _ in range(10):
        trainer.iterate()
    for name, value in trainer.avatar.field.state_dict().items():
        assert torch.isfinite(value).all(), name


def test_the_paper_preset_trains(toy, small_config, tmp_path):
    from pav_blender.core.config import Config

    small = {
        name: getattr(small_config, name)
        for name in ("log2_entries", "levels", "occupancy_resolution", "rays", "step")
    }
    config = dataclasses.replace(Config.paper(), iterations=5, **small)
    avatar = train(toy, tmp_path / "a.pav", config)
    assert Avatar.load(tmp_path / "a.pav").config.frames == "rigid"
    assert np.isfinite(avatar.record["batch_psnr"])


def test_scores_compare_with_the_frames_own_picture(toy, toy_avatar):
    scores = held_out(toy_avatar, toy, per_appearance=1)
    assert [s.appearance for s in scores] == toy.appearances
    worn = score(toy_avatar, scores[0].frame, "bushy", RenderSettings())
    assert worn.psnr < scores[0].psnr


def test_one_pass_learns_what_network_by_network_does(toy, frames, small_config, monkeypatch):
    """The field's networks in one pass, and one by one through autograd: the same weights."""
    states = []
    for one_by_one in (False, True):
        if one_by_one:
            monkeypatch.setattr(Field, "forward", _network_by_network)
        trainer = Trainer(new_avatar(toy, frames, small_config), frames)
        for _ in range(4):
            trainer.iterate()
        states.append(trainer.avatar.field.state_dict())
    moved = new_avatar(toy, frames, small_config).field.state_dict()
    for name, value in states[0].items():
        if name in moved and value.numel():
            # Adam takes steps of one size: what is compared is whether they went the same way
            step = (value - moved[name]).abs().mean()
            assert (value - states[1][name]).abs().mean() <= 0.02 * step + 1e-9, name


def _network_by_network(field, samples, worn=None, encoded=None):
    density, inputs = field.geometry(samples, worn, encoded)
    return density, field.shade(inputs, samples.direction, samples.ray)


def test_a_batch_is_gathered_as_pictures_gather_it(toy, frames, small_config):
    """Where samples of training lie is what `pack` and `still_of` of pictures say."""
    trainer = Trainer(new_avatar(toy, frames, small_config), frames)
    chosen, packs = [frames[0], frames[-1]], []
    pick = kernels.select("cpu").picking.pick
    pixels = draw_pixels(chosen, 200, np.random.default_rng(0))

    def kept(*args, **settings):
        packs.append((args, pick(*args, **settings)))
        return packs[-1][1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels.select("cpu").picking, "pick", kept)
        generator = torch.Generator().manual_seed(0)
        state = trainer._poses, pixels, trainer.visibility, small_config, 2e-3, generator
        picked = pick_samples(*state)
    space, got = trainer.visibility.spaces[0], picked.samples
    at = 0
    for number, (args, picks) in enumerate(packs):
        origins, directions, jitter = args[3], args[4], args[7]
        packed, slots = pack(picks, jitter, 2e-3)
        own = slice(at, at + len(packed))
        frame = pixels.frames[number]
        posed = trainer._poses(frame, space, trainer.visibility.version, small_config.reach)
        rays = RayBatch(origins, directions, torch.ones(len(origins)))
        wanted = {
            "canonical": (packed.canonical - space.box_min) * space.box_scale,
            "still": still_of(packed, space, rays, posed.stance),
            "triangle": packed.triangle,
            "barycentric": packed.barycentric,
            "distance": packed.distance,
            "ray": packed.ray + pixels.starts[number],
            "frame": torch.full((len(packed),), number, dtype=torch.int32),
            "appearance": torch.full((len(packed),), frame.appearance, dtype=torch.int32),
        }
        for name, value in wanted.items():
            torch.testing.assert_close(getattr(got, name)[own], value, rtol=1e-5, atol=2e-6)
        torch.testing.assert_close(picked.t[own], packed.t)
        torch.testing.assert_close(picked.width[own], picks.steps.view(-1)[slots] * 2e-3)
        cell = (got.canonical[own] * len(space.grid)).long()
        size = len(space.grid)
        flat = ((frame.appearance * size + cell[:, 0]) * size + cell[:, 1]) * size + cell[:, 2]
        assert torch.equal(picked.cells[own], flat)
        at += len(packed)
    assert at == len(picked.t) > 500


def test_cells_are_watched_as_the_samples_say(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    count = 2000
    cells = torch.randint(0, 300, (count,), generator=generator)
    density = torch.rand(count, generator=generator) ** 8 * 3e3
    density[:50] = 0
    width = torch.rand(count, generator=generator) * 3e-3 + 1e-3
    alpha = -torch.expm1(-density * width)
    light = torch.rand(count, generator=generator)
    weights = light * alpha
    most, looks = torch.rand(300, generator=generator) * 0.01, torch.ones(300)
    wanted = most.clone().scatter_reduce_(0, cells, weights / (1e3 * width), "amax")
    seen = (light > 0.1) | (alpha <= 1e-6)
    counted = looks.clone().index_add_(0, cells[seen], torch.ones(int(seen.sum())))
    monkeypatch.setattr("pav_blender.core.kernels.cpu.batches.threads", lambda: 3)
    kernels.select("cpu").batches.watch(most, looks, cells, density, weights, width, 0.1)
    torch.testing.assert_close(most, wanted)
    assert float((looks - counted).abs().sum()) <= 2  # at the limit, rounding decides
    assert float(looks.sum()) > 1000


def test_distortion_is_the_sum_over_pairs_and_learns():
    generator = torch.Generator().manual_seed(0)
    ray = torch.tensor([0, 0, 0, 2, 2, 2, 2, 3], dtype=torch.int32)  # ray 1 has no sample
    t = torch.rand(8, generator=generator, dtype=torch.float64).cumsum(0)
    weights = torch.rand(8, generator=generator, dtype=torch.float64, requires_grad=True)
    want = sum(
        weights[i] * weights[j] * (t[i] - t[j]).abs()
        for i in range(8)
        for j in range(8)
        if ray[i] == ray[j]
    )
    torch.testing.assert_close(distortion(weights, t, ray, 4), want / 4)
    assert torch.autograd.gradcheck(lambda w: distortion(w, t, ray, 4), (weights,))
    none = torch.zeros(0)
    assert distortion(none, none, none.int(), 3) == 0


def test_compiled_distortion_is_that_of_plain_torch():
    generator = torch.Generator().manual_seed(0)
    ray = torch.randint(0, 60, (500,), generator=generator).sort().values.int()
    t = torch.rand(500, generator=generator) * 0.1 + 0.5
    results = []
    for kind in (torch.float32, torch.float64):  # plain torch takes what is no float32
        weights = torch.rand(500, generator=generator.manual_seed(1)).to(kind).requires_grad_()
        value = distortion(weights, t.to(kind), ray, 64)
        (3 * value).backward()
        results.append((value.detach().double(), weights.grad.double()))
    for got, want in zip(*results, strict=True):
        torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-8)
