"""What a training survives: bad batches, spikes, weights that are lost, and 50,000 iterations."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from toy import make_toy

from pav_blender.core import kernels
from pav_blender.core.collection import read_collection
from pav_blender.core.config import Config
from pav_blender.core.errors import Cancelled, PavError
from pav_blender.core.training import train as module
from pav_blender.core.training.batches import draw_pixels, pick_samples
from pav_blender.core.training.checkpoint import load_checkpoint, save_checkpoint
from pav_blender.core.training.losses import distortion, losses
from pav_blender.core.training.places import checkpoint_path
from pav_blender.core.training.prepare import load_training_frames, new_avatar
from pav_blender.core.training.train import train
from pav_blender.core.training.trainer import Trainer
from pav_blender.core.training.watch import Watch

TINY = dataclasses.replace(
    Config(),
    levels=4,
    log2_entries=10,
    finest_resolution=64,
    shoulder_levels=2,
    hidden=16,
    latent_channels=4,
    occupancy_resolution=32,
    rays=64,
    frames_per_batch=2,
    step=6e-3,
    final_learning_rate=1.0,  # the rates never fall: what diverges has all the time to
)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return read_collection(make_toy(tmp_path_factory.mktemp("tiny") / "toy", frames=5, size=32))


@pytest.fixture(scope="module")
def tiny_frames(tiny):
    return load_training_frames(tiny)


def trainer_of(collection, frames, **changes):
    config = dataclasses.replace(TINY, **changes)
    return Trainer(new_avatar(collection, frames, config), frames)


def finite(trainer):
    return all(torch.isfinite(v).all() for v in trainer.avatar.field.state_dict().values())


# what is watched


def test_a_loss_that_falls_or_wavers_is_never_a_spike():
    random, watch = np.random.default_rng(0), Watch(floor=0.05)
    for step in range(5000):
        loss = 2 * math.exp(-step / 300) + 0.05 + random.gamma(2, 0.05)
        assert watch.takes(loss)
        assert not watch.astray


@pytest.mark.parametrize("spike", [math.nan, math.inf, -math.inf, 30.0])
def test_one_spike_is_left_out_and_changes_nothing(spike):
    watch = Watch(floor=0.05)
    for _ in range(100):
        watch.takes(0.2)
    before = watch.mean
    assert not watch.takes(spike)
    assert (watch.skipped, watch.mean, watch.astray) == (1, before, False)
    assert watch.takes(0.3)


def test_a_small_loss_is_no_spike_however_small_the_others_were():
    watch = Watch(floor=0.05)
    for _ in range(100):
        watch.takes(0.0)
    assert watch.takes(0.049)
    assert not watch.takes(0.2)


def test_spikes_in_a_row_and_a_mean_that_creeps_up_are_astray():
    watch = Watch(floor=0.05)
    for _ in range(100):
        watch.takes(0.2)
    for _ in range(19):
        assert not watch.takes(1e3)
    assert not watch.astray
    watch.takes(1e3)
    assert watch.astray
    watch.begin_anew()
    assert not watch.astray
    assert watch.takes(1e3)  # nothing is usual yet
    creeping, loss = Watch(floor=0.0), 0.2
    for _ in range(400):
        loss *= 1.02
        assert creeping.takes(loss)
        if creeping.astray:
            return
    pytest.fail("five hundred times the loss went unseen")


def test_what_is_watched_is_kept_over_an_interruption():
    watch, again = Watch(floor=0.05), Watch(floor=0.05)
    for loss in np.random.default_rng(0).uniform(0.1, 0.3, 80).tolist():
        watch.takes(loss)
    again.restore(watch.state())
    assert again == watch
    again.restore(Watch(floor=0.05).state())  # one without a lowest yet
    assert again.taken == 0


# what it is worth


def test_a_usual_training_is_what_it_was_without_a_watch(tiny, tiny_frames, monkeypatch):
    watched = trainer_of(tiny, tiny_frames, iterations=120)
    for _ in range(120):
        watched.iterate()
    assert watched.watch.skipped == 0
    assert watched.watch.taken == 120
    free = trainer_of(tiny, tiny_frames, iterations=120)
    monkeypatch.setattr(Watch, "takes", lambda self, loss: True)
    for _ in range(120):
        free.iterate()
    for name, value in watched.avatar.field.state_dict().items():
        assert torch.equal(value, free.avatar.field.state_dict()[name]), name
    assert watched.status.loss == free.status.loss


def spoilt(frame, kind, random):
    rgba = np.zeros_like(frame.rgba)
    if kind == "one pixel":
        rgba[rgba.shape[0] // 2, rgba.shape[1] // 2] = 255
    elif kind == "saturated":
        rgba[:] = 255
    elif kind == "noise":
        rgba = random.integers(0, 256, rgba.shape, np.uint8)
    return dataclasses.replace(frame, rgba=rgba, name=f"{kind} {frame.name}")


_ITERATIONS = 300


@pytest.fixture(scope="module")
def undisturbed(tiny, tiny_frames):
    """PSNR that training ends with where nothing is wrong."""
    trainer = trainer_of(tiny, tiny_frames, iterations=_ITERATIONS)
    for _ in range(_ITERATIONS):
        trainer.iterate()
    assert trainer.status.psnr > 13
    return trainer.status.psnr


@pytest.mark.parametrize("kind", ["background", "one pixel", "saturated", "noise"])
def test_training_recovers_from_bad_batches(tiny, tiny_frames, kind, undisturbed, monkeypatch):
    """Thirty in a row, a tenth of a short training at rates that never fall: most of what they cost
    is won back."""
    random = np.random.default_rng(0)
    trainer = trainer_of(tiny, tiny_frames, iterations=_ITERATIONS)
    choose = trainer._choose_frames

    def chosen():
        frames = choose()
        if 80 <= trainer.status.iteration < 110:
            return [spoilt(frame, kind, random) for frame in frames]
        return frames

    monkeypatch.setattr(trainer, "_choose_frames", chosen)
    for _ in range(_ITERATIONS):
        trainer.iterate()
    assert finite(trainer)
    assert trainer.sound()
    assert trainer.status.psnr > undisturbed - 3.0


def test_a_spike_in_training_teaches_nothing(tiny, tiny_frames, monkeypatch):
    trainer = trainer_of(tiny, tiny_frames, iterations=200)
    for _ in range(60):
        trainer.iterate()
    before = {k: v.clone() for k, v in trainer.avatar.field.state_dict().items()}
    known = trainer.status.loss
    from pav_blender.core.training import trainer as loop

    real = loop.losses
    for factor in (1e4, math.nan):
        with monkeypatch.context() as patch:
            patch.setattr(
                loop,
                "losses",
                lambda *a, factor=factor: dataclasses.replace(
                    (found := real(*a)), total=found.total * factor
                ),
            )
            trainer.iterate()
    for name, value in trainer.avatar.field.state_dict().items():
        assert torch.equal(value, before[name]), name
    assert (trainer.watch.skipped, trainer.status.loss) == (2, known)
    trainer.iterate()
    assert not torch.equal(trainer.avatar.field.tables, before["tables"])


def poisoned(monkeypatch, times, at=60, value=math.nan):
    """Weights that are lost at an iteration, so many times."""
    real, left = Trainer.iterate, [times]

    def iterate(self):
        if self.status.iteration == at and left[0]:
            left[0] -= 1
            with torch.no_grad():
                self.avatar.field.density.weights[0].fill_(value)
        return real(self)

    monkeypatch.setattr(Trainer, "iterate", iterate)


@pytest.mark.parametrize("value", [math.nan, 1e36])  # the latter overflows
def test_lost_weights_are_those_of_the_checkpoint_again(tiny, tmp_path, monkeypatch, value):
    poisoned(monkeypatch, 2, value=value)
    config = dataclasses.replace(TINY, iterations=150)
    avatar = train(tiny, tmp_path / "a.pav", config, checkpoint_every=0.0)
    assert avatar.record["returns"] == 2
    if math.isnan(value):
        assert avatar.record["skipped_batches"] == 2
    assert avatar.record["iterations"] == 150
    assert avatar.record["batch_psnr"] > 12
    assert all(torch.isfinite(v).all() for v in avatar.field.state_dict().values())
    assert not checkpoint_path(tmp_path / "a.pav").exists()


def test_what_goes_astray_again_and_again_is_told_and_leaves_its_checkpoint(
    tiny, tmp_path, monkeypatch
):
    poisoned(monkeypatch, 100)
    config = dataclasses.replace(TINY, iterations=150)
    with pytest.raises(PavError, match="for the 4th time: lower the learning rates"):
        train(tiny, tmp_path / "a.pav", config, checkpoint_every=0.0)
    assert not (tmp_path / "a.pav").exists()
    saved = checkpoint_path(tmp_path / "a.pav")
    trainer = trainer_of(tiny, load_training_frames(tiny), iterations=150)
    load_checkpoint(saved, trainer, module.fingerprint(tiny))
    assert trainer.sound()
    assert trainer.status.iteration <= 60


def test_astray_before_a_checkpoint_is_told(tiny, tmp_path, monkeypatch):
    poisoned(monkeypatch, 1, at=3)
    with pytest.raises(PavError, match="before there was a checkpoint"):
        train(tiny, tmp_path / "a.pav", dataclasses.replace(TINY, iterations=60))
    assert list(tmp_path.iterdir()) == []


def test_a_checkpoint_is_never_overwritten_by_what_is_lost(tiny, tiny_frames, tmp_path):
    trainer = trainer_of(tiny, tiny_frames, iterations=50)
    path = tmp_path / "a.checkpoint"
    assert save_checkpoint(path, trainer, "data")
    good = path.read_bytes()
    with torch.no_grad():
        trainer.avatar.field.latent.view(-1)[0] = math.inf
    assert not save_checkpoint(path, trainer, "data")
    assert path.read_bytes() == good
    with torch.no_grad():
        trainer.avatar.field.latent.view(-1)[0] = 0
    trainer.moments["tables"][1][0, 0] = math.nan
    assert not save_checkpoint(path, trainer, "data")
    trainer.moments["tables"][1][0, 0] = 0
    assert save_checkpoint(path, trainer, "data")


def test_stopped_when_it_is_lost_and_nothing_was_kept(tiny, tmp_path, monkeypatch):
    poisoned(monkeypatch, 1, at=0)
    calls = iter(range(100))
    with pytest.raises(Cancelled, match="nothing was kept"):
        train(
            tiny,
            tmp_path / "a.pav",
            dataclasses.replace(TINY, iterations=60),
            should_stop=lambda: next(calls) == 5,
        )
    assert list(tmp_path.iterdir()) == []


# gradients


def test_gradients_of_a_whole_batch_are_those_of_double_precision(tiny, tiny_frames):
    """Field, compositing and losses together, compiled in float32 against plain torch in float64,
    over the same samples."""
    trainer = trainer_of(tiny, tiny_frames, rays=512, step=3e-3)
    for _ in range(30):
        trainer.iterate()
    config, field = trainer.config, trainer.avatar.field
    random = np.random.default_rng(0)
    pixels = draw_pixels(tiny_frames[:2] + tiny_frames[-2:], 512, random)
    picked = pick_samples(
        trainer._poses, pixels, trainer.visibility, config, config.step, trainer.generator
    )
    background = torch.rand(len(pixels.rays), 3)
    counted = ~picked.ended

    def gradients(field, kind):
        field.zero_grad()
        samples = dataclasses.replace(
            picked.samples,
            **{
                name: getattr(picked.samples, name).to(kind)
                for name in (
                    "canonical", "still", "barycentric", "distance", "condition", "direction"
                )
            },
        )  # fmt: skip
        encoded = field.encode(samples).detach().requires_grad_()
        sigma, rgb = field(samples, encoded=encoded)
        t, width = picked.t.to(kind), picked.width.to(kind)
        ops = kernels.select("cpu").marching
        found = ops.composite(sigma, rgb, t, width, samples.ray, len(pixels.rays))
        colour, opacity, depth, weights = found
        loss = losses(config, pixels, background.to(kind), colour, opacity, depth, counted).total
        spread = distortion(weights, t, samples.ray, len(pixels.rays))
        (loss + config.distortion_weight * spread).backward()
        named = {k: v.grad for k, v in field.named_parameters() if v.grad is not None}
        return {"encoded": encoded.grad, **named}

    ours = {k: v.clone() for k, v in gradients(field, torch.float32).items()}
    double = new_avatar(tiny, tiny_frames, config).field.double()
    double.load_state_dict(field.state_dict())
    with kernels.plain_torch():
        truth = gradients(double, torch.float64)
    assert len(ours) > 10
    for name, grad in ours.items():
        want = truth[name]
        scale = want.abs().max().clamp(min=1e-12)
        assert float((grad.double() - want).abs().max() / scale) < 2e-4, name


# time


def run_long(collection, frames, iterations):
    """Losses, each the mean of a fiftieth."""
    trainer = trainer_of(collection, frames, iterations=iterations)
    losses_seen = []
    for _ in range(iterations):
        losses_seen.append(trainer.iterate().loss)
        assert not trainer.watch.astray, trainer.status
    assert finite(trainer)
    assert trainer.sound()
    return np.array(losses_seen).reshape(50, -1).mean(1), trainer


def test_two_thousand_iterations_do_not_diverge(tiny, tiny_frames):
    means, trainer = run_long(tiny, tiny_frames, 2000)
    assert means[-5:].max() < 0.5 * means[0]
    assert trainer.watch.skipped == 0


@pytest.mark.slow
def test_fifty_thousand_iterations_do_not_diverge(tiny, tiny_frames):
    """At rates that never fall."""
    means, trainer = run_long(tiny, tiny_frames, 50_000)
    assert means[25:].max() < 1.5 * means[5:25].mean()
    assert means[-5:].max() < 0.5 * means[0]
    assert trainer.watch.skipped < 50
    print(f"loss {means[0]:.3f} -> {means[-1]:.4f}, skipped {trainer.watch.skipped}")
