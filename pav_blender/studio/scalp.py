"""Hair styles: where scalp hair grows, which way and how long. Fields take rest points [N,3]."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .hair import Growth, HairColour, Roots, clump, grow, sample_roots, tints, wave
from .person import Person, Surface
from .skin import smoothstep

# the hairline: height above the eyes (in units of eye-to-crown) against the azimuth round the head
_AZIMUTH = (0, 14, 26, 38, 50, 62, 70, 76, 82, 88, 100, 112, 125, 150, 180)
_HEIGHT = (0.56, 0.57, 0.59, 0.55, 0.43, 0.30, 0.20, -0.02, -0.24, 0.02, 0.16, 0.02, -0.30, -0.52,
           -0.56)  # fmt: skip


@dataclass(frozen=True)
class ScalpStyle:
    """A style by name with its numbers; lengths and radii in metres."""

    kind: str  # "crop", "long", "fringe", "buzz", "bun"
    colour: HairColour
    strands: int
    steps: int
    radius: float
    length: float
    clump_size: int = 14
    clumping: float = 0.55
    wave: float = 0.0
    recede: float = 0.0


def hairline(person: Person, recede: float = 0.0):
    """The scalp as a soft mask function of rest points."""
    marks = person.landmarks
    unit = float(marks.top[1] - marks.eye[1])
    centre = float(marks.ear[2] + 0.010)
    ears = person.fine[person.masks["ears"] > 0.5]
    box_low, box_high = np.abs(ears[:, 0]).min() + 0.002, ears[:, 1].max() - 0.004

    def mask(points: np.ndarray) -> np.ndarray:
        x, y, z = points.T
        azimuth = np.degrees(np.arctan2(np.abs(x), z - centre))
        line = np.interp(azimuth, _AZIMUTH, _HEIGHT)
        line = line + recede * np.interp(azimuth, (0, 25, 45, 60), (0.6, 1.0, 1.0, 0.0))
        wobble = 0.012 * np.sin(730 * x + 210 * z) + 0.010 * np.sin(1490 * x - 900 * z)
        inside = smoothstep((y - marks.eye[1]) / unit - line + wobble, -0.02, 0.05)
        on_ear = (np.abs(x) > box_low + 0.004) & (y < box_high) & (np.abs(z - marks.ear[2]) < 0.022)
        return inside * ~on_ear

    return mask


def crop_field(person: Person):
    """Swept up and over from a left parting on top, down and back on the sides."""
    marks = person.landmarks

    def field(points: np.ndarray) -> np.ndarray:
        x, y, z = points.T
        top = smoothstep(y, marks.eye[1] + 0.055, marks.eye[1] + 0.085)
        front = smoothstep(z, -0.07, 0.0)
        over = np.stack([-0.8 + 0 * x, 0.10 + 0.6 * front, -0.25 + 0.55 * front], 1)
        side = np.stack([0.05 * np.sign(x), -0.85 + 0 * x, -0.35 + 0 * x], 1)
        return top[:, None] * over + (1 - top)[:, None] * side

    return field


def long_field(person: Person, part: float = 0.018):
    """Combed away from a parting, back over the ears, then down."""
    marks = person.landmarks

    def field(points: np.ndarray) -> np.ndarray:
        x, y, z = points.T
        side = np.tanh((x - part) / 0.012)
        height = smoothstep(y, marks.eye[1] - 0.01, marks.top[1])
        front = smoothstep(z, marks.ear[2] - 0.01, marks.ear[2] + 0.07)
        out = side * (0.25 + 0.75 * height)
        back = -0.30 - 0.75 * front
        return np.stack([out, -0.9 + 0.75 * height, back], 1)

    return field


def fringe_field(person: Person):
    """Falls on all sides from a crown, forward over the brow."""
    marks = person.landmarks
    crown = np.array([0.008, marks.top[1], marks.ear[2] - 0.028])

    def field(points: np.ndarray) -> np.ndarray:
        away = points - crown
        away[:, 1] *= 0.25
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6)
        low = smoothstep(points[:, 1], marks.top[1] - 0.015, marks.eye[1] + 0.03)
        whorl = np.stack([-away[:, 2], 0 * away[:, 0], away[:, 0]], 1)
        fall = np.stack([0.25 * away[:, 0], -1 + 0 * away[:, 0], 0.25 * away[:, 2]], 1)
        return (1 - low)[:, None] * (away + 0.35 * whorl) + low[:, None] * fall

    return field


def bun_field(person: Person):
    """Pulled back and up to a knot at the back of the head."""
    knot = knot_centre(person)

    def field(points: np.ndarray) -> np.ndarray:
        away = knot - points
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6)
        return away + np.array([0.0, 0.1, 0.0])

    return field


def knot_centre(person: Person) -> np.ndarray:
    marks = person.landmarks
    return np.array([0.0, marks.eye[1] + 0.078, marks.back[2] - 0.004])


def style_scalp(
    person: Person, style: ScalpStyle, surface: Surface, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Strands [S,P,3] in rest space and their colours [S,3]."""
    mask = hairline(person, style.recede)
    roots = sample_roots(person, mask, style.strands, rng)
    length = _lengths(person, style, roots, rng)
    build = {"crop": crop_field, "buzz": crop_field, "long": long_field,
             "fringe": fringe_field, "bun": bun_field}[style.kind]  # fmt: skip
    growth = {
        "crop": Growth(0.55, 0.014, 0.30, (0.001, 0.018), 0.16),
        "buzz": Growth(0.8, 0.0, 0.1, (0.0, 0.0)),
        "long": Growth(0.22, 0.15, 0.20, (0.002, 0.016), 0.06),
        "fringe": Growth(0.10, 0.16, 0.30, (0.0015, 0.011), 0.07),
        "bun": Growth(0.10, 0.0, 0.9, (0.0015, 0.006), 0.03),
    }[style.kind]
    strands = grow(roots, length, style.steps, growth, build(person), surface, rng)
    strands, clumps = clump(strands, style.clump_size, style.clumping, rng)
    if style.wave:
        strands = wave(strands, clumps, style.wave, 0.075, rng)
    return strands, tints(style.colour, clumps, len(strands), rng)


def _lengths(person: Person, style: ScalpStyle, roots: Roots, rng) -> np.ndarray:
    marks = person.landmarks
    x, y, z = roots.points.T
    length = style.length * rng.uniform(0.78, 1.0, len(x))
    if style.kind == "crop":
        top = smoothstep(y, marks.eye[1] + 0.035, marks.eye[1] + 0.085)
        low = smoothstep(y, marks.eye[1] + 0.01, marks.eye[1] - 0.05)
        length = length * (0.30 + 0.70 * top) * (1 - 0.5 * low)
    if style.kind == "fringe":
        front = smoothstep(z, marks.ear[2] + 0.03, marks.ear[2] + 0.08)
        high = smoothstep(y, marks.eye[1] + 0.05, marks.eye[1] + 0.07)
        length = length * (1 - 0.35 * front * high)
    if style.kind == "long":
        length = length * (0.80 + 0.20 * smoothstep(z, marks.ear[2] + 0.06, marks.ear[2]))
    if style.kind == "bun":
        length = np.linalg.norm(roots.points - knot_centre(person), axis=1) * 1.12
    return length
