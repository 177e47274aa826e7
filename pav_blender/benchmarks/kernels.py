"""Each compiled kernel: nanoseconds a sample, against a floor from this machine's own rates.

A floor is what the kernel must move or compute at least, at the rates that plain large operations
reach here: multiply-adds of a matrix product, bytes of a copy, exponentials of a vector.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from ..core import kernels
from ..core.evaluation.report import Claim
from ..core.progress import Report
from ..core.rendering.wearing import deformer_of
from .measure import Options, a_frame, best, plot, show, subject

_N = 1 << 16  # samples
_SIDE = 1024  # of the matrices that tell the rate of multiply-adds
_CACHE = 1 << 20  # bytes a core keeps to itself
_LINES = 4  # cache lines that the eight corners of a cell lie in
_COPY = 1 << 25  # floats that tell the rate of memory
_TILE = 0.004  # metres
_SEARCH_FLOPS = 1200  # of one search that opens one node a level and measures one leaf


def run(options: Options, progress: Report | None = None) -> tuple[dict[str, Any], list[Claim]]:
    avatar, collection = subject(options, progress)
    rates = _rates(options.repeats)
    calls, floors = _kernels(avatar, a_frame(collection), rates)
    seconds = best(calls, options.repeats)
    rows = []
    for name, (samples, floor, what) in floors.items():
        ns = seconds[name] / samples * 1e9
        row = {"kernel": name, "ns": round(ns, 2), "floor_ns": round(floor, 2)}
        rows.append({**row, "ratio": round(ns / floor, 2), "floor": what})
    show([{"rate": k, "value": v} for k, v in rates.items()])
    show(rows)
    plot(
        options.out / "kernels.svg",
        lambda axes: _draw(axes, rows),
        "Kernels against their floors",
        "ns a sample",
        "",
    )
    claims = [
        Claim.at_most(
            f"{name}: over its floor",
            seconds[name] / samples * 1e9 / floor,
            3 if name == "hash encoding" else 2,
            "x",
        )
        for name, (samples, floor, _) in floors.items()
    ]
    return {"rates": rates, "kernels": rows}, claims


def _rates(repeats: int) -> dict[str, float]:
    """Multiply-adds, bytes and exponentials a nanosecond, all cores together."""
    a, b = torch.rand(2, _SIDE, _SIDE)
    few = torch.rand(_N, dtype=torch.float64)
    source, target = torch.rand(_COPY), torch.empty(_COPY)
    with torch.inference_mode():
        seconds = best(
            {
                "product": lambda: a @ b,
                "copy": lambda: target.copy_(source),
                "exponential": lambda: torch.exp(few),
            },
            repeats + 2,
        )
    rates = {
        "multiply_adds_per_ns": _SIDE**3 / seconds["product"],
        "bytes_per_ns": 8 * _COPY / seconds["copy"],
        "exponentials_per_ns": _N / seconds["exponential"],
    }
    # digits, not places: on a busy machine a rate may be next to nothing, and is divided by
    return {name: float(f"{rate * 1e-9:.3g}") for name, rate in rates.items()}


def _kernels(
    avatar: Any, frame: Any, rates: dict[str, float]
) -> tuple[dict[str, Callable[[], Any]], dict[str, tuple[int, float, str]]]:
    """Calls, and by name: how many samples each takes, its floor in ns a sample, what that is."""
    ops, field, config = kernels.select("cpu"), avatar.field, avatar.config
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(_N, 3, generator=generator) * 0.5 + 0.25
    encoded = torch.rand(_N, field.encoded_width, generator=generator)
    group = torch.zeros(_N, dtype=torch.int32)
    network, bias = field.density, torch.zeros(1, config.hidden)
    weights, biases = [w.detach() for w in network.weights], [b.detach() for b in network.biases]
    multiplies = sum(w.numel() for w in weights)
    vertices = torch.from_numpy(frame.vertices)
    mesh = deformer_of(avatar).pose(frame.vertices)
    near = vertices[torch.arange(_N) // 16 % len(vertices)]
    # sixteen neighbours, as a picture's tile asks for
    near = near + torch.rand(_N, 3, generator=generator) * _TILE
    ray = torch.arange(_N // 8, dtype=torch.int32).repeat_interleave(8)
    sigma, colour = torch.rand(_N, generator=generator) * 100, torch.rand(_N, 3)
    t = torch.rand(_N)
    table = torch.rand(1 << 22)
    grad, m, v = torch.rand_like(table), torch.zeros_like(table), torch.zeros_like(table)
    adam = {"step": 10, "lr": 1e-3, "beta1": 0.9, "beta2": 0.99, "eps": 1e-15}
    trained = [w.clone().requires_grad_() for w in weights]
    shifts = [b.clone().requires_grad_() for b in biases]

    def forward() -> torch.Tensor:
        with torch.inference_mode():
            return ops.mlp.mlp(encoded, weights, biases, bias, group)

    # a level that is larger than a core's own cache is read line by line: corners along one axis
    # are neighbours
    large = sum(8 * entries > _CACHE for entries in field.layout.sizes)
    outputs = torch.ones(_N, config.geometry_channels)

    def both() -> None:
        ops.mlp.mlp(encoded, trained, shifts, bias, group).backward(outputs)

    fma, byte = rates["multiply_adds_per_ns"], rates["bytes_per_ns"]
    calls: dict[str, Callable[[], Any]] = {
        "nearest triangle": lambda: ops.nearest.nearest(mesh.search, near),
        "hash encoding": lambda: ops.encoding.encode(points, field.tables.detach(), field.layout),
        "density network, forward": forward,
        "density network, forward and backward": both,
        "compositing": lambda: ops.marching.composite(sigma, colour, t, 1e-3, ray, _N // 8),
        "Adam": lambda: ops.optimiser.adam_step(table, grad, m, v, **adam),
    }
    floors = {
        "nearest triangle": (_N, _SEARCH_FLOPS / 2 / fma, "one path down the tree"),
        "hash encoding": (_N, _LINES * 64 * large / byte, "cache lines of its large levels"),
        "density network, forward": (_N, multiplies / fma, "multiply-adds"),
        "density network, forward and backward": (_N, 3 * multiplies / fma, "multiply-adds"),
        "compositing": (
            _N,
            4 * (5 + 1) / byte + 1 / rates["exponentials_per_ns"],
            "bytes in and out, an exponential",
        ),
        "Adam": (len(table), 4 * 7 / byte, "bytes in and out"),
    }
    return calls, floors


def _draw(axes: Any, rows: list[dict[str, Any]]) -> None:
    at = np.arange(len(rows))
    axes.barh(at, [r["ns"] for r in rows], label="measured")
    axes.barh(at, [r["floor_ns"] for r in rows], label="floor")
    axes.set_yticks(at, [r["kernel"] for r in rows])
    axes.invert_yaxis()
    axes.legend()
