"""The demo's report: figures, claims, a sheet of pictures and a page that shows them."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..collection import Collection
from ..field.avatar import Avatar
from ..field.identities import own_appearances
from ..files import write_text
from ..progress import Report
from ..rendering.render import RenderSettings
from .heldout import BACKGROUND, Score, chosen_frames, score
from .metrics import over
from .sheet import error_map


@dataclass(frozen=True)
class Claim:
    """One checked statement: value against target ("at least"), in a unit."""

    name: str
    value: float
    target: float
    unit: str
    met: bool

    @classmethod
    def at_least(cls, name: str, value: float, target: float, unit: str) -> Claim:
        return cls(name, round(value, 3), target, unit, bool(value >= target))

    @classmethod
    def at_most(cls, name: str, value: float, target: float, unit: str) -> Claim:
        return cls(name, round(value, 3), target, unit, bool(value <= target))


@dataclass(eq=False)
class Measured:
    """Scores of every held-out frame wearing every appearance: by [own][worn]."""

    scores: dict[str, dict[str, list[Score]]]

    def own(self, name: str) -> list[Score]:
        return self.scores[name][name]


def measure(
    avatar: Avatar,
    collection: Collection,
    per_appearance: int,
    *,
    splits: tuple[str, ...] = ("test",),
    progress: Report | None = None,
) -> Measured:
    """Renders held-out frames with their own appearance and with each of that person's others."""
    frames = chosen_frames(collection, splits, per_appearance)
    names = own_appearances(avatar, collection)
    scores: dict[str, dict[str, list[Score]]] = {n: {m: [] for m in names} for n in names}
    settings = RenderSettings()
    total = len(frames) * len(names)
    for frame in frames:
        own = names[frame.appearance]
        for worn in names:
            scores[own][worn].append(score(avatar, frame, worn, settings))
            if progress:
                done = sum(len(s) for row in scores.values() for s in row.values())
                progress(done / total, frame=frame.name)
    return Measured(scores)


def figures(measured: Measured) -> dict[str, Any]:
    """`psnr`, `ssim` and `switch_psnr` as the report has them."""
    names = list(measured.scores)

    def mean(values: list[float]) -> float:
        finite = [v for v in values if math.isfinite(v)]
        return round(float(np.mean(finite)), 3) if finite else math.nan

    head = {n: mean([s.head_psnr for s in measured.own(n)]) for n in names}
    whole = {n: mean([s.psnr for s in measured.own(n)]) for n in names}
    switch = {
        n: {m: mean([s.psnr for s in measured.scores[n][m]]) for m in names if m != n}
        for n in names
    }
    return {
        "psnr": {
            "head_mean": mean(list(head.values())),
            "mean": mean(list(whole.values())),
            "head": head,
            "picture": whole,
        },
        "ssim": {
            "mean": mean([s.ssim for n in names for s in measured.own(n)]),
            **{n: mean([s.ssim for s in measured.own(n)]) for n in names},
        },
        "switch_psnr": switch,
    }


def sheet_rows(measured: Measured, others: dict[str, list[np.ndarray]]) -> list[list[np.ndarray]]:
    """Rows: appearances; columns: truth, ours, error, then pictures of other poses."""
    rows = []
    for name in measured.scores:
        own = measured.own(name)
        middle = own[len(own) // 2]
        truth = over(middle.frame.rgba / 255, BACKGROUND)
        ours = over(middle.rendered, BACKGROUND)
        poses = [over(picture, BACKGROUND) for picture in others.get(name, [])]
        rows.append([truth, ours, error_map(ours, truth), *poses])
    return rows


def write_proof(
    path: Path, fields: dict[str, Any], claims: list[Claim], show: Callable[[str], None] = print
) -> bool:
    """Writes DIR/NAME.json with its claims, prints the table; True where all are met."""
    content = {**fields, "claims": [asdict(claim) for claim in claims]}
    write_text(path, json.dumps(content, indent=1, allow_nan=True) + "\n")
    width = max((len(claim.name) for claim in claims), default=0)
    for claim in claims:
        mark = "met" if claim.met else "NOT MET"
        value = f"{claim.value:9.2f} {claim.unit:4} target {claim.target:g}"
        show(f"{claim.name:{width}}  {value}  {mark}")
    return all(claim.met for claim in claims)


def write_page(path: Path, title: str, fields: dict[str, Any], pictures: list[str]) -> None:
    """A small HTML page: the pictures beside it, and the figures as a table."""
    rows = "".join(
        f"<tr><th>{html.escape(name)}</th><td>{html.escape(str(value))}</td></tr>"
        for name, value in _flat(fields)
    )
    shown = "".join(f'<p><img src="{html.escape(p)}" alt="{html.escape(p)}"></p>' for p in pictures)
    write_text(
        path,
        "<!doctype html><html lang=en><meta charset=utf-8>"
        f"<title>{html.escape(title)}</title><style>"
        "body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:70rem;padding:0 1rem}"
        "img{max-width:100%}th{text-align:left;font-weight:normal;padding-right:2rem;color:#555}"
        f"</style><h1>{html.escape(title)}</h1>{shown}<table>{rows}</table></html>\n",
    )


def _flat(fields: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for key, value in fields.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            rows += _flat(value, f"{name} / ")
        else:
            rows.append((name, ", ".join(map(str, value)) if isinstance(value, list) else value))
    return rows
