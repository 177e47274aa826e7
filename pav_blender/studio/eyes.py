"""Eyeballs, teeth and tongue."""

from __future__ import annotations

import numpy as np

from .nodes import new_material
from .objects import mesh_object
from .person import Part, Person

IRIS_OUTER = (0.055, 0.10, 0.115)
IRIS_INNER = (0.16, 0.13, 0.06)


def eye_object(person: Person, name: str, material, label: int):
    """The eyeball `name` with the rest direction of every vertex as seen from its centre."""
    part = person.parts[name]
    rest = person.fine[part.vertices]
    offset = rest - person.joints[person.head.joint_names.index(name)]
    return mesh_object(f"studio {name}", rest, part.quads, material, label=label, gaze=offset)


def eye_material():
    """Shaded by the angle from the rest axis: pupil, iris with fibres, limbus, veined sclera."""
    material, graph = new_material("studio eye")
    offset = graph.attribute("gaze").outputs[1]
    direction = graph.add("VectorMath", {"operation": "NORMALIZE"}, _0=offset).outputs[0]
    axis = graph.add("VectorMath", {"operation": "DOT_PRODUCT"}, _0=direction, _1=(0, 0, 1))
    angle = graph.math("ARCCOSINE", graph.math("MINIMUM", axis.outputs["Value"], 0.99999))
    flat = graph.add("VectorMath", {"operation": "MULTIPLY"}, _0=direction, _1=(1, 1, 0)).outputs[0]
    around = graph.add("VectorMath", {"operation": "NORMALIZE"}, _0=flat).outputs[0]

    fibres = graph.noise(around, 9.0, 3.0)
    iris = graph.mix(graph.smooth(angle, 0.40, 0.20), IRIS_OUTER, IRIS_INNER)
    streak = graph.add("MapRange", _0=fibres, _1=0.3, _2=0.7, _3=0.55, _4=1.9).outputs[0]
    iris = graph.mix(1.0, iris, streak, "MULTIPLY")
    iris = graph.mix(graph.smooth(angle, 0.34, 0.43), iris, (0.012, 0.016, 0.02))
    iris = graph.mix(graph.smooth(angle, 0.19, 0.165), iris, (0.002, 0.002, 0.002))

    white = graph.mix(graph.smooth(angle, 0.6, 1.35), (0.66, 0.61, 0.575), (0.55, 0.30, 0.26))
    veins = graph.smooth(graph.noise(direction, 14.0, 4.0), 0.56, 0.66)
    red = graph.math("MULTIPLY", veins, graph.smooth(angle, 0.55, 1.2))
    white = graph.mix(graph.math("MULTIPLY", red, 0.4), white, (0.5, 0.16, 0.13))
    graph.principled(
        Base_Color=graph.mix(graph.smooth(angle, 0.425, 0.475), iris, white),
        Roughness=0.35,
        Specular_IOR_Level=0.3,
        Coat_Weight=1.0,
        Coat_Roughness=0.015,
        Coat_IOR=1.38,
    )
    return material


def tooth_object(person: Person, name: str, material, label: int):
    part: Part = person.parts[name]
    rest = person.fine[part.vertices]
    return mesh_object(f"studio {name}", rest, part.quads, material, label=label, rest=rest)


def tooth_material(person: Person, name: str):
    """Gaps between teeth by the arc along the row, gum where the row meets the jaw."""
    rest = person.fine[person.parts[name].vertices]
    low, high = float(rest[:, 1].min()), float(rest[:, 1].max())
    upper = name == "upper_teeth"
    material, graph = new_material(f"studio {name}")
    spread = graph.add("SeparateXYZ", Vector=graph.attribute("rest").outputs[1])
    x, y, z = spread.outputs[0], spread.outputs[1], spread.outputs[2]
    back = float(rest[:, 2].min())
    # arc length along the row, near enough an angle about a point behind the front teeth
    turn = graph.math("ARCTAN2", x, graph.math("SUBTRACT", z, back + 0.012))
    wave = graph.math("ABSOLUTE", graph.math("SINE", graph.math("MULTIPLY", turn, 5.5 * np.pi / 2)))
    gap = graph.smooth(wave, 0.16, 0.02)
    edge = (low + 0.42 * (high - low), low + 0.62 * (high - low))
    gum = graph.smooth(y, *(edge if upper else (high - edge[0] + low, high - edge[1] + low)))
    tooth = graph.mix(gap, (0.74, 0.68, 0.57), (0.32, 0.24, 0.17))
    graph.principled(
        Base_Color=graph.mix(gum, tooth, (0.44, 0.13, 0.12)), Roughness=0.18, Coat_Weight=0.3,
        Emission_Color=graph.mix(gum, tooth, (0.44, 0.13, 0.12)), Emission_Strength=0.06,
    )  # fmt: skip
    return material


def tongue_material():
    material, graph = new_material("studio tongue")
    rest = graph.attribute("rest").outputs[1]
    graph.principled(
        Base_Color=(0.42, 0.14, 0.13),
        Emission_Color=(0.42, 0.14, 0.13),
        Emission_Strength=0.05,
        Roughness=0.32,
        Normal=graph.bump(graph.noise(rest, 900.0), 0.3, 0.001),
    )
    return material
