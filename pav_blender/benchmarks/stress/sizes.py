"""Pictures larger than any screen; each in a process of its own, for its greatest memory."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from ...core.rendering.render import RenderSettings, render
from .checks import apart, shown, wrong_values
from .scene import Found, Given, Scene

_SIDE = 8192
_TILE = 128
# pixels that are the mean of others are others where a picture begins elsewhere
_EVERY = RenderSettings(agreement=0.0)


def large_tiles(given: Given) -> Found:
    """8192 x 8192 pixels through a render border, here a tile of 128 x 128 over the face."""
    head, found = given.head, Found()
    camera = head.camera.resized(_SIDE, _SIDE)
    name = head.avatar.appearances[0]
    middle = _SIDE // 2
    box = (middle, middle, middle + _TILE, middle + _TILE)
    started = time.perf_counter()
    whole = render(
        head.avatar, head.vertices, camera, name, _EVERY, expression=head.expression, region=box
    )
    found.raw["seconds a tile"] = round(time.perf_counter() - started, 2)
    found.at_most("wrong numbers", wrong_values(whole, camera.window(*box)), 0)
    half = _TILE // 2
    corner = (middle + half, middle + half, middle + _TILE, middle + _TILE)
    part = render(
        head.avatar, head.vertices, camera, name, _EVERY,
        expression=head.expression, region=corner,
    )  # fmt: skip
    cut = replace(whole, rgba=whole.rgba[half:, half:], depth=whole.depth[half:, half:])
    found.at_most("a part of a tile, from the tile", apart(part, cut), 0.5, "/255")
    return found


def large_whole(given: Given) -> Found:
    """8192 x 8192 pixels at once, a small head in the middle of them."""
    head, found = given.ball, Found()
    camera = replace(
        head.camera.resized(_SIDE, _SIDE),
        intrinsics=np.array([[110.0, 0, _SIDE / 2], [0, 110.0, _SIDE / 2], [0, 0, 1]]),
    )
    picture = shown(head, _EVERY, camera)
    found.at_most("wrong numbers", sum(
        wrong_values(replace(picture, rgba=picture.rgba[y:y + 512], depth=picture.depth[y:y + 512]),
                     camera.window(0, y, _SIDE, y + 512))
        for y in range(0, _SIDE, 512)), 0)  # fmt: skip
    a, b = _SIDE // 2 - 24, _SIDE // 2 + 24
    middle = replace(picture, rgba=picture.rgba[a:b, a:b], depth=picture.depth[a:b, a:b])
    found.at_most(
        "from a picture of the head alone", apart(middle, shown(head, _EVERY)), 1.0, "/255"
    )
    return found


def spread_mesh(given: Given) -> Found:
    """The largest mesh that is not refused: four times the head."""
    head, found = given.head, Found()
    pose = head.camera.camera_to_world.copy()
    pose[:3, 3] *= 3.9
    camera = replace(head.camera, camera_to_world=pose)
    picture = shown(replace(head, vertices=head.vertices * np.float32(3.9)), camera=camera)
    found.at_most("wrong numbers", wrong_values(picture, camera), 0)
    found.raw["covered"] = round(float((picture.rgba[..., 3] > 0.5).mean()), 4)
    return found


SCENES = [
    Scene("a border of 8192 pixels", large_tiles, alone=True),
    Scene("a frame of 8192 pixels", large_whole, alone=True),
    Scene("four times life size", spread_mesh, alone=True),
]
