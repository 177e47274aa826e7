"""How cost grows with pixels, appearances, triangles and frames: fitted exponents."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import trimesh

from ..core.deformation import Deformer
from ..core.evaluation.report import Claim
from ..core.field.avatar import Avatar
from ..core.progress import Report
from ..core.rendering.render import RenderSettings, render
from ..core.training.frames import Frame
from .measure import Options, a_frame, best, plot, show, subject

_SIDES = (128, 256, 512, 1024)
_APPEARANCES = (1, 2, 5, 10)
_TRIANGLES = (2_000, 5_000, 10_000, 20_000, 40_000)
_FRAMES = (1, 2, 4, 8)
_QUERIES = 1 << 16
_SIZE = 128  # pixels a side where something else grows


def run(options: Options, progress: Report | None = None) -> tuple[dict[str, Any], list[Claim]]:
    avatar, collection = subject(options, progress)
    frame = a_frame(collection)
    curves = {
        "pixels": _measure(options, {n * n: _drawn(avatar, frame, n) for n in _SIDES}),
        "appearances": _measure(options, {n: _worn(avatar, frame, n) for n in _APPEARANCES}),
        "triangles": _measure(options, {n: _search(n) for n in _TRIANGLES}),
        "frames": _measure(options, {n: _sequence(avatar, frame, n) for n in _FRAMES}),
    }
    exponents = {name: _exponent(curve) for name, curve in curves.items()}
    show([{"of": k, "exponent": v} for k, v in exponents.items()])
    plot(
        options.out / "scale.svg",
        lambda axes: _draw(axes, curves, exponents),
        "Cost against size, each relative to its smallest",
        "times the smallest",
        "times its seconds",
    )
    limits = {"pixels": 1.05, "appearances": 0.15, "triangles": 0.5, "frames": 1.05}
    claims = [
        Claim.at_most(f"exponent of {name}", exponents[name], limit, "")
        for name, limit in limits.items()
    ]
    return {"seconds": curves, "exponents": exponents}, claims


def _measure(options: Options, calls: dict[int, Callable[[], Any]]) -> dict[str, float]:
    seconds = best({str(n): call for n, call in calls.items()}, options.repeats)
    return {n: round(value, 5) for n, value in seconds.items()}


def _exponent(curve: dict[str, float]) -> float:
    """Slope of log seconds over log size."""
    sizes, seconds = np.array([float(n) for n in curve]), np.array(list(curve.values()))
    return round(float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0]), 3)


def _drawn(avatar: Avatar, frame: Frame, side: int) -> Callable[[], Any]:
    camera = frame.camera.resized(side, side)
    name = avatar.appearances[frame.appearance]
    settings = RenderSettings.preset("final")
    return lambda: render(avatar, frame.vertices, camera, name, settings)


def _worn(avatar: Avatar, frame: Frame, count: int) -> Callable[[], Any]:
    """The same picture from an avatar of so many appearances: its own, over and over."""
    rows = np.arange(count) % len(avatar.appearances)
    many = Avatar.create(
        avatar.config,
        [f"{avatar.appearances[row]} {i}" for i, row in enumerate(rows)],
        avatar.canonical_vertices,
        avatar.triangles,
        avatar.uvs,
        avatar.uv_triangles,
        avatar.expression_names,
        rigid_weights=avatar.rigid_weights,
        box_min=avatar.box_min,
        box_size=avatar.box_size,
        occupied=avatar.occupied[rows],
    )
    state = avatar.field.state_dict()
    for name in ("latent", "code"):
        state[name] = state[name][torch.from_numpy(rows)]
    many.field.load_state_dict(state)
    return _drawn(many, frame, _SIZE)


def _search(triangles: int) -> Callable[[], Any]:
    """A ball of about so many triangles, posed and searched from places near it."""
    columns = round(np.sqrt(triangles))
    ball = trimesh.creation.uv_sphere(radius=0.1, count=[columns // 2, columns])
    deformer = Deformer(np.asarray(ball.vertices, np.float32), ball.faces, "smooth")
    generator = np.random.default_rng(0)
    directions = generator.normal(size=(_QUERIES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    order = np.lexsort(np.round(directions.T, 1))  # neighbours search together, as rays do
    points = torch.from_numpy(np.float32(0.11 * directions[order]))
    return lambda: deformer.nearest(deformer.pose(ball.vertices), points)


def _sequence(avatar: Avatar, frame: Frame, count: int) -> Callable[[], Any]:
    once = _drawn(avatar, frame, _SIZE)
    return lambda: [once() for _ in range(count)]


def _draw(axes: Any, curves: dict[str, dict[str, float]], exponents: dict[str, float]) -> None:
    for name, curve in curves.items():
        sizes, seconds = np.array([float(n) for n in curve]), np.array(list(curve.values()))
        label = f"{name}: exponent {exponents[name]:.2f}"
        axes.plot(sizes / sizes[0], seconds / seconds[0], "o-", label=label)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.legend()
