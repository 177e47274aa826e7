"""Error against step of the compositing kernels, on media whose integral is known.

A ray of L metres through density sigma and colour c has the colour

    C = integral_0^L T sigma c dt,   T(t) = exp(-integral_0^t sigma).

The kernels take both as constant over each of n steps h = L / n, at the value of one place in it,
(k + place) h: alpha_k = 1 - exp(-sigma_k h). What order follows from that: with u = t - (the step's
middle), sigma = s + s'u + O(u^2), c = c_m + c'u + O(u^2).

- Place 1/2: over a step u has the mean 0, so that its optical depth is off by O(h^3), and what it
  adds to C by the integral of T c' sigma u, where T itself falls by (1 - s u): O(h^3). There are
  L / h steps: order 2. Exact where both are constant.
- Any other place p: sigma and c are those of (p - 1/2) h further on, at every step, which shifts
  the integral's ends and nothing else: an error of (p - 1/2) h times T sigma c at the far end less
  that at the near one, order 1. What begins and ends at nothing, as a head does in front of a
  camera, has no such ends and keeps order 2 wherever the place lies.
- A training's rays draw one p each, evenly: the error of one ray is that of its p, and of the mean
  over p, where the first order is 0, of order 2.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy import special

from ...core import kernels
from ...core.evaluation.report import Claim

LENGTH = 0.1  # metres of ray
STEPS = (8, 16, 32, 64, 128, 256, 512)  # of a ray
_DRAWN = 64  # rays of one medium, each with a place of its own
_NODES, _PANELS = 20, 100  # of the Gauss-Legendre quadrature in float64 that is the truth
_ROUNDING = 3e-6  # below ten times what float32 rounds away no order shows
# float32 holds density, colour, step and weight to 6e-8 each; an optical depth x off by a part e
# changes exp(-x) by x exp(-x) e <= 0.37 e
EXACT = 2.5e-7
_DENSE, _THIN = 60.0, 8.0  # 1/m


def _constant(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.full_like(t, 30.0), 30.0 * t


def _linear(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rise = (_DENSE - _THIN) / LENGTH
    return _THIN + rise * t, _THIN * t + rise * t**2 / 2


def _gaussian(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    middle, deviation, peak = 0.5 * LENGTH, 0.05 * LENGTH, 150.0
    z = (t - middle) / deviation
    area = peak * deviation * np.sqrt(np.pi / 2)
    start = special.erf(-middle / deviation / np.sqrt(2))
    return peak * np.exp(-(z**2) / 2), area * (special.erf(z / np.sqrt(2)) - start)


def _grey(t: np.ndarray) -> np.ndarray:
    return np.repeat(np.array([[0.2, 0.5, 0.9]]), len(t), 0)


def _varying(t: np.ndarray) -> np.ndarray:
    x = t / LENGTH
    return np.stack([0.1 + 0.8 * x, 0.5 + 0.4 * np.sin(9 * x), np.exp(-3 * x)], 1)


# density (1/m) and its integral from 0, by metres along the ray
Medium = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
MEDIA: dict[str, tuple[Medium, Callable[[np.ndarray], np.ndarray]]] = {
    "constant density, constant colour": (_constant, _grey),
    "constant density": (_constant, _varying),
    "linear density": (_linear, _varying),
    "Gaussian density": (_gaussian, _varying),
}
ENDLESS = "Gaussian density"  # begins and ends at nothing
# which place of a step, and the order that follows for what has ends
PLACES = {"middle": 2, "start": 1, "drawn a ray": 1, "mean of drawn": 2}
KERNELS = {
    "plain torch, float64": (True, torch.float64),
    "plain torch, float32": (True, torch.float32),
    "compiled, float32": (False, torch.float32),
}


def truth(name: str) -> np.ndarray:
    """Colour [3] and opacity of a medium, [4] float64."""
    medium, colour = MEDIA[name]
    x, weight = np.polynomial.legendre.leggauss(_NODES)
    t = ((np.arange(_PANELS)[:, None] + (x + 1) / 2) / _PANELS * LENGTH).reshape(-1)
    weight = np.tile(weight, _PANELS) * LENGTH / _PANELS / 2
    sigma, optical = medium(t)
    shown = (weight * sigma * np.exp(-optical))[:, None] * colour(t)
    whole = medium(np.array([LENGTH]))[1][0]
    return np.append(shown.sum(0), -np.expm1(-whole))


def composited(name: str, steps: int, places: np.ndarray, kernel: str) -> np.ndarray:
    """What a kernel makes of a medium: [R, 4] float64, a row for each place [R] in the steps."""
    medium, colour = MEDIA[name]
    reference, kind = KERNELS[kernel]
    rays, delta = len(places), LENGTH / steps
    t = ((np.arange(steps)[None] + places[:, None]) * delta).reshape(-1)
    values = (torch.from_numpy(v).to(kind) for v in (medium(t)[0], colour(t), t))
    index = torch.arange(rays, dtype=torch.int32).repeat_interleave(steps)
    composite = kernels.select("cpu", reference=reference).marching.composite
    found, opacity, _, _ = composite(*values, delta, index, rays)
    return torch.cat([found, opacity[:, None]], 1).double().numpy()


def errors(name: str, place: str, kernel: str) -> list[float]:
    """The largest error of colour and opacity at each of `STEPS`; of drawn places the root mean
    square over rays, or the error of their mean."""
    exact, found = truth(name), []
    drawn = (np.arange(_DRAWN) + 0.5) / _DRAWN
    places = {"middle": np.array([0.5]), "start": np.array([0.0])}.get(place, drawn)
    for steps in STEPS:
        off = composited(name, steps, places, kernel) - exact
        whole = off.mean(0) if place == "mean of drawn" else np.sqrt((off**2).mean(0))
        found.append(float(np.abs(whole).max()))
    return found


def order(steps: list[float], error: list[float], floor: float = 0.0) -> float:
    """The slope of log error over log step, over errors above `floor`; nan for fewer than three."""
    kept = [(s, e) for s, e in zip(steps, error, strict=True) if e > floor]
    if len(kept) < 3:
        return float("nan")
    logarithms = np.log(np.array(kept))
    return float(np.polyfit(logarithms[:, 0], logarithms[:, 1], 1)[0])


def measure() -> tuple[list[dict[str, Any]], list[Claim]]:
    """Rows of errors and fitted orders, and the claims about them."""
    widths, rows = [LENGTH / n for n in STEPS], []
    for kernel in KERNELS:
        floor = 1e-13 if kernel.endswith("64") else _ROUNDING
        for name in MEDIA:
            for place, with_ends in PLACES.items():
                expected = 2 if name == ENDLESS else with_ends
                found = errors(name, place, kernel)
                flat = max(found) < 10 * EXACT  # nothing but rounding
                rows.append(
                    {
                        "kernel": kernel,
                        "medium": name,
                        "place": place,
                        "coarsest": found[0],
                        "finest": found[-1],
                        "order": float("nan") if flat else order(widths[2:], found[2:], floor),
                        "expected": float("nan") if flat else expected,
                        "errors": found,
                    }
                )
    return rows, _claims(rows)


def _claims(rows: list[dict[str, Any]]) -> list[Claim]:
    claims = []
    for kernel in KERNELS:
        own = [r for r in rows if r["kernel"] == kernel]
        gap = max(
            (abs(r["order"] - r["expected"]) for r in own if r["order"] == r["order"]), default=9.9
        )
        claims.append(Claim.at_most(f"order of {kernel}: off the derived", gap, 0.1, ""))
    worst = max(
        error
        for r in rows
        if r["medium"] == "constant density, constant colour" and r["kernel"] == "compiled, float32"
        for error in r["errors"]
    )
    claims.append(
        Claim.at_most("constant medium, compiled: error", worst * 1e6, EXACT * 1e6, "1e-6")
    )
    return claims


def draw(axes: Any, rows: list[dict[str, Any]]) -> None:
    """Errors of the linear medium: each place in float64, and the compiled kernel's middle."""
    widths = [1e3 * LENGTH / n for n in STEPS]
    for row in rows:
        if row["medium"] != "linear density":
            continue
        if row["kernel"] == "plain torch, float64":
            axes.plot(widths, row["errors"], "o-", label=f"{row['place']} ({row['order']:.2f})")
        elif row["kernel"].startswith("compiled") and row["place"] == "middle":
            axes.plot(widths, row["errors"], "k--", label=f"compiled, middle ({row['order']:.2f})")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.legend(title="place (order)", fontsize=8)
