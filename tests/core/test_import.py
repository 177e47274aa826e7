"""Folders of other programs as collections: the same vertices at the same pixels."""

import json
import os
import pickle
from pathlib import Path

import formats_fixtures as formats
import numpy as np
import pytest

from pav_blender.core.collection import LABELS, read_collection
from pav_blender.core.collection.importers import detect, normalise, read_sources, write_person
from pav_blender.core.errors import InputError
from pav_blender.core.evaluation.check import check
from pav_blender.core.head.flame import FlameFiles, find_flame, read_flame
from pav_blender.core.head.library import remember_head
from pav_blender.core.images import read_gray, read_rgba
from pav_blender.core.training.frames import camera_of


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """Folders with FLAME 2020 (and its companions) and FLAME 2023, both of the same numbers."""
    root = tmp_path_factory.mktemp("flame")
    for version, name in (("2020", "generic_model.pkl"), ("2023", "flame2023.pkl")):
        (root / version).mkdir()
        formats.write_model(root / version / name, chumpy=version == "2020")
        formats.write_companions(root / version)
    return root


@pytest.fixture(scope="module")
def heads(models):
    return {version: read_flame(models / version) for version in ("2020", "2023")}


@pytest.fixture(autouse=True)
def config(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("PAV_CONFIG", str(tmp_path_factory.mktemp("config")))


def imported(sources, head, out, models, **options):
    """The collection that sources become, read back from disk."""
    person = normalise(read_sources(sources), head, **options)
    write_person(person, out)
    for version in ("2020", "2023"):
        if head.name == f"FLAME {version}":
            remember_head(models / version)
    return read_collection(out)


def misses(collection, clip, truth):
    """The farthest that any vertex lies from where the tool's own camera shows it, pixels."""
    worst = 0.0
    for row, number in enumerate(clip.frame_id):
        vertices = collection.posed(clip, np.array([row]))[0]
        pixels, depth = camera_of(clip, row).project(vertices)
        assert (depth > 0).all()
        worst = max(worst, float(np.abs(pixels - truth[int(number)]).max()))
    return worst


FORMATS = {
    "insta": (formats.write_insta, {}, "2020"),
    "insta without its canonical mesh": (formats.write_insta, {"canonical": False}, "2020"),
    "metrical": (formats.write_metrical, {}, "2020"),
    "metrical without meshes": (formats.write_metrical, {"meshes": False}, "2020"),
    "flashavatar": (formats.write_flashavatar, {}, "2020"),
    "vhap": (formats.write_vhap, {}, "2023"),
    "vhap with moving offsets": (formats.write_vhap, {"dynamic": True}, "2023"),
    "vhap-track": (formats.write_vhap_track, {}, "2023"),
    "imavatar": (formats.write_imavatar, {}, "2020"),
    "imavatar of pixels": (formats.write_imavatar, {"pixels_512": True}, "2020"),
}


@pytest.mark.parametrize("name", FORMATS)
def test_vertices_are_seen_where_the_tool_saw_them(name, tmp_path, heads, models):
    write, options, version = FORMATS[name]
    act = write(tmp_path / "source", **options)
    assert detect(tmp_path / "source") == name.split()[0]
    collection = imported([f"me={tmp_path / 'source'}"], heads[version], tmp_path / "c", models)
    clip = collection.clip("me")
    assert len(clip) == formats.FRAMES
    assert misses(collection, clip, act.truth) < 0.1
    assert not clip.pose[:, 0].any()
    assert not clip.translation.any()
    found = check(collection)
    assert found.problems == []
    assert found.summary[0]["face_in_matte"] > 0.95
