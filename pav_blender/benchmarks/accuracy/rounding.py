"""The pieces of a sample in float32 against float64: functions, harmonics, tables, search."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numba import njit
from scipy import special

from ...core import kernels
from ...core.evaluation.report import Claim
from ...core.field.avatar import Avatar
from ...core.field.directions import spherical_harmonics
from ...core.kernels import reference
from ...core.kernels.cpu.exponential import exp, exp_all
from ...core.kernels.cpu.lanes import LANES, load, splat, store
from ...core.kernels.cpu.search import OPTIONS
from ...core.rendering.wearing import deformer_of
from ...core.training.frames import Frame

_REACH = np.float32(87)  # where a vector's exponential is one
_EVERY = 257  # of all float32 numbers: every exponent, both signs, 16.7 million of them
_POINTS = 4000
_SEARCHED = 600  # each against every triangle
_AWAY = 0.02  # metres from the mesh, the deviation of points that are searched from


@njit(**OPTIONS)
def _library(x, out):
    for i in range(len(x)):
        out[i] = np.exp(x[i])


@njit(**OPTIONS)
def _sigmoid(x, out):  # as `frozen.add_colours` has it
    for i in range(0, len(x), LANES):
        store(out, i, splat(1.0) / (splat(1.0) + exp(splat(0.0) - load(x, i))))


@njit(**OPTIONS)
def _opacity(x, out):  # as `tracing._add_up` has it
    for i in range(len(x)):
        out[i] = np.float32(1) - np.exp(-x[i])


def floats() -> np.ndarray:
    """Finite float32 numbers over the whole range, whole vectors of them."""
    found = np.arange(0, 1 << 32, _EVERY, dtype=np.uint64).astype(np.uint32).view(np.float32)
    found = found[np.isfinite(found)]
    return found[: len(found) // LANES * LANES]


def ulps(ours: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """How many float32 spacings `ours` is off the float64 `exact`; both too large counts as 0."""
    with np.errstate(over="ignore", invalid="ignore"):
        largest = float(np.finfo(np.float32).max)
        spacing = np.spacing(np.minimum(np.abs(exact), largest).astype(np.float32))
        off = np.abs(ours.astype(np.float64) - exact) / spacing.astype(np.float64)
    return np.where(np.isinf(ours) & (exact > largest), 0.0, off)


def functions() -> list[dict[str, Any]]:
    """Exponential, sigmoid and opacity over all numbers: spacings, and absolute for the last."""
    x = floats()
    out = np.empty_like(x)
    with np.errstate(over="ignore"):
        wide = x.astype(np.float64)
        rows = []
        _library(x, out)
        rows.append(_row("exp, the C library's", ulps(out, np.exp(wide)).max(), 1, "spacings"))
        out[:] = x
        exp_all(out, len(x))
        within = (x >= -_REACH) & (x <= _REACH)
        off = ulps(out[within], np.exp(wide[within])).max()
        # 2e-7 of itself, as `exponential.exp` promises; a spacing is at least 2^-24 of a number
        promised = 2e-7 * 2**24
        rows.append(_row("exp, sixteen at a time, from -87 to 87", off, promised, "spacings"))
        _sigmoid(x, out)
        exact = special.expit(wide)
        # 0.5 of each further rounding: of the sum and the quotient
        off = ulps(out[within], exact[within]).max()
        rows.append(_row("sigmoid, from -87 to 87", off, promised + 1, "spacings"))
        # beyond, the exponential stays what it is at 88, and the sigmoid at 6e-39
        rows.append(_row("sigmoid, absolute", np.abs(out - exact).max(), 2**-23, ""))
        positive = x[x >= 0]
        out = out[: len(positive)]
        _opacity(positive, out)
        off = np.abs(out - -np.expm1(-positive.astype(np.float64))).max()
    # exp(-x) lies in (1/2, 1] or below: half a spacing of 1 each for it and the difference
    rows.append(_row("opacity 1 - exp(-x), absolute", off, 2**-23, ""))
    return rows


def harmonics() -> dict[str, Any]:
    """The 16 harmonics of float32 directions against Legendre functions in float64."""
    x = np.random.default_rng(0).normal(size=(_POINTS, 3))
    x = (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)
    ours = spherical_harmonics(torch.from_numpy(x)).numpy()
    unit = x / np.linalg.norm(x.astype(np.float64), axis=1, keepdims=True)
    off = np.abs(np.abs(ours) - np.abs(_harmonics(unit))).max()
    # cubic terms of size 3 at most, a handful of roundings; constants have eight digits
    return _row("spherical harmonics", off, 1e-6, "")


def _harmonics(unit: np.ndarray) -> np.ndarray:
    """Real harmonics up to a sign: [N, 16], l = 0 to 3, m = -l to l."""
    about = np.arctan2(unit[:, 1], unit[:, 0])
    found = []
    for degree in range(4):
        for m in range(-degree, degree + 1):
            k = abs(m)
            scale = (2 * degree + 1) / (4 * np.pi)
            scale *= special.factorial(degree - k) / special.factorial(degree + k)
            value = np.sqrt(scale) * special.lpmv(k, degree, unit[:, 2])
            turn = np.cos(k * about) if m >= 0 else np.sin(k * about)
            found.append(value * turn * (np.sqrt(2) if m else 1))
    return np.stack(found, 1)


def tables(avatar: Avatar) -> dict[str, Any]:
    """Interpolation of the hash tables, against the largest entry."""
    field, generator = avatar.field, torch.Generator().manual_seed(0)
    points, own = torch.rand(_POINTS, 3, generator=generator), field.tables.detach()
    with torch.inference_mode():
        ours = kernels.select("cpu").encoding.encode(points, own, field.layout)
        exact = reference.encoding.encode(points.double(), own.double(), field.layout)
    off = float((ours - exact).abs().max() / own.abs().max())
    # a place of 512 cells is known to 512 x 2^-24 of a cell along each axis; two corners differ by
    # twice the largest entry: 3 x 2 x 3e-5
    return _row("hash tables, of the largest entry", off, 6 * 512 * 2**-24, "")


def networks(avatar: Avatar) -> dict[str, Any]:
    """The density network on inputs of the size it sees, against its largest output."""
    network, generator = avatar.field.density, torch.Generator().manual_seed(0)
    x = torch.randn(_POINTS, avatar.field.encoded_width, generator=generator)
    layers = [[v.detach() for v in part] for part in (network.weights, network.biases)]
    with torch.inference_mode():
        ours = kernels.select("cpu").mlp.mlp(x, *layers)
        exact = reference.mlp.mlp(x.double(), *[[v.double() for v in part] for part in layers])
    off = float((ours - exact).abs().max() / exact.abs().max())
    # sums of 36 and of 64 products, rounded once each at worst, all the same way
    return _row("density network, of the largest output", off, 100 * 2**-24, "")


def search(avatar: Avatar, frame: Frame) -> list[dict[str, Any]]:
    """Nearest points: the compiled search against every triangle in float64."""
    generator = torch.Generator().manual_seed(0)
    vertices = torch.from_numpy(frame.vertices)
    at = torch.randint(len(vertices), (_SEARCHED,), generator=generator)
    points = vertices[at] + _AWAY * torch.randn(_SEARCHED, 3, generator=generator)
    ours = kernels.select("cpu").nearest.nearest(deformer_of(avatar).pose(frame.vertices).search,
                                                 points)  # fmt: skip
    topology = reference.nearest.Topology(torch.from_numpy(avatar.triangles), vertices)
    posed = reference.nearest.refit(topology, vertices.double())
    exact = reference.nearest.nearest(posed, points)
    corners = vertices.double()[topology.triangles.long()]
    feet = [(corners[f[0].long()] * f[1].double()[:, :, None]).sum(1) for f in (ours, exact)]
    # where two triangles are as near, either may be named: what counts is the place
    same = (ours[0] == exact[0]) | ((ours[2] - exact[2]).abs() < 1e-6)
    foot = float((feet[0] - feet[1]).norm(dim=1)[same].max()) if bool(same.any()) else np.inf
    off = float((ours[2].double() - exact[2].double()).abs().max())
    return [
        # places of up to 0.5 m are known to 3e-8 m, and a distance is the root of three squares
        _row("nearest triangle: distance", off * 1e6, 1.0, "um"),
        _row("nearest triangle: place on the mesh", foot * 1e6, 100.0, "um"),
        _row("nearest triangle: farther than the nearest", float((~same).sum()), 0, "points"),
    ]


def _row(name: str, value: float, bound: float, unit: str) -> dict[str, Any]:
    return {"in float32": name, "largest error": float(value), "bound": bound, "unit": unit}


def measure(avatar: Avatar, frame: Frame) -> tuple[list[dict[str, Any]], list[Claim]]:
    """A row a piece, and that each keeps to its bound."""
    parts: list[Callable[[], Any]] = [functions, lambda: search(avatar, frame)]
    rows = [row for part in parts for row in part()]
    rows += [harmonics(), tables(avatar), networks(avatar)]
    return rows, [Claim.at_most(f"{r['in float32']}: of its bound", _part(r), 1, "x") for r in rows]


def _part(row: dict[str, Any]) -> float:
    return row["largest error"] / row["bound"] if row["bound"] else row["largest error"] + 1
