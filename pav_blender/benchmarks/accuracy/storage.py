"""What an avatar file holds, how it grows with appearances, and what halves cost."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...core.collection import Collection
from ...core.config import Config
from ...core.evaluation.heldout import held_out
from ...core.evaluation.report import Claim
from ...core.field.avatar import Avatar
from ...core.field.field import Field

_FRAMES = 4  # held out, an appearance
COUNTS = (1, 3, 5, 10)
LARGEST, LOSS = 60.0, 0.05  # MB of five appearances, dB
PARTS = {
    "hash tables": ("tables",),
    "tables of the shoulders": ("still_tables",),
    "appearances' features": ("latent", "code"),
    "networks": ("density.", "offset.", "colour."),
}


def sizes(avatar: Avatar, config: Config, appearances: int, half: bool) -> dict[str, float]:
    """Megabytes of each part of a file with this avatar's mesh; nothing is allocated for it."""
    with torch.device("meta"):
        field = Field(
            config,
            appearances,
            len(avatar.expression_names),
            torch.zeros(1, 3, dtype=torch.int32),
            torch.zeros(1, 3, 2),
            len(avatar.canonical_vertices),
        )
    each = 2 if half else 4
    found = {
        part: sum(v.numel() for k, v in field.state_dict().items() if k.startswith(names)) * each
        for part, names in PARTS.items()
    }
    mesh = ("canonical_vertices", "triangles", "uvs", "uv_triangles", "rigid_weights", "betas")
    found["mesh"] = sum(getattr(avatar, name).nbytes for name in mesh)
    found["filled cells"] = appearances * -(-(config.occupancy_resolution**3) // 8)
    return {part: size / 1e6 for part, size in found.items()}


def measure(
    avatar: Avatar, collection: Collection
) -> tuple[dict[str, list[dict[str, Any]]], list[Claim]]:
    """Parts of a file, sizes by number of appearances, and the avatar stored both ways."""
    modes = {
        "as it is": avatar.config,
        "a texture an appearance": dataclasses.replace(avatar.config, appearance="surface"),
        "the paper's preset": Config.paper(),
    }
    growth: list[dict[str, Any]] = []
    for name, config in modes.items():
        for count in COUNTS:
            whole, half = (sum(sizes(avatar, config, count, h).values()) for h in (False, True))
            growth.append(
                {"settings": name, "appearances": count, "MB": whole, "MB in halves": half}
            )
    stored = _stored(avatar, collection)
    count = len(avatar.appearances)
    both = [sizes(avatar, avatar.config, count, half) for half in (False, True)]
    parts = [{"part": k, "MB": both[0][k], "MB in halves": both[1][k]} for k in both[0]]
    five = {r["settings"]: r for r in growth if r["appearances"] == 5}
    largest = max(five["as it is"]["MB in halves"],
                  five["a texture an appearance"]["MB in halves"])  # fmt: skip
    off = max(abs(sum(part.values()) / r["MB"] - 1) for part, r in zip(both, stored, strict=True))
    return {"parts": parts, "growth": growth, "stored": stored}, [
        Claim.at_most("five appearances, whole", five["as it is"]["MB"], LARGEST, "MB"),
        Claim.at_most("five appearances, a texture each, in halves", largest, LARGEST, "MB"),
        Claim.at_most("lost in halves, held-out PSNR", stored[0]["psnr"] - stored[1]["psnr"],
                      LOSS, "dB"),
        Claim.at_most("files against the sizes computed", off * 100, 1, "%"),
    ]  # fmt: skip


def _stored(avatar: Avatar, collection: Collection) -> list[dict[str, Any]]:
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for half in (False, True):
            path = Path(folder) / "avatar.pav"
            avatar.save(path, half=half)
            again = Avatar.load(path)
            scores = held_out(again, collection, per_appearance=_FRAMES)
            state = again.field.state_dict()
            same = all(torch.equal(v, state[k]) for k, v in avatar.field.state_dict().items())
            rows.append(
                {
                    "stored": "in halves" if half else "whole",
                    "MB": path.stat().st_size / 1e6,
                    "psnr": round(float(np.mean([s.psnr for s in scores])), 4),
                    "head_psnr": round(float(np.mean([s.head_psnr for s in scores])), 4),
                    "same bits": same,
                }
            )
    return rows
