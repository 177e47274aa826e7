"""The same training and the same picture on every device that torch finds here."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch

from ..core.config import Config
from ..core.devices import KINDS, device_of
from ..core.errors import InputError
from ..core.evaluation.metrics import over, psnr
from ..core.evaluation.report import Claim
from ..core.progress import Report
from ..core.rendering.render import RenderSettings, render
from ..core.training.prepare import load_training_frames
from .measure import Options, a_frame, best, collection_of, plot, show
from .train import iteration_costs, trained

_SIZE = 512


def run(options: Options, progress: Report | None = None) -> tuple[dict[str, Any], list[Claim]]:
    collection = collection_of(options)
    frames, frame = load_training_frames(collection), a_frame(collection)
    camera = frame.camera.resized(_SIZE, _SIZE)
    name = collection.appearances[frame.appearance]
    rows, claims, pictures = [], [], {}
    for device in _found():
        trainer, point = trained(
            collection, frames, Config(), options.minutes, progress, device=device
        )
        cost = iteration_costs(trainer)
        avatar = trainer.avatar
        row = {"device": device, "name": _name(device), **point}
        row |= {"iteration_ms": cost["median_ms"], "samples": cost["samples"]}
        # an avatar looks the same wherever it is rendered
        for where in dict.fromkeys(("cpu", device)):
            avatar.field.to(where)
            show_it = partial(
                render, avatar, frame.vertices, camera, name, expression=frame.expression
            )
            every = show_it(settings=RenderSettings(probe=1, longest=1, agreement=0.0, brief=False))
            pictures[where] = over(every.rgba, 1.0)
            row[f"picture_{'cpu' if where == 'cpu' else 'device'}"] = round(
                best({"picture": show_it}, options.repeats)["picture"], 3
            )
        row["agreement"] = round(psnr(pictures[device], pictures["cpu"]), 1)
        row.setdefault("picture_device", row["picture_cpu"])
        rows.append(row)
        if device != "cpu":
            claims.append(
                Claim.at_least(
                    f"{device}: its picture against the CPU's", row["agreement"], 50, "dB"
                )
            )
    show(rows)
    plot(
        options.out / "devices.svg",
        lambda axes: axes.bar([r["device"] for r in rows], [r["head_psnr"] for r in rows]),
        f"Held-out PSNR after {options.minutes:g} minutes of training",
        "device",
        "dB",
    )
    return {"devices": rows}, claims


def _found() -> list[str]:
    """The kinds of device there are here."""
    found = []
    for kind in KINDS:
        try:
            device_of(kind)
        except InputError:
            continue
        found.append(kind)
    return found


def _name(device: str) -> str:
    return torch.cuda.get_device_name() if device == "cuda" else device
