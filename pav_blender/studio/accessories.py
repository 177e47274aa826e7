"""Glasses, earrings and a woolly hat, in rest space; they ride on the head."""

from __future__ import annotations

import numpy as np

from .nodes import new_material
from .objects import mesh_object
from .person import Person
from .shapes import grid, join, sweep


def glasses(person: Person, colour, label: int, round_rims: bool = False) -> list:
    """Rims, bridge, pads and temples as tubes; no lenses, whose glints the denoiser smears."""
    marks = person.landmarks
    eye, bridge = marks.eye, marks.bridge
    half_width, half_height = 0.0245, (0.0225 if round_rims else 0.0195)
    centre = np.array([eye[0] + 0.0035, eye[1] - 0.003, max(bridge[2] - 0.004, eye[2] + 0.0215)])
    power = 2.0 if round_rims else 2.9
    turn = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    c, s = np.cos(turn), np.sin(turn)
    shape_x = half_width * np.sign(c) * np.abs(c) ** (2 / power)
    shape_y = half_height * np.sign(s) * np.abs(s) ** (2 / power)
    hinge = np.array([centre[0] + half_width + 0.006, centre[1] + 0.010, centre[2] - 0.012])
    ear = np.array([abs(marks.ear_top[0]) - 0.004, marks.ear_top[1] - 0.002, marks.ear[2] + 0.006])
    pieces = []
    for side in (-1, 1):
        mirror = np.array([side, 1, 1])
        bow = -0.010 * ((shape_x / half_width + 0.2).clip(0, 2) / 1.2) ** 2
        rim = np.stack([centre[0] + shape_x, centre[1] + shape_y, centre[2] + bow], axis=1)
        pieces.append(sweep(rim * mirror, 0.00115, 8, closed=True))
        start = rim[np.argmax(shape_x + 0.8 * shape_y)]
        bend = ear + np.array([0.001, -0.004, -0.012])
        tip = ear + np.array([-0.004, -0.030, -0.022])
        half_way = 0.5 * (hinge + ear) + np.array([0.003, 0, 0])
        temple = bezier(np.array([start, hinge, half_way, ear, bend, tip]))
        pieces.append(sweep(temple * mirror, 0.0013, 8, flatten=1.6))
        pad = np.array([0.0085, eye[1] - 0.008, bridge[2] - 0.006])
        wire = bezier(np.array([[centre[0] - half_width + 0.002, eye[1] - 0.006, centre[2]],
                                pad + np.array([0.003, 0.001, -0.004]), pad]))  # fmt: skip
        pieces.append(sweep(wire * mirror, 0.0006, 6))
    inner = centre[0] - half_width + 0.001
    span = np.linspace(-1, 1, 16)
    nose = np.stack([inner * span, centre[1] + 0.0045 + 0.004 * (1 - span**2),
                     centre[2] + 0.002 * (1 - span**2)], axis=1)  # fmt: skip
    pieces.append(sweep(nose, 0.00125, 8))
    frame, graph = new_material("studio frame")
    graph.principled(Base_Color=colour, Roughness=0.25, Metallic=0.2, Coat_Weight=0.5)
    return [_worn("studio glasses", join(*pieces), frame, label)]


def bezier(points: np.ndarray, count: int = 40) -> np.ndarray:
    """A smooth path near control points: the uniform B-spline through the first and the last."""
    control = np.concatenate([[2 * points[0] - points[1]], points, [2 * points[-1] - points[-2]]])
    where = np.linspace(0, len(points) - 1 - 1e-9, count)
    k, t = where.astype(int), (where % 1)[:, None]
    a, b, c, d = (control[np.minimum(k + i, len(control) - 1)] for i in range(4))
    basis = ((1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3)
    return (basis[0] * a + basis[1] * b + basis[2] * c + basis[3] * d) / 6


def earrings(person: Person, label: int, radius: float = 0.0075) -> list:
    """Gold hoops through the lobes."""
    ears = person.fine[person.masks["ears"] > 0.5]
    left = ears[ears[:, 0] > 0]
    low = left[left[:, 1] < left[:, 1].min() + 0.010]
    lobe = np.array([low[:, 0].mean(), low[:, 1].min() + 0.004, low[:, 2].mean()])
    turn = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    hoop = np.stack([0.15 * radius * np.sin(turn), radius * np.cos(turn) - radius + 0.001,
                     radius * np.sin(turn)], axis=1)  # fmt: skip
    pieces = [sweep((lobe + hoop) * [side, 1, 1], 0.0010, 8, closed=True) for side in (-1, 1)]
    gold, graph = new_material("studio gold")
    graph.principled(Base_Color=(0.83, 0.58, 0.2), Metallic=1.0, Roughness=0.2)
    return [_worn("studio earrings", join(*pieces), gold, label)]


def beanie(person: Person, colour, label: int) -> list:
    """A ribbed hat: rings round the skull from a folded cuff to the crown."""
    marks = person.landmarks
    skin = person.fine[person.parts["skin"].vertices]
    ears = person.masks["ears"][person.parts["skin"].vertices] > 0.3
    skull = skin[~ears & (skin[:, 1] > marks.eye[1] - 0.03)]
    centre = np.array([0.0, marks.eye[1] + 0.02, 0.5 * (marks.eye[2] + marks.back[2]) + 0.004])
    offset = skull - centre
    reach = np.linalg.norm(offset, axis=1)
    heading = offset / reach[:, None]
    azimuth = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    front_height, back_height = marks.eye[1] + 0.040, marks.eye[1] - 0.012
    rows = []
    levels = np.concatenate([np.linspace(0, 0.25, 8), np.linspace(0.3, 1.0, 22)])
    for level in levels:
        toward = np.stack([np.sin(azimuth), 0 * azimuth, np.cos(azimuth)], 1)
        tilt = 0.5 * (front_height - back_height)
        rim = 0.5 * (front_height + back_height) + tilt * np.cos(azimuth)
        low = np.arctan2(rim - centre[1], 0.088)
        elevation = low + (np.pi / 2 - low) * level
        ray = toward * np.cos(elevation)[:, None] + np.array([0, 1, 0]) * np.sin(elevation)[:, None]
        weight = np.exp((ray @ heading.T - 1) / 0.004)
        radius = (weight * reach).sum(1) / weight.sum(1)
        slouch = 0.012 * np.clip((level - 0.3) / 0.7, 0, 1)
        cuff = 0.006 * (level < 0.26)
        ridge = 0.0009 * np.sin(60 * azimuth) * (1 - level)
        rows.append(centre + ray * (radius + 0.0065 + cuff + slouch + ridge)[:, None])
    inner = centre + (rows[0] - centre) * 0.95
    mesh = grid(np.stack([inner, *rows], axis=1).transpose(1, 0, 2), closed_columns=True)
    wool, graph = new_material("studio wool")
    rest = graph.attribute("rest").outputs[1]
    bump = graph.bump(graph.noise(rest, 700.0, 2.0), 0.7, 0.0016)
    shade = graph.add("MapRange", _0=graph.noise(rest, 260.0), _1=0.3, _2=0.7, _3=0.7, _4=1.2)
    base = graph.mix(1.0, colour, shade.outputs[0], "MULTIPLY")
    graph.principled(Base_Color=base, Roughness=0.95, Normal=bump, Sheen_Weight=0.4)
    return [_worn("studio hat", mesh, wool, label)]


def _worn(name: str, mesh: tuple[np.ndarray, np.ndarray], material, label: int):
    return mesh_object(name, mesh[0], mesh[1], material, label=label, rest=mesh[0])
