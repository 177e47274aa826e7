"""Clothes: the torso smoothed, pushed out and folded; collars and hoods lofted round the neck."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from .nodes import new_material
from .objects import mesh_object
from .person import Person, vertex_normals
from .shapes import grid, join, ring, sweep
from .skin import smoothstep

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Outfit:
    """`neck`: "collar", "crew", "hood" or "roll"; `over` None: a single layer."""

    neck: str
    colour: Colour
    over: Colour | None = None
    weave: str = "cloth"  # "cloth", "knit"
    folds: float = 1.0
    seed: int = 1


def neck_line(person: Person, lower: float = 0.0):
    """The height of the neckline as a function of z, and the neck's axis."""
    marks = person.landmarks
    front, back = marks.chin[1] - 0.062 - lower, marks.chin[1] - 0.018 - 0.4 * lower
    z_front, z_back = marks.chin[2] - 0.045, marks.back[2] + 0.045
    slope = (front - back) / (z_front - z_back)
    centre = np.array([0.0, front, 0.5 * (z_front + z_back)])

    def height(z):
        return back + slope * (np.asarray(z) - z_back)

    return height, centre


def garment(person: Person, outfit: Outfit):
    """Rest vertices, quads and the outer layer's mask of the main garment."""
    part = person.parts["skin"]
    points = person.fine[part.vertices]
    _, centre = neck_line(person)
    below = dressed(person, points, 0.012, outfit)
    quads = part.quads[below[part.quads].all(1)]
    used, faces = np.unique(quads, return_inverse=True)
    faces = faces.reshape(-1, 4)
    cloth = _smoothed(points[used], faces, 14)
    normals = vertex_normals(cloth, faces)
    step = np.zeros(len(cloth))
    if outfit.over is not None:
        step = smoothstep(layer_edge(cloth, centre), -0.004, 0.004)
    out = 0.007 + 0.007 * step + 0.0030 * outfit.folds * folds(cloth, outfit.seed, centre)
    # the shoulders drape: cloth bridges the hollows over the collar bones
    return cloth + out[:, None] * normals, faces


def dressed(person: Person, points: np.ndarray, margin: float, outfit: Outfit) -> np.ndarray:
    """Which rest points lie below the neckline, or at most `margin` above it."""
    height, centre = neck_line(person, 0.010 if outfit.neck == "crew" else 0.0)
    radial = np.hypot(points[:, 0], points[:, 2] - centre[2])
    below = points[:, 1] < height(points[:, 2]) + margin
    shoulder = (radial > 0.13) & (points[:, 1] < person.landmarks.chin[1])
    return below | shoulder


def layer_edge(points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Signed metres from the edge of the outer layer's opening (positive: on the outer layer)."""
    drop = centre[1] + 0.004 - points[:, 1]
    width = 0.030 + 0.030 * np.clip(1 - drop / 0.11, 0, 1.4)
    front = np.abs(points[:, 0]) - width
    ring_edge = np.hypot(points[:, 0], points[:, 2] - centre[2]) - 0.083
    return np.where(points[:, 2] > centre[2], front, ring_edge)


def folds(points: np.ndarray, seed: int, centre: np.ndarray) -> np.ndarray:
    """Soft folds that run from the neck and the armpits; about -1..1."""
    rng = np.random.default_rng(seed)
    out = np.zeros(len(points))
    for _ in range(9):
        origin = centre + np.array([rng.uniform(-0.25, 0.25), rng.uniform(-0.25, 0.02), 0.0])
        offset = points - origin
        angle = np.arctan2(offset[:, 0], -offset[:, 1] + 0.15)
        wave = np.sin(rng.uniform(6, 13) * angle + rng.uniform(0, 6.3)
                      + 2.5 * np.sin(9 * points[:, 1] + rng.uniform(0, 6.3)))  # fmt: skip
        reach = np.exp(-0.5 * (np.linalg.norm(offset, axis=1) / rng.uniform(0.06, 0.14)) ** 2)
        out += reach * np.sign(wave) * np.abs(wave) ** 1.4
    return np.clip(out, -1.6, 1.6)


def _smoothed(points: np.ndarray, faces: np.ndarray, rounds: int) -> np.ndarray:
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 3]], faces[:, [3, 0]]])
    edges = np.concatenate([edges, edges[:, ::-1]])
    graph = sparse.csr_matrix((np.ones(len(edges)), edges.T), shape=(len(points),) * 2)
    average = sparse.diags(1 / np.maximum(np.asarray(graph.sum(1)).reshape(-1), 1)) @ graph
    for _ in range(rounds):
        points = 0.4 * points + 0.6 * (average @ points)
    return points


def collar(person: Person):
    """A shirt's collar: a stand round the neck that folds over and ends in two points."""
    part = person.parts["skin"]
    points = person.fine[part.vertices]
    height, centre = neck_line(person)
    theta = np.linspace(0.17, 2 * np.pi - 0.17, 110)
    full = np.linspace(0, 2 * np.pi, 129)
    loop = ring(points[points[:, 1] < person.landmarks.mouth[1]], centre, height, 128, smooth=4.0)
    loop = np.concatenate([loop, loop[:1]])
    path = np.stack([np.interp(theta, full, loop[:, k]) for k in range(3)], axis=1)
    outward = path - centre
    outward[:, 1] = 0
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    front = smoothstep(np.cos(theta), 0.2, 0.98)[:, None]
    up = np.array([0.0, 1.0, 0.0])
    # (out, up) in metres along the section: stand, fold, fall
    section = ((0.008, -0.012), (0.007, 0.004), (0.006, 0.020), (0.0075, 0.0285), (0.0115, 0.031),
               (0.0160, 0.028), (0.0205, 0.016), (0.0255, 0.000), (0.0300, -0.011))  # fmt: skip
    rows = []
    for number, (out, rise) in enumerate(section):
        fall = max(number - 4, 0) / 4
        lower = 0.005 * front + 0.026 * fall * front
        shift = outward * (out + 0.010 * fall * front) + up * (rise - lower)
        aside = np.stack([np.sin(theta), 0 * theta, 0 * theta], 1) * 0.010 * fall * front
        rows.append(path + shift + aside)
    return grid(np.stack(rows, axis=1))


def neck_band(person: Person, radius: float, lower: float = 0.0, out: float = 0.008, flat=1.0):
    """A rib round the neckline."""
    part = person.parts["skin"]
    points = person.fine[part.vertices]
    height, centre = neck_line(person, lower)
    loop = ring(points[points[:, 1] < person.landmarks.mouth[1]], centre, height, 128, smooth=4.0)
    outward = loop - centre
    outward[:, 1] = 0
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    return sweep(loop + out * outward, radius, 12, closed=True, flatten=flat)


def hood(person: Person):
    """A hood lying on the back and shoulders, its edges meeting in front, with two cords."""
    part = person.parts["skin"]
    points = person.fine[part.vertices]
    height, centre = neck_line(person)
    loop = ring(points[points[:, 1] < person.landmarks.mouth[1]], centre, height, 128, smooth=6.0)
    angle = np.linspace(0, 2 * np.pi, 128, endpoint=False)
    behind = smoothstep(-np.cos(angle), -0.7, 0.9)
    outward = loop - centre
    outward[:, 1] = 0
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    path = loop + outward * (0.012 + 0.026 * behind)[:, None]
    path[:, 1] += 0.006 + 0.016 * behind
    wobble = 1 + 0.07 * np.sin(7 * angle + 1) + 0.05 * np.sin(13 * angle)
    roll = sweep(path, (0.011 + 0.022 * behind) * wobble, 20, closed=True)
    cords = []
    for side in (-1, 1):
        start = loop[0] + [side * 0.022, -0.004, 0.018]
        drop = np.linspace(0, 1, 24)[:, None]
        cord = start + drop * [side * 0.012, -0.12, 0.018] + [0, 0, 0.004] * np.sin(9 * drop)
        cords.append(sweep(cord, 0.0024, 8))
    return roll, join(*cords)


def cloth_material(outfit: Outfit, colour: Colour, centre: np.ndarray, layered: bool):
    """Cloth by `rest`: the weave as a bump, the outer layer by the shape of its opening."""
    material, graph = new_material("studio cloth")
    rest = graph.attribute("rest").outputs[1]
    base = graph.add("RGB").outputs[0]
    base.default_value = (*colour, 1.0)
    if layered and outfit.over is not None:
        base = graph.mix(graph.smooth(graph.attribute("layer").outputs[2], -0.002, 0.0),
                         colour, outfit.over)  # fmt: skip
    shade = graph.noise(rest, 60.0, 4.0)
    shade = graph.add("MapRange", _0=shade, _1=0.3, _2=0.7, _3=0.82, _4=1.12).outputs[0]
    spread = graph.add("SeparateXYZ", Vector=rest)
    if outfit.weave == "knit":
        column = graph.math("SINE", graph.math("MULTIPLY", spread.outputs[0], 2 * np.pi / 0.0042))
        zigzag = graph.math("ABSOLUTE", column)
        row = graph.math("ADD", graph.math("MULTIPLY", spread.outputs[1], 2 * np.pi / 0.0036),
                         graph.math("MULTIPLY", zigzag, 1.6))  # fmt: skip
        height = graph.math("MULTIPLY", zigzag, graph.math("ADD", graph.math("SINE", row), 1.6))
        normal = graph.bump(height, 0.8, 0.0016)
        dark = graph.add("MapRange", _0=height, _1=0.0, _2=1.6, _3=0.55, _4=1.1).outputs[0]
        base = graph.mix(1.0, base, dark, "MULTIPLY")
    else:
        normal = graph.bump(graph.noise(rest, 1500.0, 1.0), 0.25, 0.0008)
    graph.principled(
        Base_Color=graph.mix(1.0, base, shade, "MULTIPLY"), Roughness=0.85, Normal=normal,
        Specular_IOR_Level=0.25, Sheen_Weight=0.25, Sheen_Roughness=0.5,
    )  # fmt: skip
    return material


def outfit_objects(person: Person, outfit: Outfit, label: int) -> list:
    """All pieces of an outfit in rest space; they ride on the root joint."""
    _, centre = neck_line(person)
    plain = cloth_material(outfit, outfit.colour, centre, False)
    main = cloth_material(outfit, outfit.colour, centre, True)
    vertices, quads = garment(person, outfit)
    items = [
        mesh_object(
            "studio garment",
            vertices,
            quads,
            main,
            label=label,
            rest=vertices,
            layer=layer_edge(vertices, centre),
        )
    ]

    def piece(name: str, mesh, material=plain) -> None:
        items.append(mesh_object(name, mesh[0], mesh[1], material, label=label, rest=mesh[0]))

    if outfit.neck == "collar":
        piece("studio collar", collar(person))
    elif outfit.neck == "crew":
        piece("studio rib", neck_band(person, 0.0065, 0.010, 0.007))
    elif outfit.neck == "hood":
        roll, cords = hood(person)
        piece("studio hood", roll)
        pale = Outfit("crew", (0.75, 0.73, 0.7))
        piece("studio cords", cords, cloth_material(pale, pale.colour, centre, False))
    elif outfit.neck == "roll":
        for k, (radius, rise) in enumerate(((0.013, 0.0), (0.012, -0.016), (0.011, -0.030))):
            piece(f"studio roll {k}", neck_band(person, radius, rise, 0.010))
    return items
