"""The shape, the keys, the bones and the paint of the formula head, core axes, metres.

Everything is a function of the direction [V, 3] in which a vertex of the unit ball lies.
"""

from __future__ import annotations

import numpy as np

HALF = np.array([0.074, 0.112, 0.094])  # the skull's half axes
HINGE = np.array([0.0, -0.025, 0.005])  # of the jaw, metres
NECK = np.array([0.0, -0.105, -0.02])
MOUTH = -0.43  # height of the mouth's line on the ball

BONES = {  # name: parent, head
    "spine": (None, np.array([0.0, -0.2, -0.02])),
    "skull": ("spine", NECK),
    "chin": ("skull", HINGE),
}
# ours: what the bones are called here
JOINTS = {"root": "spine", "neck": "skull", "jaw": "chin"}


def _bump(d: np.ndarray, centre: tuple[float, float, float], width: tuple[float, float]):
    """1 at a direction, falling to 0 sideways and up and down by a Gaussian of two widths."""
    away = d - np.array(centre) / np.linalg.norm(centre)
    across, up = np.hypot(away[:, 0], away[:, 2]) / width[0], away[:, 1] / width[1]
    return np.exp(-(across**2) - up**2)


def _pair(d: np.ndarray, centre: tuple[float, float, float], width: tuple[float, float]):
    return _bump(d, centre, width) + _bump(d * (-1, 1, 1), centre, width)


def _step(x: np.ndarray, low: float, high: float) -> np.ndarray:
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def rest(d: np.ndarray) -> np.ndarray:
    """Vertices of the head at rest."""
    push = 0.030 * _bump(d, (0, -0.17, 1), (0.10, 0.13))  # nose
    push += 0.014 * _bump(d, (0, 0.02, 1), (0.06, 0.16))  # its bridge
    push += 0.006 * _pair(d, (0.36, 0.28, 0.9), (0.25, 0.07))  # brows
    push -= 0.012 * _pair(d, (0.36, 0.10, 0.92), (0.16, 0.10))  # sockets
    push += 0.007 * _pair(d, (0.36, 0.10, 0.92), (0.07, 0.06))  # eyes
    push += 0.007 * _bump(d, (0, MOUTH + 0.05, 0.9), (0.22, 0.04))  # lips
    push += 0.007 * _bump(d, (0, MOUTH - 0.05, 0.9), (0.20, 0.04))
    push += 0.016 * _bump(d, (0, -0.72, 0.75), (0.25, 0.14))  # chin
    push += 0.022 * _pair(d, (1, -0.02, -0.12), (0.07, 0.22))  # ears
    push -= 0.006 * _pair(d, (0.75, -0.35, 0.6), (0.25, 0.2))  # cheeks fall in
    points = d * (HALF + push[:, None])
    around = np.hypot(d[:, 0], d[:, 2])
    down = (d[:, 1] < 0) * (1 - _step(around, 0.35, 0.75)) * (d[:, 2] < 0.52)
    flat = np.stack([d[:, 0], d[:, 2]], 1) / np.maximum(around, 1e-6)[:, None]
    radius = 0.052 * np.minimum(1, around / 0.3)
    neck = np.stack(
        [flat[:, 0] * radius, -0.09 - 0.12 * _step(0.75 - around, 0, 0.45),
         flat[:, 1] * radius - 0.02], 1,
    )  # fmt: skip
    return points * (1 - down[:, None]) + neck * down[:, None]


def below_mouth(d: np.ndarray) -> np.ndarray:
    """How far a vertex goes with the jaw [V]."""
    front = _step(d[:, 2], -0.15, 0.45)
    line = _step(-d[:, 1], -MOUTH - 0.02, -MOUTH + 0.03)
    far = _step(-d[:, 1], -MOUTH - 0.02, -MOUTH + 0.5)
    lips = _bump(d, (0, MOUTH, 0.9), (0.3, 1.0))
    throat = 1 - _step(np.hypot(d[:, 0], d[:, 2]) * -1, -0.5, -0.2)
    return front * (line * lips + far * (1 - lips)) * throat


def weights(d: np.ndarray) -> dict[str, np.ndarray]:
    """Of each bone [V]."""
    skull = _step(rest(d)[:, 1], -0.19, -0.11)
    chin = 0.9 * below_mouth(d) * skull
    return {"spine": 1 - skull, "skull": skull - chin, "chin": chin}


def keys(d: np.ndarray) -> dict[str, np.ndarray]:
    """Vertices with each key at 1."""
    base = rest(d)
    angle = np.radians(18) * below_mouth(d)
    y, z = (base - HINGE)[:, 1:].T
    opened = base.copy()
    opened[:, 1] = HINGE[1] + y * np.cos(angle) - z * np.sin(angle)
    opened[:, 2] = HINGE[2] + y * np.sin(angle) + z * np.cos(angle)
    corner = _pair(d, (0.26, MOUTH, 0.86), (0.14, 0.10))[:, None]
    brows = _pair(d, (0.36, 0.28, 0.9), (0.3, 0.14))[:, None]
    outward = np.sign(d[:, :1]) * np.array([1.0, 0, 0])
    return {
        "jawOpen": opened,
        "smile": base + corner * (0.009 * outward + np.array([0, 0.009, -0.004])),
        "browUp": base + brows * np.array([0, 0.010, 0.001]),
    }


def regions(d: np.ndarray) -> dict[str, np.ndarray]:
    """Painted vertex groups [V]: weights by region."""
    hair = hairline(d)
    face = (d[:, 2] > 0.25) & (d[:, 1] < 0.55) & (d[:, 1] > -0.85) & (hair < 0.5)
    lips = _bump(d, (0, MOUTH, 0.9), (0.2, 0.09)) > 0.5
    return {"face": face * 1.0, "scalp": (hair > 0.5) * 1.0, "lips": lips * 1.0}


def hairline(d: np.ndarray) -> np.ndarray:
    """1 where hair grows."""
    return _step(d[:, 1] - 0.75 * np.clip(d[:, 2], 0, 1) + 0.25 * np.abs(d[:, 0]), -0.12, -0.02)


def paint(d: np.ndarray, look: int) -> np.ndarray:
    """Colours [V, 3] in [0, 1] of one of two looks."""
    skin = np.array([[0.86, 0.65, 0.53], [0.55, 0.72, 0.50]][look])
    colour = np.tile(skin, (len(d), 1)) * (
        1 + 0.05 * np.sin(37 * d[:, :1]) * np.sin(41 * d[:, 1:2])
    )

    def cover(amount: np.ndarray, tone: list[float]) -> None:
        nonlocal colour
        amount = np.clip(amount, 0, 1)[:, None]
        colour = colour * (1 - amount) + np.array(tone) * amount

    cover(1.6 * _pair(d, (0.6, -0.3, 0.75), (0.3, 0.25)) - 0.8, [0.88, 0.5, 0.45])
    cover(3 * _bump(d, (0, MOUTH, 0.9), (0.2, 0.09)) - 1, [0.68, 0.25, 0.26])
    cover(6 * _bump(d, (0, MOUTH, 0.9), (0.2, 0.014)) - 3, [0.25, 0.06, 0.07])
    cover(6 * _pair(d, (0.36, 0.10, 0.92), (0.13, 0.055)) - 2, [0.95, 0.95, 0.93])
    cover(12 * _pair(d, (0.36, 0.10, 0.92), (0.055, 0.055)) - 5, [0.12, 0.2, 0.3])
    cover(5 * _pair(d, (0.36, 0.29, 0.9), (0.17, 0.03)) - 2, [0.18, 0.12, 0.09])
    streaks = 0.75 + 0.25 * np.sin(60 * np.arctan2(d[:, 0], d[:, 2] - 0.2))
    tone = np.array([[0.25, 0.14, 0.08], [0.75, 0.25, 0.55]][look])
    hair = hairline(d)[:, None]
    return np.clip(colour * (1 - hair) + tone * streaks[:, None] * hair, 0, 1)


def grown(d: np.ndarray, posed: np.ndarray, normals: np.ndarray, look: int) -> np.ndarray:
    """What stands off the tracked mesh: the second look's hair, 14 mm and more."""
    if look == 0:
        return posed
    height = 0.014 + 0.006 * np.sin(23 * d[:, 0]) * np.sin(19 * d[:, 2])
    return posed + (hairline(d) * height)[:, None] * normals
