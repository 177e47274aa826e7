"""An INSTA dataset of any length: a short one's frames over and over, with larger pictures."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
from scipy.ndimage import zoom

from pav_blender.core.files import write_text
from pav_blender.core.images import read_rgba, write_rgba

_GRAIN = 2.0  # standard deviation of a camera's noise, steps of 255


def lengthen(source: Path, path: Path, frames: int, size: int) -> None:
    """Writes `path`: `frames` frames of `size` pixels, made of those of `source`.

    Pictures are enlarged, with a grain of their own so that they pack no better than a camera's;
    the files are linked under as many names, and read as often.
    """
    content = json.loads((source / "transforms.json").read_text())
    entries, rng = content["frames"], np.random.default_rng(0)
    scale = size / content["w"]
    for kind in ("images", "seg_mask", "meshes", "flame/exp"):
        (path / kind).mkdir(parents=True)
    listed = []
    for number in range(frames):
        entry = dict(entries[number % len(entries)])
        for key, folder in (("file_path", "images"), ("seg_mask_path", "seg_mask"),
                            ("mesh_path", "meshes"), ("exp_path", "flame/exp")):  # fmt: skip
            old = source / entry[key]
            name = f"{folder}/{number:05d}{old.suffix}"
            first = path / f"{folder}/{number % len(entries):05d}{old.suffix}"
            if number >= len(entries):
                os.link(first, path / name)
            elif old.suffix == ".png":
                write_rgba(path / name, _larger(read_rgba(old), scale, rng, key == "file_path"))
            else:
                os.link(old, path / name)
            entry[key] = name
        listed.append(entry)
    for key in ("w", "h", "cx", "cy", "fl_x", "fl_y"):
        content[key] *= scale
    write_text(path / "transforms.json", json.dumps(content | {"frames": listed}))
    os.link(source / "canonical.obj", path / "canonical.obj")


def _larger(rgba: np.ndarray, scale: float, rng: np.random.Generator, smooth: bool) -> np.ndarray:
    large = zoom(rgba, (scale, scale, 1), order=1 if smooth else 0, grid_mode=True, mode="nearest")
    if smooth:
        noise = rng.normal(0, _GRAIN, large.shape[:2])[..., None]
        grained = np.clip(np.round(large[..., :3] + noise), 0, 255).astype(np.uint8)
        large[..., :3] = np.where(large[..., 3:] > 0, grained, 0)
    return large
