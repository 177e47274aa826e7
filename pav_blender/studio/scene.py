"""One appearance of the person as a Blender scene of its own, re-posed frame by frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import bpy
import numpy as np

from ..core.collection import LABELS
from . import eyes, skin
from .camera import aim_camera, camera_object
from .lights import light_object, new_world
from .objects import delete, mesh_object, move_mesh
from .person import Person, joint_transforms

LABEL = {name: number for number, name in enumerate(LABELS)}


@dataclass
class FrameState:
    """Everything that hangs on the person needs to follow one frame."""

    posed: np.ndarray  # [V,3] the head model's vertices
    fine: np.ndarray  # [V',3] refined
    transforms: np.ndarray  # [J,4,4] rest -> posed of each joint, the translation included


class Actor(Protocol):
    """Blender objects that follow the person; `follow` poses them for one frame."""

    items: list

    def follow(self, state: FrameState) -> None: ...


@dataclass(eq=False)
class PartActor:
    """A piece of the refined mesh; `shift` (metres) displaces it in the frame of a joint."""

    items: list
    vertices: np.ndarray
    joint: int = 1
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def follow(self, state: FrameState) -> None:
        turned = state.transforms[self.joint, :3, :3] @ np.asarray(self.shift)
        move_mesh(self.items[0], state.fine[self.vertices] + turned.astype(np.float32))


@dataclass(eq=False)
class StudioScene:
    person: Person
    scene: bpy.types.Scene
    camera: bpy.types.Object
    actors: list[Actor] = field(default_factory=list)
    fixtures: list = field(default_factory=list)

    def add(self, actor: Actor) -> None:
        for item in actor.items:
            self.scene.collection.objects.link(item)
        self.actors.append(actor)

    def pose(self, expression: np.ndarray, pose: np.ndarray, translation: np.ndarray) -> np.ndarray:
        """Pose everything; returns the head model's vertices [V,3]."""
        person = self.person
        posed = person.posed(expression, pose, translation)
        transforms = joint_transforms(pose, person.joints, person.head.joint_parents)
        transforms[:, :3, 3] += translation
        state = FrameState(posed, person.refined(posed), transforms)
        for actor in self.actors:
            actor.follow(state)
        return posed

    def aim(self, intrinsics: np.ndarray, camera_to_world: np.ndarray, size: int) -> None:
        aim_camera(self.camera, intrinsics, camera_to_world, size)

    def close(self) -> None:
        """Remove the scene and everything made for it."""
        items = [item for actor in self.actors for item in actor.items]
        used = {slot.material for item in items for slot in item.material_slots}
        for item in [*items, *self.fixtures, self.camera]:
            delete(item)
        world = self.scene.world
        bpy.data.scenes.remove(self.scene)
        bpy.data.worlds.remove(world)
        for material in used - {None}:
            bpy.data.materials.remove(material)


def new_scene(person: Person, lighting) -> StudioScene:
    scene = bpy.data.scenes.new("pav studio")
    camera = camera_object()
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.world = new_world(lighting)
    fixtures = [light_object(k, light) for k, light in enumerate(lighting.lights)]
    for item in fixtures:
        scene.collection.objects.link(item)
    return StudioScene(person, scene, camera, fixtures=fixtures)


def add_body(studio: StudioScene, look: skin.SkinLook, hair_mask, beard_mask, covered) -> None:
    """Skin, eyes, teeth, tongue. Masks [N] darken skin under hair; `covered` is left out."""
    person = studio.person
    part = person.parts["skin"]
    rest = person.fine[part.vertices]
    colour, rough = skin.paint(person, look, hair_mask, beard_mask)
    extra = {}
    if look.freckles:
        marks = person.landmarks
        extra["freckle"] = skin.blob(
            rest, marks.nose + np.array([0.02, 0.01, -0.02]), (0.025, 0.014, 0.04)
        )
    shown = ~(covered[part.quads].all(1))
    item = mesh_object(
        "studio skin", rest, part.quads[shown], skin.skin_material(look),
        label=skin_labels(person, hair_mask, beard_mask)[shown],
        paint=colour, rough=rough, rest=rest, **extra,
    )  # fmt: skip
    studio.add(PartActor([item], part.vertices))
    eye = eyes.eye_material()
    for name in ("left_eye", "right_eye"):
        item = eyes.eye_object(person, name, eye, LABEL["eyes"])
        studio.add(PartActor([item], person.parts[name].vertices))
    for name in ("upper_teeth", "lower_teeth", "tongue"):
        if name in person.parts:
            material = eyes.tongue_material() if name == "tongue" else (
                eyes.tooth_material(person, name))  # fmt: skip
            item = eyes.tooth_object(person, name, material, LABEL["mouth"])
            studio.add(PartActor([item], person.parts[name].vertices, *tooth_shift(person, name)))


def tooth_shift(person: Person, name: str) -> tuple[int, tuple[float, float, float]]:
    """Where a row goes (joint, metres): MakeHuman's sit high and deep and are hardly ever seen.

    The upper edge ends a little below the lips' meeting line, the lower row just behind it.
    """
    points, marks = person.fine[person.parts[name].vertices], person.landmarks
    front = points[points[:, 2] > points[:, 2].max() - 0.006]
    if name == "upper_teeth":
        rise = marks.mouth[1] + 0.0003 - front[:, 1].min()
        return 1, (0.0, float(rise), float(marks.mouth[2] - 0.0118 - points[:, 2].max()))
    if name == "lower_teeth":
        rise = marks.mouth[1] - 0.0045 - front[:, 1].max()
        rise = min(max(rise, -0.004), 0.002)
        return 2, (0.0, rise, float(marks.mouth[2] - 0.0150 - points[:, 2].max()))
    return 2, (0.0, 0.0, 0.0)


def skin_labels(person: Person, hair_mask, beard_mask) -> np.ndarray:
    """A label for every face of the skin."""
    part = person.parts["skin"]
    masks = {name: mask[part.vertices] for name, mask in person.masks.items()}
    points, marks = person.fine[part.vertices], person.landmarks
    label = np.full(len(points), LABEL["face"])
    low = points[:, 1] < marks.chin[1] + 0.35 * (marks.chin[2] - points[:, 2]) - 0.012
    label[low | (masks["torso"] > 0.5)] = LABEL["neck"]
    if "neck" in masks:
        label[masks["neck"] > 0.5] = LABEL["neck"]
    label[hair_mask > 0.4] = LABEL["scalp_hair"]
    label[beard_mask > 0.3] = LABEL["facial_hair"]
    label[masks["ears"] > 0.5] = LABEL["ears"]
    label[masks["lips"] > 0.5] = LABEL["lips"]
    label[masks["mouth_interior"] > 0.5] = LABEL["mouth"]
    corners = label[part.quads]
    votes = (corners[:, :, None] == corners[:, None, :]).sum(2)
    return np.take_along_axis(corners, votes.argmax(1)[:, None], 1)[:, 0].astype(np.float32)
