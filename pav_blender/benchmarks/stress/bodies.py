"""Meshes that no modeller would sign for, and poses that nobody can take."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.errors import InputError
from .checks import WHOLE, agrees, apart, right_distances, same_bits, shown, sound, with_vertices
from .scene import Found, Given, Scene
from .subjects import Head, ball_on


def zero_area(given: Given) -> Found:
    """A fifth of the triangles without area."""
    head, found = given.ball, Found()
    vertices, triangles = head.vertices.copy(), head.avatar.triangles
    for a, b, c in triangles[::10]:
        vertices[b] = vertices[c] = vertices[a]
    head = with_vertices(head, vertices)
    a, b, c = vertices[triangles].swapaxes(0, 1)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    found.raw["triangles without area"] = int((area == 0).sum())
    agrees(found, head)
    right_distances(found, head)
    return found


def needles(given: Given) -> Found:
    """Vertices drawn next to others: triangles a micrometre wide."""
    head, found = given.ball, Found()
    vertices, triangles = head.vertices.copy(), head.avatar.triangles
    for a, b, _ in triangles[::12]:
        vertices[b] = vertices[a] + 1e-6
    head = with_vertices(head, vertices)
    agrees(found, head)
    right_distances(found, head)
    return found


def duplicated(given: Given) -> Found:
    """Every triangle twice: the picture of the mesh as it was."""
    return _as_it_was(given, np.concatenate([given.ball.avatar.triangles] * 2))


def flipped(given: Given) -> Found:
    """Every other triangle turned over: the picture of the mesh as it was."""
    triangles = given.ball.avatar.triangles.copy()
    triangles[::2] = triangles[::2, ::-1]
    return _as_it_was(given, triangles)


def _as_it_was(given: Given, triangles: np.ndarray) -> Found:
    """The ball of other triangles, which make the same surface."""
    head, found = given.ball, Found()
    other = ball_on(head.vertices, triangles)
    agrees(found, other)
    found.at_most(
        "from the mesh as it was", apart(shown(other, WHOLE), shown(head, WHOLE)), 1.0, "/255"
    )
    return found


def unreferenced(given: Given) -> Found:
    """Vertices of no triangle, a thousand kilometres off: the picture of the mesh without them."""
    head, found = given.ball, Found()
    loose = np.full((5, 3), 0.01, np.float32)
    other = ball_on(np.concatenate([head.vertices, loose]), head.avatar.triangles)
    posed = other.vertices.copy()
    posed[-5:] = 1e6
    with_latent(other, head)
    away = with_vertices(other, posed)
    sound(found, shown(away), away.camera)
    found.at_most(
        "from the mesh without them", apart(shown(away, WHOLE), shown(head, WHOLE)), 1.0, "/255"
    )
    return found


def with_latent(head: Head, other: Head) -> None:
    """Gives a ball another's weights, its own vertices first."""
    state = {k: v.clone() for k, v in other.avatar.field.state_dict().items()}
    own = head.avatar.field.state_dict()
    latent = own["latent"].clone()
    latent[:, : state["latent"].shape[1]] = state["latent"]
    head.avatar.field.load_state_dict(state | {"latent": latent})


def non_manifold(given: Given) -> Found:
    """Fins: edges that three and four triangles share, and triangles that meet in one corner."""
    head, found = given.ball, Found()
    triangles = head.avatar.triangles
    random = np.random.default_rng(0)
    fins = triangles[::8].copy()
    fins[:, 2] = random.integers(len(head.vertices), size=len(fins))
    fins = fins[(fins[:, 2:] != fins[:, :2]).all(1)]
    finned = ball_on(head.vertices, np.concatenate([triangles, fins]))
    agrees(found, finned)
    right_distances(found, finned)
    return found


def self_intersecting(given: Given) -> Found:
    """Half of the ball pushed through the other half."""
    head, found = given.ball, Found()
    vertices = head.vertices.copy()
    upper = vertices[:, 1] > 0.02
    vertices[upper, 1] -= 0.12
    head = with_vertices(head, vertices)
    agrees(found, head, skip_db=28)
    right_distances(found, head)
    return found


def flat(given: Given) -> Found:
    """The mesh pressed to a plane. Front and back tie everywhere: which of the two shows is up to
    rounding, that it is one of them, and the same one again, is not."""
    head, found = given.ball, Found()
    head = with_vertices(head, head.vertices * [1, 1, 0])
    picture = shown(head)
    sound(found, picture, head.camera)
    same_bits(found, head, picture)
    right_distances(found, head)
    return found


def mirrored(given: Given) -> Found:
    """The mesh inside out."""
    head, found = given.ball, Found()
    agrees(found, with_vertices(head, head.vertices * [-1, 1, 1]), skip_db=28)
    return found


def a_point(given: Given) -> Found:
    """The whole mesh in one point, a line, or exploded: refused."""
    head, found = given.ball, Found()
    far = head.vertices.copy()
    far[7] = 1e4
    poses = {"a point": head.vertices * 0, "exploded": far, "denormal": head.vertices * 1e-42}
    refused = 0
    for name, vertices in poses.items():
        try:
            shown(with_vertices(head, vertices))
        except InputError as error:
            refused += "m across" in str(error)
            found.raw[name] = str(error)
    found.at_least("refused by name", refused, len(poses))
    return found


def closed(given: Given) -> Found:
    """Lips and eyelids shut: what lies between is as near to one as to the other."""
    head, found = given.head, Found()
    expression = _expression(head, eyeBlinkLeft=1, eyeBlinkRight=1, mouthClose=0.05)
    head = _posed(head, expression)
    assert head.collection is not None
    lips = head.vertices[head.collection.head.regions["lips"]].mean(0)
    (column, row), _ = head.camera.project(lips[None])[0][0], None
    agrees(found, head, near=(int(column), int(row)), skip_db=30)
    return found


def exaggerated(given: Given) -> Found:
    """Every expression ten times as strong as any face makes it."""
    head, found = given.head, Found()
    head = _posed(head, np.full_like(head.expression, 10.0))
    sound(found, shown(head), head.camera)
    return found


def contorted(given: Given) -> Found:
    """Neck, jaw and eyes turned as no frame shows: 2.5 radians about each axis."""
    head, found = given.head, Found()
    for angle in (-2.5, 2.5):
        posed = _posed(head, head.expression, angle)
        sound(found, shown(posed), posed.camera, f" at {angle:+} rad")
    return found


def _expression(head: Head, **values: float) -> np.ndarray:
    names = head.avatar.expression_names
    return np.array([values.get(name, 0.0) for name in names], np.float32)


def _posed(head: Head, expression: np.ndarray, angle: float = 0.0) -> Head:
    assert head.collection is not None
    model = head.collection.head_with(head.avatar.head_offset)
    pose = np.full((1, len(model.joint_names), 3), angle, np.float32)
    pose[:, 0] = 0
    posed = model.pose(head.avatar.betas, expression[None], pose, np.zeros((1, 3), np.float32))
    clip = head.collection.clips[0]
    centre = posed[0].numpy()[model.regions["face"]].mean(0)
    focal = clip.intrinsics[0, 0, 0] * head.camera.width / clip.width
    pose4 = np.diag([1.0, -1, -1, 1])
    pose4[:3, 3] = centre + np.array([0, 0, 0.9])
    camera = replace(
        head.camera,
        camera_to_world=pose4,
        intrinsics=np.array([[focal, 0, 32], [0, focal, 32], [0, 0, 1]]),
    )
    return replace(head, vertices=posed[0].numpy(), expression=expression, camera=camera)


SCENES = [
    Scene("zero-area triangles", zero_area),
    Scene("needle triangles", needles),
    Scene("duplicated triangles", duplicated),
    Scene("flipped triangles", flipped),
    Scene("unreferenced vertices", unreferenced),
    Scene("non-manifold mesh", non_manifold),
    Scene("self-intersecting pose", self_intersecting),
    Scene("flattened mesh", flat),
    Scene("mirrored mesh", mirrored),
    Scene("mesh without a size", a_point),
    Scene("closed lips and eyelids", closed),
    Scene("expression x10", exaggerated),
    Scene("pose far outside training", contorted),
]
