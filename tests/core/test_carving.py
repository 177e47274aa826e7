"""Space carved by the mattes of studio pictures, whole and cut off above the shoulders."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from scipy import ndimage

from pav_blender.core.collection import read_collection
from pav_blender.core.deformation import Deformer
from pav_blender.core.training import carving
from pav_blender.core.training.frames import Frame, load_frames

STUDIO = Path(__file__).parents[2] / "data" / "studio3"
CELLS, SHOWN = 48, 160  # rows of a picture, of 256


class Filmed(NamedTuple):
    canonical: np.ndarray
    triangles: np.ndarray
    frames: list[Frame]
    reach: np.ndarray
    corner: np.ndarray
    size: float


@pytest.fixture(scope="module")
def crop():
    collection = read_collection(STUDIO)
    clip = collection.clip("crop")
    frames = load_frames(collection, clip, clip.indices("train")[::8], targets=False)
    canonical, triangles = collection.head.canonical(collection.betas), collection.head.triangles
    reach = carving.reach_of(canonical, triangles, collection.head.regions, frames, 0.13)
    corner, size = carving.hull_box(canonical, triangles, frames, reach)
    return Filmed(canonical, triangles, frames, reach, corner, size)


def _shortened(frame):
    camera = frame.camera.window(0, 0, frame.camera.width, SHOWN)
    return dataclasses.replace(frame, rgba=frame.rgba[:SHOWN], camera=camera)


def _carved(crop, frames):
    return carving.carve(*crop[:2], frames, crop.reach, crop.corner, crop.size, CELLS)


def _from_mesh(crop, cells):
    """Metres from the middles of cells [G, G, G] bool to the mesh."""
    deformer = Deformer(crop.canonical, crop.triangles, "affine")
    places = (np.argwhere(cells) + 0.5) * crop.size / CELLS + crop.corner
    points = torch.from_numpy(places.astype(np.float32))
    return deformer.nearest(deformer.pose(crop.canonical), points)[2].numpy()


def test_what_pictures_show_as_empty_goes(crop):
    empty = [dataclasses.replace(f, rgba=np.zeros_like(f.rgba)) for f in crop.frames]
    assert 0.02 < _carved(crop, crop.frames).mean() < 0.3
    assert not _carved(crop, empty).any()


def test_a_person_goes_on_a_little_where_pictures_end(crop, monkeypatch):
    short = [_shortened(frame) for frame in crop.frames]
    whole, kept = _carved(crop, crop.frames), _carved(crop, short)
    monkeypatch.setattr(carving, "_BEYOND", 0.0)
    shown = _carved(crop, short)
    assert (kept >= shown).all()
    apart = ndimage.distance_transform_edt(~shown, sampling=crop.size / CELLS)
    added = kept & ~shown
    assert added.sum() > 200
    assert apart[added].max() <= 0.04
    assert _from_mesh(crop, added).max() <= 0.015 + crop.size / CELLS / 2
    # of what longer pictures show just below, most is there
    below = whole & ~shown & (apart <= 0.04)
    assert (kept & below).sum() > 0.5 * below.sum()
    # and they have carved nothing off it: cloth goes on close to the skin
    assert (whole & added).sum() > 0.9 * added.sum()


def test_the_box_holds_what_is_kept(crop):
    """Shoulders leave the pictures to both sides, which is where the box is widest."""
    wide = crop.size + 0.2
    kept = carving.carve(*crop[:2], crop.frames, crop.reach, crop.corner - 0.1, wide, 2 * CELLS)
    places = (np.argwhere(kept) + 0.5) * wide / (2 * CELLS) - 0.1
    assert ((places > 0) & (places < crop.size)).all(axis=1).mean() > 0.999
