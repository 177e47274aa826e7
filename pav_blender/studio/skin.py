"""The skin: painted in rest space on the refined vertices, detailed by noise that sticks to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .nodes import new_material
from .person import Person


@dataclass(frozen=True)
class SkinLook:
    """Scene-linear colours and strengths of one appearance's skin."""

    base: tuple[float, float, float] = (0.56, 0.335, 0.245)
    lips: tuple[float, float, float] = (0.47, 0.18, 0.15)
    redness: float = 1.0
    mottle: float = 1.0
    freckles: float = 0.0
    lines: float = 0.0  # weathering: darker sockets, folds and coarser bumps
    roughness: float = 0.47
    under_hair: tuple[float, float, float] = (0.1, 0.07, 0.05)
    under_beard: tuple[float, float, float] = (0.2, 0.14, 0.11)


def blob(points: np.ndarray, centre, sigma) -> np.ndarray:
    """A Gaussian weight [N] round `centre`, mirrored to both sides of the face."""
    mirrored = np.concatenate([np.abs(points[:, :1]), points[:, 1:]], axis=1)
    offset = (mirrored - np.abs([centre[0], 0, 0]) - [0, centre[1], centre[2]]) / sigma
    return np.exp(-0.5 * (offset**2).sum(1))


def paint(person: Person, look: SkinLook, hair_mask, beard_mask) -> tuple[np.ndarray, np.ndarray]:
    """Colours [N,3] and roughness [N] of the skin part's vertices (masks are on them too)."""
    skin = person.parts["skin"].vertices
    points, marks = person.fine[skin], person.landmarks
    masks = {name: mask[skin] for name, mask in person.masks.items()}
    eye, nose, mouth, chin = marks.eye, marks.nose, marks.mouth, marks.chin
    colour = np.tile(np.asarray(look.base, np.float32), (len(points), 1))

    cheek = np.array([eye[0] * 1.35, 0.55 * nose[1] + 0.1 * eye[1], eye[2] + 0.004])
    red = 0.55 * blob(points, cheek, (0.017, 0.014, 0.03))
    red += 0.75 * blob(points, nose, (0.012, 0.010, 0.016))
    red += 0.35 * blob(points, chin + np.array([0, 0.012, 0]), (0.014, 0.010, 0.02))
    red += 0.75 * smoothstep(masks["ears"], 0.2, 0.9)
    red += 0.25 * blob(points, eye + np.array([0.0, -0.008, 0.012]), (0.016, 0.006, 0.02))
    colour *= 1 - look.redness * np.clip(red, 0, 1)[:, None] * np.array([0.04, 0.27, 0.24])

    socket = blob(points, eye + np.array([-0.004, -0.013, 0.012]), (0.012, 0.0055, 0.02))
    crease = blob(points, eye + np.array([-0.006, 0.009, 0.012]), (0.014, 0.005, 0.02))
    dark = 0.20 * (1 + look.lines) * socket + 0.22 * crease
    fold = blob(points, [0.021, 0.5 * (nose[1] + mouth[1]), nose[2] - 0.017], (0.006, 0.012, 0.02))
    dark += 0.22 * look.lines * fold
    colour *= 1 - np.clip(dark, 0, 1)[:, None] * np.array([0.55, 0.8, 0.75])

    lips = smoothstep(masks["lips"], 0.35, 0.65) * (np.abs(points[:, 0]) < marks.mouth_half * 1.15)
    colour = blend(colour, look.lips, 0.85 * lips)
    beard = np.clip(beard_mask * (1 - lips), 0, 1)
    colour = blend(colour, look.under_beard, beard)
    colour = blend(colour, look.under_hair, np.clip(hair_mask, 0, 1))
    inside = smoothstep(masks["mouth_interior"], 0.3, 0.8)
    colour = blend(colour, (0.30, 0.075, 0.065), inside)

    rough = np.full(len(points), look.roughness, np.float32)
    rough -= 0.10 * blob(points, nose, (0.012, 0.02, 0.02))
    rough -= 0.08 * blob(points, [0.0, eye[1] + 0.04, nose[2]], (0.03, 0.02, 0.06))
    rough = rough + (0.30 - rough) * lips
    rough = rough + (0.22 - rough) * inside
    rough = rough + (0.75 - rough) * np.clip(hair_mask, 0, 1)
    return np.clip(colour, 0, 1).astype(np.float32), rough.astype(np.float32)


def blend(colour: np.ndarray, other, weight: np.ndarray) -> np.ndarray:
    return colour + weight[:, None] * (np.asarray(other) - colour)


def smoothstep(value, low: float, high: float) -> np.ndarray:
    t = np.clip((np.asarray(value) - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def skin_material(look: SkinLook):
    """Reads the vertex attributes `paint`, `rough` and `rest`."""
    material, graph = new_material("studio skin")
    rest = graph.attribute("rest").outputs[1]
    colour = graph.attribute("paint").outputs[0]
    # three octaves of mottle: blotches of 2 cm, patches of 5 mm, pores
    for scale, depth in ((45.0, 0.10), (180.0, 0.11), (700.0, 0.12)):
        noise = graph.noise(rest, scale, 1.0)
        low, high = 1 - depth * look.mottle, 1 + 0.7 * depth * look.mottle
        span = graph.add("MapRange", _0=noise, _1=0.25, _2=0.75, _3=low, _4=high)
        tint = graph.add("CombineColor", Red=1.0)
        softened = graph.math("POWER", span.outputs[0], 0.6)
        graph.feed(tint, "Red", softened)
        graph.feed(tint, "Green", span.outputs[0])
        graph.feed(tint, "Blue", span.outputs[0])
        colour = graph.mix(1.0, colour, tint.outputs[0], "MULTIPLY")
    if look.freckles > 0:
        spots = graph.smooth(graph.noise(rest, 420.0, 0.0), 0.62, 0.72)
        zone = graph.attribute("freckle").outputs[2]
        spots = graph.math("MULTIPLY", graph.math("MULTIPLY", spots, zone), look.freckles)
        colour = graph.mix(spots, colour, (0.26, 0.10, 0.05))
    height = graph.math(
        "ADD", graph.noise(rest, 850.0, 2.0), graph.math("MULTIPLY", graph.noise(rest, 230.0), 1.2)
    )
    graph.principled(
        Base_Color=colour,
        Roughness=graph.attribute("rough").outputs[2],
        Specular_IOR_Level=0.42,
        Normal=graph.bump(height, 0.20 + 0.15 * look.lines, 0.0010),
    )
    return material
