"""Hostile scenes: what must hold in each, and what was seen. `SCENES` names them all."""

from __future__ import annotations

from . import bodies, fields, refusals, sizes, views
from .scene import Scene

SCENES: dict[str, Scene] = {
    scene.name: scene
    for module in (bodies, views, fields, refusals, sizes)
    for scene in module.SCENES
}
