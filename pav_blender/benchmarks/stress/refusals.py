"""What is not a number, or infinite: refused, by a line that names it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...core.collection import read_collection
from ...core.config import Config
from ...core.errors import InputError
from ...core.field.avatar import Avatar
from ...core.images import read_scene_linear, write_exr
from ...core.rendering.render import RenderSettings, pose_scene, render_scene
from .checks import shown
from .scene import Found, Given, Scene
from .subjects import Head

BAD = (np.nan, np.inf, -np.inf)


def _all_refused(
    cases: dict[str, Callable[[float], object]],
    words: str,
    bad: tuple[float, ...] = BAD,
    found: Found | None = None,
) -> Found:
    """Claims that every case raises an InputError, for each of `bad`, that says one of `words`."""
    found, refused = found or Found(), 0
    for name, act in cases.items():
        for value in bad:
            try:
                act(value)
                message = "taken"
            except InputError as error:
                message = str(error)
                refused += any(word in message for word in words.split("|"))
            found.raw[f"{name}, {value}"] = message.split("/")[-1]
    of = f" of {', '.join(cases)}" if found.claims else ""
    found.at_least(f"refused by name{of}", refused, len(cases) * len(bad))
    return found


def mesh(given: Given) -> Found:
    """One vertex that is not a number, or infinite."""
    head = given.ball

    def one(value: float) -> None:
        vertices = head.vertices.copy()
        vertices[3, 1] = value
        shown(dataclasses.replace(head, vertices=vertices))

    return _all_refused({"one vertex": one}, "number 3")


def camera(given: Given) -> Found:
    """A lens, a rotation or a place that is none."""
    head = given.ball

    def changed(name: str, place: tuple[int, int]) -> Callable[[float], object]:
        def act(value: float) -> None:
            values = getattr(head.camera, name).copy()
            values[place] = value
            shown(head, camera=dataclasses.replace(head.camera, **{name: values}))

        return act

    return _all_refused(
        {
            "focal length": changed("intrinsics", (0, 0)),
            "middle": changed("intrinsics", (0, 2)),
            "rotation": changed("camera_to_world", (1, 1)),
            "place": changed("camera_to_world", (0, 3)),
        },
        "camera:",
    )


def parameters(given: Given) -> Found:
    """Expressions, weights of appearances, limits, settings of pictures and of training."""
    head = given.ball

    def smile(value: float) -> None:
        shown(dataclasses.replace(head, expression=np.array([value, 0.0])))

    def weight(value: float) -> None:
        shown(head, appearance={"look 0": 1.0, "look 1": value})

    def limit(value: float) -> None:
        scene = pose_scene(head.avatar, head.vertices, "look 0")
        render_scene(scene, head.camera, limit=np.full((48, 48), value))

    def setting(name: str) -> Callable[[float], object]:
        def act(value: float) -> None:
            values: dict[str, Any] = {name: value}
            RenderSettings(**values)

        return act

    def config(name: str) -> Callable[[float], object]:
        return lambda value: Config.from_json({name: value})

    render = ("step", "transmittance", "share", "tolerance", "negligible")
    learn = ("step", "reach", "learning_rate", "density_bias", "colour_weight", "beta1")
    cases: dict[str, Callable[[float], object]] = {
        "expression": smile,
        "weight": weight,
        **{f"render {name}": setting(name) for name in render},
        **{f"config {name}": config(name) for name in learn},
    }
    found = _all_refused(cases, "|".join(["'smile'", "weights", *render, *learn]))
    # an infinite one sees for ever, or nothing: both can be drawn
    return _all_refused({"limit": limit}, "limit", (np.nan,), found)


def track(given: Given) -> Found:
    """A track on disk with a value that is none."""
    collection = read_collection(given.head.collection.path)  # type: ignore[union-attr]
    clip = collection.clips[0]
    copy = given.folder / "track"
    (copy / "clips" / clip.name).mkdir(parents=True, exist_ok=True)
    source = collection.path
    (copy / "collection.json").write_bytes((source / "collection.json").read_bytes())
    with np.load(source / "clips" / clip.name / "frames.npz", allow_pickle=False) as stored:
        arrays = dict(stored)

    def changed(key: str) -> Callable[[float], object]:
        def act(value: float) -> None:
            bad = arrays[key].astype(np.float32)
            bad.reshape(len(bad), -1)[2, 0] = value
            np.savez(copy / "clips" / clip.name / "frames.npz", **(arrays | {key: bad}))
            read_collection(copy)

        return act

    keys = ("expression", "pose", "translation", "intrinsics", "camera_to_world")
    return _all_refused({key: changed(key) for key in keys}, "|".join(f"'{k}'" for k in keys))


def pictures(given: Given) -> Found:
    """A scene-linear picture with a pixel that is none."""
    path = given.folder / "bad.exr"

    def one(value: float) -> None:
        rgba = np.full((4, 5, 4), 0.5, np.float32)
        rgba[2, 3, 1] = value
        write_exr(path, rgba)
        read_scene_linear(path)

    return _all_refused({"one pixel": one}, "bad.exr")


def weights(given: Given) -> Found:
    """An avatar's file with a weight that is none, and a mesh, and a size."""
    path = given.folder / "bad.pav"

    def changed(name: str) -> Callable[[float], object]:
        def act(value: float) -> None:
            head = given.ball
            with torch.no_grad():
                head.avatar.field.state_dict()[name].view(-1)[0] = value
            _again(head, path)

        return act

    def vertices(value: float) -> None:
        head = given.ball
        head.avatar.canonical_vertices[0, 0] = value
        _again(head, path)

    def size(value: float) -> None:
        head = given.ball
        head.avatar.box_size = value
        _again(head, path)

    names = ("tables", "latent", "density.weights.0", "colour.biases.1", "code")
    cases = {name: changed(name) for name in names}
    return _all_refused(
        cases | {"canonical_vertices": vertices, "box_size": size},
        "|".join([*names, "canonical_vertices", "box_size"]),
    )


def _again(head: Head, path: Path) -> None:
    head.avatar.save(path)
    Avatar.load(path)


SCENES = [
    Scene("not a number in a mesh", mesh),
    Scene("not a number in a camera", camera),
    Scene("not a number in parameters", parameters),
    Scene("not a number in a track", track),
    Scene("not a number in pictures", pictures),
    Scene("not a number in weights", weights),
]
