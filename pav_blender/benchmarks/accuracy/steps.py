"""Error of pictures against step and against time, on a trained avatar."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np
import torch

from ...core.evaluation.metrics import over
from ...core.evaluation.report import Claim
from ...core.field.avatar import Avatar
from ...core.rendering.render import RenderSettings, Scene, pose_scene, trace_rays
from ...core.training.frames import Frame
from .exact import Exact, RayBatch, some_rays
from .quadrature import order

STEPS = (8.0, 4.0, 2.0, 1.0, 0.5, 0.25, 0.125)  # millimetres
TRUTH = 0.0625
SIZE, _TILES = 256, 100
# Where the field is smooth the places' errors are of order 2; but cells end sharply, and so does
# the part of the mesh that is nearest: there a surface is off by up to half a step, order 1.
ORDER = 1.0
_ASYMPTOTIC = 2.0  # millimetres: coarser steps pass hair and lips without a look


def every(step: float) -> RenderSettings:
    """A picture with a sample every `step` metres, none skipped."""
    return dataclasses.replace(RenderSettings.preset("reference"), step=step)


def settings_of() -> dict[str, tuple[str, RenderSettings]]:
    """By name: of which kind, and the settings."""
    found = {f"every {s:g} mm": ("nothing skipped", every(s * 1e-3)) for s in STEPS}
    final = RenderSettings.preset("final")
    for step in STEPS:
        changed = dataclasses.replace(final, step=step * 1e-3)
        found[f"skips, {step:g} mm"] = ("skips of `final`", changed)
    for preset in ("preview", "final", "reference"):
        found[preset] = ("preset", RenderSettings.preset(preset))
    return found


def differences(ours: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Root mean square and largest difference, and PSNR (dB), of colours in [0, 1]."""
    off = np.asarray(ours, np.float64) - np.asarray(truth, np.float64)
    mean = float(np.sqrt((off**2).mean()))
    return {
        "rms": mean,
        "max": float(np.abs(off).max()),
        "psnr": round(min(-20 * np.log10(max(mean, 1e-12)), 200.0), 2),
    }


def shown(scene: Scene, rays: RayBatch, settings: RenderSettings) -> np.ndarray:
    """Colours of rays [R, 3] before white."""
    return over(trace_rays(scene, rays, settings)[0], 1.0)


def measure(avatar: Avatar, frame: Frame) -> tuple[list[dict[str, Any]], list[Claim]]:
    """A row a setting: error against the finest picture in float64, microseconds a ray."""
    rays, scene = _subject(avatar, frame)
    started = time.perf_counter()
    truth = Exact.of(avatar, frame).shown(rays, TRUTH * 1e-3)
    rows = [_row("truth", "float64", TRUTH, truth, truth, time.perf_counter() - started)]
    for name, (kind, settings) in settings_of().items():
        shown(scene, rays.pick(torch.arange(16)), settings)  # compiled; what a pose knows, known
        started = time.perf_counter()
        ours = shown(scene, rays, settings)
        seconds = time.perf_counter() - started
        rows.append(_row(name, kind, settings.step * 1e3, ours, truth, seconds))
    return rows, _claims(rows)


def _subject(avatar: Avatar, frame: Frame) -> tuple[RayBatch, Scene]:
    name = avatar.appearances[frame.appearance]
    scene = pose_scene(avatar, frame.vertices, name, frame.expression)
    return some_rays(frame, SIZE, _TILES), scene


def _row(
    name: str, kind: str, step: float, ours: np.ndarray, truth: np.ndarray, seconds: float
) -> dict[str, Any]:
    fields = {"setting": name, "kind": kind, "step_mm": round(step, 4)}
    return fields | differences(ours, truth) | {"us_a_ray": seconds / len(ours) * 1e6}


def fitted(rows: list[dict[str, Any]]) -> float:
    """The order of what skips nothing, over steps fine enough to see what there is."""
    own = [r for r in rows if r["kind"] == "nothing skipped" and r["step_mm"] <= _ASYMPTOTIC]
    return order([r["step_mm"] for r in own], [r["rms"] for r in own])


def _claims(rows: list[dict[str, Any]]) -> list[Claim]:
    named = {r["setting"]: r for r in rows}
    return [
        Claim.at_least("order of pictures, 2 mm and finer", fitted(rows), ORDER, ""),
        Claim.at_least("final: to the finest in float64", named["final"]["psnr"], 50, "dB"),
        Claim.at_least("preview: to the finest in float64", named["preview"]["psnr"], 40, "dB"),
        Claim.at_least("reference: to the finest in float64", named["reference"]["psnr"], 50, "dB"),
    ]


def draw(axes: Any, rows: list[dict[str, Any]], across: str) -> None:
    """Root mean square error against "step_mm" or "us_a_ray"."""
    for kind in dict.fromkeys(r["kind"] for r in rows if r["kind"] != "float64"):
        own = [r for r in rows if r["kind"] == kind]
        style = "s" if kind == "preset" else "o-"
        axes.plot([r[across] for r in own], [r["rms"] for r in own], style, label=kind)
        if kind == "preset":
            for r in own:
                axes.annotate(r["setting"], (r[across], r["rms"]), xytext=(5, 3),
                              textcoords="offset points", fontsize=8)  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.legend()
