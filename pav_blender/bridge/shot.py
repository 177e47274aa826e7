"""What one picture needs, copied out of Blender: after this, drawing knows no bpy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..core.rendering.cameras import Camera
from ..core.rendering.solids import Solid
from . import avatars, mesh
from .axes import camera_to_core
from .lens import frame_size, from_projection
from .looks import Layer, read_layers


@dataclass(frozen=True, eq=False)
class Actor:
    """A head to draw. vertices [V, 3] float32 metres in the head's own space, which `rigid` and
    `scale` place in the world (see `mesh.placement`); expression: shape key values by name;
    triangles [T, 3] for the check against the avatar; appearance None: the avatar's first; layers:
    what is worn over it; identity: whose head it is, "" where that is not known."""

    name: str
    avatar: Path
    appearance: str | None
    vertices: np.ndarray
    triangles: np.ndarray
    expression: dict[str, float]
    rigid: np.ndarray
    scale: float
    layers: tuple[Layer, ...] = ()
    identity: str = ""

    @property
    def looks(self) -> list[str]:
        """The appearances that it can wear."""
        return avatars.looks(self.avatar, self.identity)

    def equals(self, other: Actor, within: float = 0.0) -> bool:
        """Whether both would give the same picture; vertices may differ by `within` metres."""
        return (
            (self.avatar, self.appearance, self.expression, self.scale, self.identity)
            == (other.avatar, other.appearance, other.expression, other.scale, other.identity)
            and np.array_equal(self.rigid, other.rigid)
            and self.vertices.shape == other.vertices.shape
            and np.allclose(self.vertices, other.vertices, rtol=0, atol=within)
            and np.array_equal(self.triangles, other.triangles)
            and len(self.layers) == len(other.layers)
            and all(a.equals(b) for a, b in zip(self.layers, other.layers, strict=True))
        )

    def seen_by(self, camera: Camera) -> Camera:
        """A camera of the world as it stands to the head's own space."""
        pose = np.linalg.inv(self.rigid) @ camera.camera_to_world
        pose[:3, 3] /= self.scale
        if camera.parallel:  # its intrinsics count pixels a metre
            scale = np.diag([self.scale, self.scale, 1.0])
            intrinsics = np.hstack([(scale @ camera.intrinsics)[:, :2], camera.intrinsics[:, 2:]])
            return replace(camera, camera_to_world=pose, intrinsics=intrinsics)
        return replace(camera, camera_to_world=pose)


@dataclass(frozen=True, eq=False)
class Shot:
    """One picture: the `region` (x0, y0, x1, y1) of what `camera` (world, core axes) sees,
    top-left origin; quality: a preset's name; background: scene-linear RGB, None for a transparent
    film; chunk: rays between two looks at whether to stop, 0 for the renderer's own; solids: what
    else is seen, with samples x samples of it a pixel, each a pixel of its own if `enlarged`."""

    actors: tuple[Actor, ...]
    camera: Camera
    region: tuple[int, int, int, int]
    quality: str
    background: tuple[float, float, float] | None
    chunk: int = 0
    solids: tuple[Solid, ...] = ()
    samples: int = 1
    enlarged: bool = False


def border(render: Any, width: int, height: int) -> tuple[int, int, int, int]:
    """The pixels that the render border keeps, (x0, y0, x1, y1) from the top left."""
    if not render.use_border:
        return 0, 0, width, height
    # float32 products cut off, as Blender computes the same rectangle
    left, right = (
        int(np.float32(v) * np.float32(width)) for v in (render.border_min_x, render.border_max_x)
    )
    low, high = (
        int(np.float32(v) * np.float32(height)) for v in (render.border_min_y, render.border_max_y)
    )
    if right <= left or high <= low:
        raise InputError("the render border holds no pixel; draw it again or switch it off")
    return left, height - high, right, height - low


def world_colour(world: Any) -> tuple[float, float, float]:
    """Scene-linear colour behind the avatar: the world's background colour, black without one."""
    import bpy

    if world is None:
        return 0.0, 0.0, 0.0
    # from Blender 5 on every world has nodes, and asking whether it uses them is deprecated
    uses_nodes = world.node_tree and (bpy.app.version >= (5, 0, 0) or world.use_nodes)
    for node in world.node_tree.nodes if uses_nodes else ():
        if node.type == "BACKGROUND" and not node.inputs["Color"].is_linked:
            strength = node.inputs["Strength"].default_value
            return tuple(strength * channel for channel in node.inputs["Color"].default_value[:3])
    return tuple(world.color)


def film_background(scene: Any) -> tuple[float, float, float] | None:
    """What a render of the scene shows where no avatar is: None for a transparent film."""
    return None if scene.render.film_transparent else world_colour(scene.world)


def shown_in(scene: Any) -> Any:
    """The scene whose size, border and quality a picture of `scene` has: itself, or the one that
    its heads are composited into. InputError where that one looks through another camera."""
    outer = scene.original.pav.frames.shown_in
    if outer is None:
        return scene
    if outer.camera != scene.original.camera:
        raise InputError(
            f"scene {scene.name!r} has another camera than {outer.name!r}, where its heads are "
            "shown; press Composite with Scene there again"
        )
    return outer


def scene_camera(engine: Any, camera: Any, depsgraph: Any, width: int, height: int) -> Camera:
    """The camera of a final render in world space, core axes.

    `engine` is the render engine (it knows the matrix to use), or None outside a render.
    """
    render = shown_in(depsgraph.scene).render
    projection = np.array(
        camera.calc_matrix_camera(
            depsgraph,
            x=width,
            y=height,
            scale_x=render.pixel_aspect_x,
            scale_y=render.pixel_aspect_y,
        )
    )
    if engine is not None:
        matrix = np.array(engine.camera_model_matrix(camera))
    else:
        matrix = np.array(camera.matrix_world)
    intrinsics = from_projection(projection, width, height)
    return Camera(width, height, intrinsics, camera_to_core(matrix))


def find_actors(depsgraph: Any, shown: Callable[[Any], bool] | None = None) -> tuple[Actor, ...]:
    """Every visible object (or instance of one) that has an avatar file, ready to draw. shown:
    whether an evaluated object is to be seen."""
    actors = []
    for instance in depsgraph.object_instances:
        evaluated = instance.object
        if evaluated.type == "MESH" and evaluated.pav.avatar and instance.show_self:
            owner = instance.parent if instance.is_instance else evaluated
            if shown is None or shown(owner):
                actors.append(read_actor(evaluated, instance.matrix_world, depsgraph))
    return tuple(actors)


def read_actor(evaluated: Any, matrix_world: Any, depsgraph: Any) -> Actor:
    """One evaluated mesh object as an actor. InputError for a scale of zero or a wrong choice."""
    original = evaluated.original
    try:
        rigid, stretch, scale = mesh.placement(np.array(matrix_world))
    except ValueError as error:
        raise InputError(f"object {original.name!r}: {error}") from error
    points = mesh.evaluated_vertices(evaluated)
    if not np.allclose(stretch, np.eye(3), atol=1e-6):
        points = np.ascontiguousarray(points @ stretch.T, np.float32)
    return Actor(
        name=original.name,
        avatar=avatars.path_of(original.pav),
        appearance=_appearance(evaluated.pav, original.name),
        vertices=points,
        triangles=mesh.triangles(evaluated.data),
        expression=_key_values(original, depsgraph),
        rigid=rigid,
        scale=scale,
        layers=read_layers(evaluated),
        identity=original.pav.identity,
    )


def read_shot(engine: Any, depsgraph: Any) -> Shot:
    """The picture that a final render of `depsgraph` asks for. InputError, one line."""
    scene = depsgraph.scene_eval
    camera_object = scene.camera
    if camera_object is None:
        raise InputError(f"scene {scene.name!r} has no camera; add one or import a track")
    outer = shown_in(scene)
    if outer.render.use_multiview:
        raise InputError("PAV renders one view; switch stereoscopy off")
    width, height = frame_size(outer.render)
    camera = scene_camera(engine, camera_object, depsgraph, width, height)
    actors = find_actors(depsgraph)
    if not actors:
        raise InputError(
            f"scene {scene.name!r} shows no avatar: choose an avatar file for a head in the "
            "sidebar's PAV tab, and check that the head is visible in renders"
        )
    return Shot(
        actors,
        camera,
        border(outer.render, width, height),
        outer.pav.quality.lower(),
        film_background(scene),
    )


def _appearance(pav: Any, name: str) -> str | None:
    """The chosen appearance; None where none was ever chosen (the avatar's first then)."""
    if not pav.is_property_set("appearance"):
        return None
    if pav.appearance:
        return pav.appearance
    path = avatars.path_of(pav)
    known = ", ".join(avatars.looks(path, pav.identity))
    raise InputError(
        f"object {name!r}: the appearance chosen there is not in {path}; it has {known}"
    )


def _key_values(original: Any, depsgraph: Any) -> dict[str, float]:
    """Evaluated (animated, driven) values of an object's shape keys; a muted key counts 0."""
    keys = original.data.shape_keys
    if keys is None:
        return {}
    blocks = keys.evaluated_get(depsgraph).key_blocks
    return {key.name: 0.0 if key.mute else key.value for key in blocks[1:]}
