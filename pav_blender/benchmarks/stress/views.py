"""Cameras that nobody would place, and units that nobody would choose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ...bridge.axes import TO_CORE
from ...bridge.mesh import placement
from ...bridge.shot import Actor
from ...core.errors import InputError
from ...core.rendering.cameras import Camera
from ...core.rendering.render import RenderSettings, render
from .checks import EVERY, agrees, apart, likeness, same_bits, shown, sound, with_vertices
from .scene import Found, Given, Scene
from .subjects import Head


def units(given: Given) -> Found:
    """The head as an object of another scale, 1e-4 to 1e4 times, and the camera as far off."""
    head, found = given.head, Found()
    usual, worst = shown(head), 0.0
    for unit in (1e-4, 1e-2, 1.0, 1e2, 1e4):
        world = np.linalg.inv(TO_CORE) @ np.diag([unit, unit, unit, 1]) @ TO_CORE
        pose = head.camera.camera_to_world.copy()
        pose[:3, 3] *= unit
        seen = _actor(head, world).seen_by(replace(head.camera, camera_to_world=pose))
        picture = shown(head, camera=seen)
        sound(found, picture, seen, f" x{unit:g}")
        worst = max(worst, apart(picture, usual))
    found.at_most("from life size", worst, 0.5, "/255")
    return found


def bare_units(given: Given) -> Found:
    """Vertices in another unit without a word: refused, neither drawn as a speck nor as a giant."""
    head, found = given.head, Found()
    refused = 0
    sizes = (1e-4, 1e-3, 1e-2, 1e1, 1e2, 1e3, 1e4)
    for unit in sizes:
        try:
            shown(with_vertices(head, head.vertices * unit))
        except InputError as error:
            refused += "vertices are metres" in str(error)
            found.raw[f"x{unit:g}"] = str(error)
    found.at_least("refused by name", refused, len(sizes))
    return found


def far_origin(given: Given) -> Found:
    """Head and camera a thousand kilometres from the origin, as arrays and as an object."""
    head, found = given.head, Found()
    usual, shift = shown(head), np.array([1e6, -1e6, 1e6])
    camera = head.camera.moved(shift)
    there = head.vertices.astype(np.float64) + shift
    name = head.avatar.appearances[0]
    picture = render(head.avatar, there, camera, name, expression=head.expression)
    sound(found, picture, camera)
    found.at_most("from the same at the origin", apart(picture, usual), 0.5, "/255")
    world = np.linalg.inv(TO_CORE) @ _carried(shift) @ TO_CORE
    as_object = shown(head, camera=_actor(head, world).seen_by(camera))
    found.at_most("as an object of Blender's", apart(as_object, usual), 0.5, "/255")
    return found


def _carried(shift: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = shift
    return matrix


def _actor(head: Head, matrix_world: np.ndarray) -> Actor:
    rigid, _, scale = placement(matrix_world)
    names = head.avatar.expression_names
    expression = dict(zip(names, head.expression.tolist(), strict=True))
    triangles = head.avatar.triangles
    return Actor("head", Path(), None, head.vertices, triangles, expression, rigid, scale)


def far_camera(given: Given) -> Found:
    """A camera 1e3, 1e5 and 1e7 m away with a lens as long: what a parallel one shows."""
    head, found = given.head, Found()
    camera = head.camera
    back, centre = camera.camera_to_world[:3, 2], head.vertices.mean(0).astype(np.float64)
    away = float((centre - camera.origin) @ back)
    scale = np.diag([1 / away, 1 / away, 1.0])
    parallel = replace(
        camera,
        parallel=True,
        intrinsics=np.hstack([(scale @ camera.intrinsics)[:, :2], camera.intrinsics[:, 2:]]),
    )
    flat = shown(head, camera=parallel)
    for distance in (1e3, 1e5, 1e7):
        longer = camera.intrinsics.copy()
        longer[0, 0] *= (distance + away) / away
        longer[1, 1] *= (distance + away) / away
        pinhole = replace(camera.moved(-distance * back), intrinsics=longer)
        picture = shown(head, camera=pinhole)
        sound(found, picture, pinhole, f" at {distance:g} m")
        if distance > 1e4:
            same = likeness(picture, flat)
            found.at_least(f"as a parallel camera sees it, {distance:g} m", same, 35, "dB")
            solid = (picture.rgba[..., 3] > 0.95) & (flat.rgba[..., 3] > 0.95)
            gap = picture.depth[solid].astype(np.float64) - distance - flat.depth[solid]
            found.raw[f"depth off at {distance:g} m, metres"] = float(np.abs(gap).max())
    return found


def inside(given: Given) -> Found:
    """The camera in the middle of the head."""
    head, found = given.ball, Found()
    pose = head.camera.camera_to_world.copy()
    pose[:3, 3] = (0.003, 0.002, 0.001)
    agrees(found, replace(head, camera=replace(head.camera, camera_to_world=pose)), skip_db=28)
    real = given.head
    pose = real.camera.camera_to_world.copy()
    pose[:3, 3] = real.vertices.mean(0)
    camera = replace(real.camera, camera_to_world=pose)
    sound(found, shown(real, camera=camera), camera, ", the trained head")
    return found


def behind(given: Given) -> Found:
    """The head behind the camera, and beside what it sees: nothing there."""
    head, found = given.head, Found()
    for name, turn in (("behind", [-1.0, 1, -1]), ("above", [1.0, -1, -1])):
        pose = head.camera.camera_to_world.copy()
        pose[:3, :3] = pose[:3, :3] @ np.diag(turn)
        if name == "above":
            pose[:3, 3] += [0, 10, 0]
        camera = replace(head.camera, camera_to_world=pose)
        picture = shown(head, camera=camera)
        sound(found, picture, camera, f", {name}")
        found.at_most(f"pixels that show anything, {name}", int((picture.rgba != 0).sum()), 0)
        found.at_most(f"densities evaluated, {name}", picture.evaluations, 0)
    return found


def fields_of_view(given: Given) -> Found:
    """From 0.1 to 170 degrees."""
    head, found = given.ball, Found()
    for degrees in (0.1, 1.0, 120.0, 170.0):
        focal = head.camera.width / 2 / np.tan(np.radians(degrees) / 2)
        camera = _lens(head.camera, focal)
        pose = camera.camera_to_world.copy()
        pose[2, 3] = 0.5 if degrees < 90 else 0.16
        other = replace(head, camera=replace(camera, camera_to_world=pose))
        if degrees in (0.1, 170.0):
            agrees(found, other, skip_db=28, of=f", {degrees:g} degrees")
        else:
            sound(found, shown(other), other.camera, f" at {degrees:g} degrees")
    return found


def _lens(camera: Camera, focal: float) -> Camera:
    intrinsics = camera.intrinsics.copy()
    intrinsics[0, 0] = intrinsics[1, 1] = focal
    return replace(camera, intrinsics=intrinsics)


def one_pixel(given: Given) -> Found:
    """One pixel, one row and one column: as in the picture they are cut from."""
    head, found = given.head, Found()
    whole = shown(head, EVERY)
    worst = 0.0
    for box in ((30, 30, 31, 31), (0, 40, 64, 41), (33, 0, 34, 64)):
        camera = head.camera.window(*box)
        part = shown(head, EVERY, camera)
        sound(found, part, camera, f" of {camera.width}x{camera.height}")
        x0, y0, x1, y1 = box
        cut = replace(whole, rgba=whole.rgba[y0:y1, x0:x1], depth=whole.depth[y0:y1, x0:x1])
        worst = max(worst, apart(part, cut))
    found.at_most("from the picture they are cut from", worst, 0.5, "/255")
    same_bits(found, head, whole, EVERY)
    return found


def along_an_edge(given: Given) -> Found:
    """Rays through vertices, along edges and in the plane of triangles, with zeros in them."""
    head, found = given.ball, Found()
    vertices = head.vertices.astype(np.float64)
    a, b, _ = head.avatar.triangles[5]
    along = vertices[b] - vertices[a]
    for name, start, direction in (
        ("along an edge", vertices[a] - 0.4 * along / np.linalg.norm(along), along),
        ("through a vertex", vertices[a] + [0, 0, 0.4], np.array([0.0, 0, -1])),
        ("in a plane of the box", np.array([0.0, 0.0, 0.4]), np.array([0.0, 0, -1])),
    ):
        camera = _one_ray(start, direction)
        agrees(found, replace(head, camera=camera), near=(1, 1), of=f", {name}")
    return found


def _one_ray(start: np.ndarray, direction: np.ndarray) -> Camera:
    """3 x 3 pixels, of which the middle one looks exactly along a direction."""
    forward = direction / np.linalg.norm(direction)
    side = np.cross(forward, [0.3, 0.9, 0.2] if abs(forward[2]) < 0.9 else [0, 1.0, 0])
    side /= np.linalg.norm(side)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([side, np.cross(forward, side), forward], 1)
    pose[:3, 3] = start
    return Camera(3, 3, np.array([[60.0, 0, 1.5], [0, 60.0, 1.5], [0, 0, 1]]), pose)


def steps(given: Given) -> Found:
    """Places from a hundredth of a millimetre to ten centimetres apart."""
    head, found = given.head, Found()
    camera = head.camera.resized(16, 16)
    exact = RenderSettings(step=1e-4, probe=1, longest=1, agreement=0.0, brief=False)
    finest = shown(head, exact, camera)
    for step in (1e-5, 1e-4, 1e-3, 1e-2, 1e-1):
        settings = RenderSettings(step=step)
        picture = shown(head, settings, camera)
        sound(found, picture, camera, f" at {step:g} m")
        found.raw[f"dB to 0.1 mm at {step:g} m"] = round(likeness(picture, finest), 2)
        if step <= 1e-3:
            same = likeness(picture, finest)
            found.at_least(f"like places 0.1 mm apart, at {step:g} m", same, 25, "dB")
    same_bits(found, head, shown(head, None, camera), None, camera)
    return found


SCENES = [
    Scene("units 1e-4 to 1e4", units),
    Scene("vertices in other units", bare_units),
    Scene("origin 1e6 m away", far_origin),
    Scene("camera 1e7 m away", far_camera),
    Scene("camera inside the head", inside),
    Scene("empty frames", behind),
    Scene("field of view 0.1 to 170 deg", fields_of_view),
    Scene("one-pixel frames", one_pixel),
    Scene("rays along edges", along_an_edge),
    Scene("steps 1e-5 to 1e-1 m", steps),
]
