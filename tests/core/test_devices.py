"""Networks on another device than the CPU."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from pav_blender.core.config import Config
from pav_blender.core.devices import device_of
from pav_blender.core.errors import InputError
from pav_blender.core.evaluation.metrics import over, psnr
from pav_blender.core.rendering.render import RenderSettings, render
from pav_blender.core.training.frames import camera_of
from pav_blender.core.training.prepare import load_training_frames, new_avatar
from pav_blender.core.training.train import train
from pav_blender.core.training.trainer import Trainer

SMALL = dataclasses.replace(
    Config(), levels=6, log2_entries=12, finest_resolution=128, occupancy_resolution=48
)


@pytest.fixture(params=["cuda", "mps"])
def device(request):
    try:
        return device_of(request.param)
    except InputError:
        pytest.skip(f"no {request.param} device here")


@pytest.mark.parametrize("name", ["tpu", "cuda:99", "meta", "cuda:x"])
def test_a_device_that_is_not_here_is_told(name):
    with pytest.raises(InputError, match=f"--device {name}"):
        device_of(name)
    assert device_of("cpu").type == "cpu"


@pytest.mark.parametrize(
    "settings",
    [
        RenderSettings(probe=1, longest=1, agreement=0.0, brief=False),
        RenderSettings(skip=False, agreement=0.0),
    ],
)
def test_a_picture_is_the_same_on_every_device(toy, toy_avatar, device, settings):
    clip = toy.clip("plain")
    pose = toy.posed(clip, np.array([7]))[0], camera_of(clip, 7).resized(48, 48), "plain"
    here = render(toy_avatar, *pose, settings)
    try:
        toy_avatar.field.to(device)
        there = render(toy_avatar, *pose, settings)
    finally:
        toy_avatar.field.cpu()
    assert (here.rgba[..., 3] > 0.5).mean() > 0.05
    assert psnr(over(here.rgba, 1.0), over(there.rgba, 1.0)) > 55
    assert there.evaluations == pytest.approx(here.evaluations, rel=0.3)


@pytest.mark.parametrize("changes", [{}, {"appearance": "surface", "latent_size": 32}])
def test_training_begins_the_same_on_every_device(toy, device, changes):
    frames = load_training_frames(toy)
    config = dataclasses.replace(SMALL, **changes)
    ends = []
    for where in ("cpu", device):
        trainer = Trainer(new_avatar(toy, frames, config), frames, device=where)
        first = trainer.iterate()
        psnr_first, loss_first = first.psnr, first.loss
        field = trainer.avatar.field.state_dict()
        ends.append((psnr_first, loss_first, {k: v.cpu() for k, v in field.items()}))
    assert ends[0][0] == pytest.approx(ends[1][0], abs=0.01)
    assert ends[0][1] == pytest.approx(ends[1][1], rel=1e-3)
    for name, value in ends[0][2].items():
        off = (value - ends[1][2][name]).abs()
        # Adam's first step is the sign of a gradient: where that is all but zero it may differ
        assert float((off > 1e-4).float().mean()) < 0.02, name


def test_what_was_trained_elsewhere_is_an_avatar_here(toy, device, tmp_path):
    config = dataclasses.replace(SMALL, iterations=40)
    avatar = train(toy, tmp_path / "a.pav", config, device=device)
    assert avatar.field.device == torch.device("cpu")
    clip = toy.clip("plain")
    shown = render(avatar, toy.posed(clip, np.array([7]))[0], camera_of(clip, 7), "plain")
    assert (shown.rgba[..., 3] > 0.5).mean() > 0.05
