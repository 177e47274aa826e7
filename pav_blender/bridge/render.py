"""A shot to pixels. No bpy here, so it may run on any thread."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..core.rendering import solids as solid_pictures
from ..core.rendering.colour import linear_premultiplied
from ..core.rendering.frames import EMPTY_DEPTH
from . import avatars
from .looks import worn
from .shot import Actor, Shot

_ROUNDING = 1e-6  # metres: moving an armature as a whole moves its mesh by less in itself


@dataclass(frozen=True, eq=False)
class Pixels:
    """combined [H, W, 4] scene-linear premultiplied; depth [H, W] metres along the camera's
    axis, EMPTY_DEPTH where nothing is; display [H, W, 4] straight sRGB. Row 0 is the top."""

    combined: np.ndarray
    depth: np.ndarray
    display: np.ndarray


def draw(
    shot: Shot,
    progress: Callable[[float], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    posed: Posed | None = None,
) -> Pixels:
    """Renders every actor of a shot, nearer over farther, among its solids. Raises PavError, one
    line; Cancelled where `should_stop` said so. posed: where poses are kept."""
    count = len(shot.actors)
    posed = posed or Posed()
    solids = posed.solids(shot) if shot.solids else None
    limit = solid_pictures.farthest(solids[1], shot.samples) if solids else None
    layers = []
    for index, actor in enumerate(shot.actors):
        report = _part(progress, index, count)
        layers.append(_draw_actor(shot, actor, posed, limit, report, should_stop))
    display, depth = _stack(layers, shot.region)
    if solids:
        combined, depth = solid_pictures.compose(
            display, depth, *solids, shot.background, enlarged=shot.enlarged
        )
        return Pixels(combined, np.minimum(depth, EMPTY_DEPTH), display)
    combined = linear_premultiplied(display)
    if shot.background is not None:
        combined[..., :3] += (1 - combined[..., 3:]) * np.asarray(shot.background, np.float32)
        combined[..., 3] = 1.0
    return Pixels(combined, depth, display)


def expression_vector(actor: Actor, names: tuple[str, ...]) -> np.ndarray:
    """Shape key values in the avatar's order, [E] float32; a key that the mesh lacks counts 0.

    InputError where the mesh has keys but none that the avatar knows: the head is another one.
    """
    if actor.expression and names and not set(actor.expression) & set(names):
        raise InputError(
            f"object {actor.name!r}: none of its shape keys is an expression of {actor.avatar} "
            f"({names[0]}, ...): its head is another one"
        )
    return np.array([actor.expression.get(name, 0.0) for name in names], np.float32)


def check_topology(actor: Actor, avatar: Any) -> None:
    """InputError unless the mesh is the avatar's head."""
    found, expected = len(actor.vertices), len(avatar.canonical_vertices)
    if found != expected:
        raise InputError(
            f"object {actor.name!r} has {found} vertices, the head of {actor.avatar} has "
            f"{expected}: use that head's mesh, and no modifier that adds or removes vertices"
        )
    if not np.array_equal(actor.triangles, avatar.triangles):
        raise InputError(
            f"object {actor.name!r}: its faces are not those of the head of {actor.avatar}; "
            "use that head's mesh"
        )


def check_person(actor: Actor, avatar: Any) -> None:
    """InputError where a head wears the appearance of another person than whose it is."""
    for name in (actor.appearance, *(layer.appearance for layer in actor.layers)):
        if name in avatar.appearances and name not in actor.looks:
            raise InputError(
                f"object {actor.name!r} is the head of {actor.identity!r} and can't wear {name!r}; "
                f"that person's head is added by importing {actor.avatar} with that appearance"
            )


class Posed:
    """Poses of the last actors, and the last solids: while only the camera moves, or a head as a
    whole, nothing is posed anew. One picture at a time."""

    def __init__(self, kept: int = 0) -> None:
        self._kept = kept
        self._scenes: list[tuple[Actor, Any]] = []
        self._gather = solid_pictures.Gatherer()

    def scene(self, actor: Actor) -> Any:
        """The actor's avatar in its pose, a `core.rendering.render.Scene`. InputError, one line."""
        from ..core.rendering.render import pose_scene

        avatar = avatars.load(actor.avatar)
        for entry in self._scenes:
            other, scene = entry
            there = replace(other, rigid=actor.rigid, scale=actor.scale)
            if scene.avatar is avatar and there.equals(actor, _ROUNDING):
                self._scenes.remove(entry)
                self._scenes.append(entry)
                return scene
        check_topology(actor, avatar)
        check_person(actor, avatar)
        scene = pose_scene(
            avatar,
            actor.vertices,
            worn(actor.appearance or actor.looks[0], actor.layers),
            expression_vector(actor, avatar.expression_names),
        )
        self._scenes = [*self._scenes, (actor, scene)][-self._kept :] if self._kept else []
        return scene

    def solids(self, shot: Shot) -> tuple[np.ndarray, np.ndarray]:
        """Colour and depth of the shot's solids, `samples` along either side of a pixel."""
        camera = shot.camera.window(*shot.region)
        fine = camera.resized(camera.width * shot.samples, camera.height * shot.samples)
        return solid_pictures.picture(shot.solids, fine, self._gather(shot.solids))

    def forget(self) -> None:
        """Lets go of everything."""
        self._scenes = []
        self._gather = solid_pictures.Gatherer()


def _draw_actor(
    shot: Shot,
    actor: Actor,
    posed: Posed,
    limit: np.ndarray | None,
    progress: Callable[[float], None] | None,
    should_stop: Callable[[], bool] | None,
) -> tuple[np.ndarray, np.ndarray]:
    import torch

    from ..core.kernels.cpu.threads import torch_alone
    from ..core.rendering.render import RenderSettings, render_scene

    settings = RenderSettings.preset(shot.quality)
    if shot.chunk:
        settings = replace(settings, chunk=shot.chunk)
    with torch.inference_mode(), torch_alone():
        scene = posed.scene(actor)
    picture = render_scene(
        scene,
        actor.seen_by(shot.camera.window(*shot.region)),
        settings,
        limit=None if limit is None else limit / np.float32(actor.scale),
        progress=progress,
        should_stop=should_stop,
    )
    depth = np.where(np.isfinite(picture.depth), picture.depth * actor.scale, EMPTY_DEPTH)
    return np.asarray(picture.rgba, np.float32), depth.astype(np.float32)


def _part(
    progress: Callable[[float], None] | None, index: int, count: int
) -> Callable[[float], None] | None:
    if progress is None:
        return None
    return lambda fraction: progress((index + fraction) / count)


def _stack(
    layers: list[tuple[np.ndarray, np.ndarray]], region: tuple[int, int, int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Straight pictures with depths -> one, each pixel's nearer layer over the farther."""
    if not layers:
        shape = region[3] - region[1], region[2] - region[0]
        return np.zeros((*shape, 4), np.float32), np.full(shape, EMPTY_DEPTH, np.float32)
    if len(layers) == 1:
        return layers[0]
    order = np.argsort([depth for _, depth in layers], axis=0, kind="stable")
    colour = np.zeros_like(layers[0][0])
    for rank in reversed(range(len(layers))):
        for index, (rgba, _) in enumerate(layers):
            chosen = order[rank] == index
            alpha = rgba[chosen, 3:]
            premultiplied = np.concatenate([rgba[chosen, :3] * alpha, alpha], axis=1)
            colour[chosen] = premultiplied + (1 - alpha) * colour[chosen]
    alpha = colour[..., 3:]
    colour[..., :3] /= np.where(alpha > 0, alpha, 1)
    return colour, np.min([depth for _, depth in layers], axis=0)
