"""Growing hair in rest space: roots on the skin, steps along a field, clumps, waves and tints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from .nodes import new_material
from .person import Person, Surface

Field = Callable[[np.ndarray], np.ndarray]


@dataclass(eq=False)
class Roots:
    """Points on the skin part's quads: corner indices [S,3] of a half quad and barycentrics."""

    corners: np.ndarray
    weights: np.ndarray
    points: np.ndarray
    normals: np.ndarray

    def pick(self, rows: np.ndarray) -> Roots:
        return Roots(self.corners[rows], self.weights[rows], self.points[rows], self.normals[rows])


@dataclass(frozen=True)
class HairColour:
    """Scene-linear; a strand mixes `dark` and `light` at random, `grey` of them are `grey_tone`."""

    dark: tuple[float, float, float]
    light: tuple[float, float, float]
    grey: float = 0.0
    grey_tone: tuple[float, float, float] = (0.55, 0.55, 0.56)
    roughness: float = 0.42


def sample_roots(person: Person, weight: Field, count: int, rng: np.random.Generator) -> Roots:
    """`count` roots spread over the skin in proportion to area times `weight` (0..1)."""
    part = person.parts["skin"]
    points = person.fine[part.vertices]
    normals = person.normals[part.vertices]
    halves = np.concatenate([part.quads[:, [0, 1, 2]], part.quads[:, [0, 2, 3]]])
    a, b, c = (points[halves[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    # a face counts when it may carry hair anywhere near its middle
    area = area * (weight((a + b + c) / 3) > 1e-3)
    chosen: list[Roots] = []
    found = 0
    while found < count:
        face = rng.choice(len(halves), 2 * count, p=area / area.sum())
        u, v = np.sqrt(rng.random(2 * count)), rng.random(2 * count)
        bary = np.stack([1 - u, u * (1 - v), u * v], axis=1)
        root = Roots(halves[face], bary, _at(points, halves[face], bary),
                     _unit(_at(normals, halves[face], bary)))  # fmt: skip
        keep = np.flatnonzero(rng.random(2 * count) < weight(root.points))
        chosen.append(root.pick(keep))
        found += len(keep)
    fields = ("corners", "weights", "points", "normals")
    return Roots(*(np.concatenate([getattr(r, f) for r in chosen])[:count] for f in fields))


def _at(values: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return (values[corners] * weights[..., None]).sum(1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def tangent(direction: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """`direction` flattened onto the surface, unit length."""
    along = (direction * normals).sum(-1, keepdims=True)
    return _unit(direction - along * normals)


@dataclass(frozen=True)
class Growth:
    """How strands leave the skin and bend."""

    lift: float  # 0: along the skin, 1: as much outwards as along
    gravity: float  # pull per centimetre of length
    comb: float  # how strongly each step follows the field
    clearance: tuple[float, float]  # metres kept from the skin, root and tip
    jitter: float = 0.12


def grow(
    roots: Roots, length: np.ndarray, steps: int, growth: Growth, field: Field,
    surface: Surface, rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """Strands [S,steps,3] of `length` [S] metres that follow the direction `field(points)`."""
    count = len(roots.points)
    segment = length / (steps - 1)
    heading = tangent(field(roots.points), roots.normals) + growth.lift * roots.normals
    heading = _unit(heading + rng.normal(0, growth.jitter, (count, 3)))
    strands = np.empty((count, steps, 3), np.float32)
    strands[:, 0] = roots.points - 0.0008 * roots.normals
    point = roots.points
    low, high = growth.clearance
    depth = rng.random(count) ** 0.7  # each strand keeps its own layer of the hair
    for k in range(1, steps):
        share = k / (steps - 1)
        pull = growth.gravity * 100 * segment[:, None] * np.array([0.0, -1.0, 0.0])
        heading = _unit(heading + growth.comb * field(point) + pull)
        step = point + segment[:, None] * heading
        step = surface.push_out(step, low + (high - low) * share * depth)
        heading = _unit(0.35 * heading + 0.65 * _unit(step - point))
        point = point + segment[:, None] * _unit(step - point)
        strands[:, k] = point
    return strands


def clump(
    strands: np.ndarray, group: int, strength: float, rng: np.random.Generator, spread=0.0025
) -> tuple[np.ndarray, np.ndarray]:
    """Draw strands towards every `group`-th one, more at the tips; also the clump's number [S]."""
    guides = rng.permutation(len(strands))[: max(len(strands) // group, 1)]
    _, nearest = cKDTree(strands[guides, 0]).query(strands[:, 0])
    share = np.linspace(0, 1, strands.shape[1])[None, :, None] ** 1.3
    offset = strands[:, :1] - strands[guides][nearest][:, :1]
    wander = np.clip(offset, -spread, spread)
    target = strands[guides][nearest] + wander
    pull = strength * share * rng.uniform(0.6, 1.15, (len(strands), 1, 1))
    return (strands + np.clip(pull, 0, 0.97) * (target - strands)).astype(np.float32), nearest


def wave(
    strands: np.ndarray, clumps: np.ndarray, amplitude: float, wavelength: float, rng
) -> np.ndarray:
    """Bend strands sideways in waves that a clump shares."""
    count = len(strands)
    pace = np.linalg.norm(np.diff(strands, axis=1), axis=2)
    arc = np.concatenate([np.zeros((count, 1)), np.cumsum(pace, 1)], axis=1)
    number = clumps.max() + 1
    phase = rng.uniform(0, 2 * np.pi, number)[clumps] + rng.normal(0, 0.25, count)
    stretch = rng.uniform(0.8, 1.25, number)[clumps]
    heading = _unit(np.gradient(strands, axis=1))
    outward = strands - np.array([0.0, 0.0, -0.07])
    outward[..., 1] = 0
    side = _unit(np.cross(heading, _unit(outward)))
    swing = np.sin(2 * np.pi * arc / wavelength * stretch[:, None] + phase[:, None])
    grown = np.clip(arc / (1.2 * wavelength), 0, 1)
    return (strands + (amplitude * grown * swing)[..., None] * side).astype(np.float32)


def taper(root: float, steps: int, tip: float = 0.25) -> np.ndarray:
    """Radii [steps] in metres from `root` to `tip * root`."""
    along = np.linspace(0, 1, steps)
    return (root * (1 - (1 - tip) * along**1.6)).astype(np.float32)


def tints(colour: HairColour, clumps: np.ndarray | None, count: int, rng) -> np.ndarray:
    """A colour [S,3] for every strand: mostly its clump's, a little its own."""
    own = rng.random(count)
    mixed = own if clumps is None else 0.45 * own + 0.55 * rng.random(clumps.max() + 1)[clumps]
    out = np.asarray(colour.dark) + mixed[:, None] * np.subtract(colour.light, colour.dark)
    turned = rng.random(count) < colour.grey
    out[turned] = np.asarray(colour.grey_tone) * rng.uniform(0.55, 1.1, (turned.sum(), 1))
    return out.astype(np.float32)


def hair_material(colour: HairColour):
    """Reads the strand attribute `tint`; roots are darker than tips."""
    material, graph = new_material("studio hair")
    along = graph.attribute("along").outputs[2]
    depth = graph.add("MapRange", _0=along, _1=0.0, _2=0.7, _3=0.55, _4=1.05).outputs[0]
    base = graph.mix(1.0, graph.attribute("tint").outputs[0], depth, "MULTIPLY")
    graph.principled(
        Base_Color=base,
        Roughness=colour.roughness,
        Specular_IOR_Level=0.32,
    )
    return material
