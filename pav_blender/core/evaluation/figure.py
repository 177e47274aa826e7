"""The ablation's figure: target, each method with its error below, and the filmed picture (paper,
Qualitative Ablation Study)."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from ..collection import Collection
from ..errors import InputError
from ..files import replacing
from ..images import read_rgba
from ..rendering.rasterise import rasterise
from ..training.frames import Frame, load_frames
from .heldout import BACKGROUND
from .methods import Method
from .metrics import over
from .sheet import error_map
from .study import Study, example_path


def draw_figure(
    study: Study, methods: list[Method], seed: int, examples: dict[str, str], path: Path
) -> None:
    """A PNG: two rows an appearance. examples: the frame ("clip/number") shown of each
    (`study.Result`). InputError without matplotlib."""
    try:
        figure_module: Any = importlib.import_module("matplotlib.figure")
    except ImportError as error:
        raise InputError("figures need matplotlib: `pip install matplotlib`") from error
    collection = study.collection
    rows, columns = 2 * len(collection.appearances), len(methods) + 2
    figure = figure_module.Figure(figsize=(1.6 * columns, 1.6 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for cell in axes.ravel():
        cell.set_axis_off()
    titles = ["target", *(m.title for m in methods), "filmed"]
    for cell, title in zip(axes[0], titles, strict=True):
        cell.set_title(title, fontsize=7)
    for number, name in enumerate(collection.appearances):
        frame = _frame(collection, examples[name])
        truth = over(frame.rgba / 255, BACKGROUND)
        top, below = axes[2 * number], axes[2 * number + 1]
        top[0].imshow(target(frame, collection.head.triangles))
        top[-1].imshow(truth)
        for cell, under, method in zip(top[1:-1], below[1:-1], methods, strict=True):
            stored = read_rgba(example_path(study, method, seed, name))
            shown = over(stored.astype(np.float32) / 255, BACKGROUND)
            cell.imshow(shown)
            under.imshow(error_map(shown, truth))
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=150)


def _frame(collection: Collection, name: str) -> Frame:
    clip_name, _, frame_id = name.rpartition("/")
    clip = collection.clip(clip_name)
    row = np.flatnonzero(clip.frame_id == int(frame_id))
    return load_frames(collection, clip, row, targets=False)[0]


def target(frame: Frame, triangles: np.ndarray) -> np.ndarray:
    """The posed mesh, shaded from the camera, [H, W, 3] on white: what an avatar is asked for."""
    vertices = frame.vertices
    _, triangle, _ = rasterise(vertices, triangles, frame.camera)
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    towards = -normals @ frame.camera.camera_to_world[:3, 2]
    light = (0.25 + 0.65 * np.clip(towards, 0, 1))[triangle]
    shown = np.where(triangle >= 0, light, BACKGROUND)
    return np.repeat(shown[..., None], 3, axis=-1).astype(np.float32)
