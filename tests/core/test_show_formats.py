"""What tools/show_formats.py wraps: studio pictures that belong to the FLAME-shaped head."""

from pathlib import Path

import formats_fixtures as formats
import numpy as np
import pytest
from test_import import imported

from pav_blender.core.collection import read_collection
from pav_blender.core.evaluation.check import check
from pav_blender.core.training.frames import camera_of
from tools.formats import crowd, wrap

STUDIO = Path(__file__).resolve().parents[2] / "data" / "studio3"


@pytest.fixture(autouse=True)
def config(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("PAV_CONFIG", str(tmp_path_factory.mktemp("config")))


@pytest.fixture(scope="module")
def studio():
    return read_collection(STUDIO)


@pytest.mark.parametrize("name", ["insta", "imavatar", "vhap", "vhap-track"])
def test_a_wrapped_clip_shows_the_studios_head(name, studio, heads, models, tmp_path, monkeypatch):
    clip, version = wrap.SOURCES[name]
    rows = np.array([0, 20, 40, 53])
    take = wrap.perform(studio, studio.clip(clip), rows)
    assert wrap.apart(studio, take, studio.clip(clip), rows) < 3e-4
    monkeypatch.setattr(wrap, "perform", lambda *_: take)
    wrap.write_source(name, studio, tmp_path / "me")
    head = heads[version]
    after = imported([str(tmp_path / "me")], head, tmp_path / "c", models, hold_out=1)
    own = studio.clip(clip)
    for at, row in enumerate(rows):
        truth = camera_of(own, row).project(studio.posed(own, rows[at : at + 1])[0])[0]
        posed = after.posed(after.clips[0], np.array([at]))[0]
        seen = camera_of(after.clips[0], at).project(posed)[0]
        assert np.abs(seen - truth[formats.flame().kept]).mean() < 1.5  # INSTA's neck rests


def test_a_dataset_is_lengthened(heads, models, tmp_path, make):
    make(formats.write_insta, tmp_path / "short")
    crowd.lengthen(tmp_path / "short", tmp_path / "long", 20, 192)
    long = imported([str(tmp_path / "long")], heads["2020"], tmp_path / "c", models)
    clip = long.clips[0]
    assert (len(clip), clip.width, clip.height) == (20, 192, 160)
    np.testing.assert_allclose(clip.pose[13], clip.pose[1], atol=1e-6)
    assert check(long).problems == []
