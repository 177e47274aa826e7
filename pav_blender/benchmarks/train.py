"""Held-out PSNR against training time: ours planned for several budgets, the paper's preset; and
what an iteration costs, with compiled kernels and in plain torch."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch

from ..core import kernels
from ..core.collection import Collection
from ..core.config import Config
from ..core.evaluation.heldout import held_out
from ..core.evaluation.report import Claim
from ..core.field.avatar import Avatar
from ..core.field.field import Samples
from ..core.kernels.cpu.threads import torch_alone
from ..core.progress import Report
from ..core.rendering.render import RenderSettings
from ..core.training.frames import Frame
from ..core.training.prepare import load_training_frames, new_avatar
from ..core.training.trainer import Trainer
from .measure import Options, collection_of, plot, show

_BUDGETS = (1 / 20, 1 / 10, 1 / 4)  # parts of the paper preset's time
_RAYS = 4096
_PAPER_ITERATIONS = 15_000
_SETTLE = 40
_TIMED = 60
_PER_APPEARANCE = 4


def run(options: Options, progress: Report | None = None) -> tuple[dict[str, Any], list[Claim]]:
    collection = collection_of(options)
    frames = load_training_frames(collection)
    # kernels are compiled, or read from the disk, before any clock runs
    warm = Trainer(new_avatar(collection, frames, Config()), frames)
    for _ in range(3):
        warm.iterate()
    points = []
    trainer = None
    for part in _BUDGETS:
        trainer, point = trained(collection, frames, Config(), part * options.minutes, progress)
        points.append({"method": "ours", **point})
    assert trainer is not None
    iteration = iteration_costs(trainer)
    plain = _plain_iteration(trainer.avatar, iteration["samples"])
    _, point = trained(collection, frames, Config.paper(), options.minutes, progress)
    points.append({"method": "paper", **point})
    show(points)
    goal, paper_minutes = point["head_psnr"], point["minutes"]
    reached = [p["minutes"] for p in points if p["method"] == "ours" and p["head_psnr"] >= goal]
    ratio = paper_minutes / min(reached) if reached else 0.0
    whole = iteration["median_ms"] * _PAPER_ITERATIONS / 60e3
    print(
        f"{_RAYS} rays: {iteration['least_ms']} ms at least, {iteration['median_ms']} ms median, "
        f"{iteration['samples']} samples; networks and tables alone in plain torch: {plain} ms"
    )
    plot(
        options.out / "train.svg",
        lambda axes: _draw(axes, points),
        "Held-out PSNR over the head against training time",
        "minutes of training",
        "dB",
    )
    fields = {"points": points, "iteration": iteration, "plain_torch_ms": plain}
    claims = [
        Claim.at_most("iteration of 4096 rays, least", iteration["least_ms"], 60, "ms"),
        Claim.at_most("15,000 such iterations, from the median", whole, 18, "min"),
        Claim.at_least("sooner than the paper's preset at its PSNR", ratio, 10, "x"),
        Claim.at_least("against plain torch, fields alone", plain / iteration["fields_ms"], 1, "x"),
    ]
    return fields, claims


def trained(
    collection: Collection,
    frames: list[Frame],
    config: Config,
    minutes: float,
    progress: Report | None,
    *,
    device: str = "cpu",
) -> tuple[Trainer, dict[str, Any]]:
    """A training planned for `minutes`, and how good it was."""
    avatar = new_avatar(collection, frames, config)
    trainer = Trainer(avatar, frames, minutes=minutes, device=device)
    while trainer.done < 1:
        with torch_alone():
            status = trainer.iterate()
        if progress:
            progress(trainer.done, iteration=status.iteration, psnr=round(status.psnr, 2))
    scores = held_out(
        trainer.avatar, collection, per_appearance=_PER_APPEARANCE, settings=RenderSettings()
    )
    return trainer, {
        "minutes": round(status.seconds / 60, 2),
        "iterations": status.iteration,
        "head_psnr": round(float(np.mean([s.head_psnr for s in scores])), 2),
        "psnr": round(float(np.mean([s.psnr for s in scores])), 2),
    }


def iteration_costs(trainer: Trainer) -> dict[str, Any]:
    """Milliseconds of iterations of 4096 rays as they are late in a training."""
    times, fields, samples = [], [], []
    with torch_alone():
        for _ in range(_SETTLE + _TIMED):
            trainer.status.rays = _RAYS
            started = time.perf_counter()
            trainer.iterate()  # ends with numbers on the CPU: nothing is under way after it
            times.append(time.perf_counter() - started)
            samples.append(trainer.status.samples_per_ray)
        drawn = _samples(trainer.avatar, int(np.mean(samples) * _RAYS)).to(trainer.device)
        for _ in range(8):
            started = time.perf_counter()
            _fields(trainer.avatar, drawn)
            fields.append(time.perf_counter() - started)
    late = times[_SETTLE:]
    return {
        "least_ms": round(min(late) * 1e3, 1),
        "median_ms": round(float(np.median(late)) * 1e3, 1),
        "samples": int(np.mean(samples) * _RAYS),
        "fields_ms": round(min(fields) * 1e3, 1),
    }


def _samples(avatar: Avatar, count: int) -> Samples:
    """So many samples anywhere: what networks and tables cost does not depend on where."""
    generator = torch.Generator().manual_seed(0)
    conditions = avatar.field.density.group_weight.shape[1]
    triangles = len(avatar.triangles)
    return Samples(
        canonical=torch.rand(count, 3, generator=generator),
        still=torch.rand(count, 3, generator=generator),
        triangle=torch.randint(0, triangles, (count,), generator=generator, dtype=torch.int32),
        barycentric=torch.full((count, 3), 1 / 3),
        distance=torch.rand(count, generator=generator) * 0.02,
        appearance=torch.zeros(count, dtype=torch.int32),
        frame=torch.zeros(count, dtype=torch.int32),
        ray=torch.arange(count, dtype=torch.int32) // 8,
        condition=torch.zeros(1, conditions),
        direction=torch.nn.functional.normalize(torch.randn(count // 8 + 1, 3), dim=1),
    )


def _fields(avatar: Avatar, samples: Samples) -> None:
    """Forward and backward of networks and tables."""
    field = avatar.field
    field.requires_grad_(True)
    density, colour = field(samples)
    (density.mean() + colour.mean()).backward()
    field.zero_grad()


def _plain_iteration(avatar: Avatar, count: int) -> float:
    """Milliseconds of `_fields` in plain torch, on all its threads."""
    samples, times = _samples(avatar, count), []
    with kernels.plain_torch():
        for _ in range(3):
            started = time.perf_counter()
            _fields(avatar, samples)
            times.append(time.perf_counter() - started)
    return round(min(times) * 1e3, 1)


def _draw(axes: Any, points: list[dict[str, Any]]) -> None:
    for method in dict.fromkeys(p["method"] for p in points):
        own = [p for p in points if p["method"] == method]
        axes.plot([p["minutes"] for p in own], [p["head_psnr"] for p in own], "o-", label=method)
    axes.set_xscale("log")
    axes.legend()
