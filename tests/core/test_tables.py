"""Tables: what is trained and measured once, how it is written, and what the ablations mean."""

import dataclasses
import json
import math
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from toy import make_toy

from pav_blender.cli import main
from pav_blender.core.collection import read_collection
from pav_blender.core.config import Config
from pav_blender.core.errors import Cancelled, InputError
from pav_blender.core.evaluation.methods import CHOICES, METHODS, method
from pav_blender.core.evaluation.paper_tables import TABLES
from pav_blender.core.evaluation.study import Result, Study, result
from pav_blender.core.evaluation.tables import Cell, Column, Table, latex, markdown
from pav_blender.core.training import trainer
from pav_blender.core.training.prepare import load_training_frames, new_avatar
from pav_blender.core.training.trainer import Trainer


def _table():
    columns = (Column("psnr", "PSNR", True), Column("fid", "FID", False, 1))
    table = Table("t", "A caption", columns)
    table.rows = [
        ("one", {"psnr": Cell((20.0, 22.0)), "fid": Cell(word="weights absent")}),
        ("two", {"psnr": Cell((25.0, 25.004)), "fid": Cell((3.25,))}),
        ("three", {"psnr": Cell((25.001,)), "fid": Cell((2.0,))}),
    ]
    return table


def test_a_table_shows_means_spreads_and_what_is_best():
    text = markdown(_table())
    assert "| | PSNR ↑ | FID ↓ |" in text
    assert "| one | 21.00 ± 1.41 | weights absent |" in text
    assert "| two | **25.00 ± 0.00** | 3.2 |" in text  # equal as shown: both are best
    assert "| three | **25.00** | **2.0** |" in text


def test_sections_have_bests_of_their_own():
    table = _table()
    table.sections = {0: "above", 2: "below"}
    best = table.best(table.columns[0])
    assert best == {1}  # a section of one row compares nothing
    assert "| **below**" in markdown(table)
    assert r"\multicolumn{3}{c}{below}" in latex(table)


def test_latex_compiles_by_eye():
    text = latex(_table())
    assert r"one & 21.00\,$\pm$\,1.41 & weights absent \\" in text
    assert text.count("{") == text.count("}")


def _results(seeds=2, **psnr):
    def measures(value):
        quality = {"psnr": value, "head_psnr": value + 3, "ssim": 0.9, "st_lpips": 0.1}
        words = dict.fromkeys(("lpips", "dists", "fid"), "weights absent")
        return {"test": quality | words, "novel": quality | words}

    return {
        key: [
            Result(method(key), seed, 100.0, 10**6, 10**7, measures(value + seed), {})
            for seed in range(seeds)
        ]
        for key, value in psnr.items()
    }


def test_the_ablation_claims_what_the_paper_found():
    found = _results(insta=20, no_lnf=24, no_offset=24.5, surface=24, full=25, ours=26)
    tables, claims = TABLES["ablation"].build(found, "caption")
    assert [table.name for table in tables] == ["ablation_test", "ablation_novel"]
    met = {claim.name: claim.met for claim in claims}
    assert met["full above INSTA, unified"]
    assert met["full above PAV without LNF"]
    assert not met["full above PAV without density offset"]
    assert met["ours better than full: PSNR (dB)"]
    assert not any("LPIPS" in name and "ST-" not in name for name in met)  # words claim nothing
    assert "weights absent" in markdown(tables[0])


def test_one_network_is_compared_with_one_a_clip():
    found = _results(insta=20, insta_clips=25, full=25, ours=24.8)
    tables, claims = TABLES["comparison"].build(found, "caption")
    assert len(tables[0].rows) == 9
    assert set(tables[0].sections) == {0, 3, 6}
    assert [claim.met for claim in claims] == [True, True, True]
    for run in found["insta_clips"]:
        run.seconds, run.bytes = 290.0, 10**8
    _, claims = TABLES["efficiency"].build(found, "caption")
    assert [claim.met for claim in claims] == [False, True, True]


def test_each_choice_of_ours_is_taken_back_alone():
    ours = Config().to_json()
    for choice in CHOICES:
        changed = {k for k, v in choice.config.to_json().items() if v != ours[k]}
        several = choice.key in ("from_fog", "paper_rates")
        assert len(changed) > 1 if several else len(changed) == 1
    found = _results(**{**{choice.key: 25 for choice in CHOICES}, "ours": 26, "rigid": 26.5})
    tables, claims = TABLES["choices"].build(found, "caption")
    assert [table.name for table in tables] == ["choices_test", "choices_novel"]
    assert len(tables[0].rows) == len(CHOICES) + 1
    assert [claim.name for claim in claims if not claim.met] == [
        "ours above ours, a rigid frame a triangle"
    ]


def test_a_method_of_each_row_and_no_other():
    needed = {key for table in TABLES.values() for key in table.needs}
    assert needed | {"ours_two"} == {m.key for m in METHODS}
    with pytest.raises(InputError, match="method 'x': one of insta"):
        method("x")


@pytest.mark.parametrize("key", ["insta", "no_offset", "no_lnf", "full"])
def test_appearances_share_their_space_where_they_share_their_density(toy, key):
    """Else mattes would tell a network without appearances which of them it draws."""
    frames = load_training_frames(toy)
    config = dataclasses.replace(method(key).config, rays=256, log2_entries=10, latent_size=16)
    trainer = Trainer(new_avatar(toy, frames, config), frames)
    for _ in range(3):
        trainer.iterate()
    cells = np.prod(trainer.avatar.occupied.shape[1:])
    trainer.visibility.looks[:cells] = 100.0  # the first appearance saw everything, and nothing
    trainer.visibility.weight[:cells] = 0.0
    trainer.visibility.prune()
    first, second = trainer.avatar.occupied
    assert config.one_geometry == (key in ("insta", "no_offset"))
    assert (first == second).all() == config.one_geometry
    assert first.any() == config.one_geometry


@pytest.fixture
def quick(monkeypatch):
    """Methods small enough for a test; their differences stay."""
    import pav_blender.core.evaluation.methods as methods

    small = {"rays": 256, "log2_entries": 10, "latent_size": 16, "global_channels": 8}
    shrunk = tuple(
        dataclasses.replace(m, config=dataclasses.replace(m.config, **small)) for m in METHODS
    )
    monkeypatch.setattr(methods, "METHODS", shrunk)
    return {m.key: m for m in shrunk}


def test_what_is_there_is_not_made_again(toy, quick, tmp_path, monkeypatch):
    monkeypatch.setattr(trainer, "time", SimpleNamespace(monotonic=lambda: 0.0))
    study = Study(toy, tmp_path, iterations=3, per_appearance=1)
    first = result(study, quick["insta_clips"], 0)
    files = sorted(tmp_path.glob("*.pav"))
    assert [f.name for f in files] == ["insta_clips-0-bushy.pav", "insta_clips-0-plain.pav"]
    assert first.bytes == sum(f.stat().st_size for f in files)
    assert set(first.measures) == {"test"}
    assert set(first.examples) == {"plain", "bushy"}
    times = [f.stat().st_mtime_ns for f in files]
    again = result(study, quick["insta_clips"], 0)
    assert again == first or vars(again) == vars(first)
    assert [f.stat().st_mtime_ns for f in files] == times
    # trained anew where the settings are others, and measured anew then, however long it took
    longer = result(dataclasses.replace(study, iterations=4), quick["insta_clips"], 0)
    assert all(f.stat().st_mtime_ns != t for f, t in zip(files, times, strict=True))
    assert longer.measures != first.measures
    # another performance is measured beside what was
    novel = result(dataclasses.replace(study, iterations=4, novel=toy), quick["insta_clips"], 0)
    assert set(novel.measures) == {"test", "novel"}
    # what could not be measured then is measured when it can be
    known = tmp_path / "insta_clips-0.json"
    stored = json.loads(known.read_text())
    for name in ("test", "novel"):
        stored["sets"][name]["summary"]["ssim"] = "package absent"
    known.write_text(json.dumps(stored))
    once_more = result(dataclasses.replace(study, iterations=4, novel=toy), quick["insta_clips"], 0)
    assert once_more.measures == novel.measures
    known.write_text("{")
    with pytest.raises(InputError, match=r"insta_clips-0\.json: not readable as JSON"):
        result(study, quick["insta_clips"], 0)


def test_a_study_that_was_stopped_goes_on(toy, quick, tmp_path):
    study = Study(toy, tmp_path, iterations=3, per_appearance=1)
    seen = []
    with pytest.raises(Cancelled, match="what was measured"):
        result(
            study,
            quick["ours"],
            0,
            measuring=lambda done, **_: seen.append(done),
            should_stop=lambda: (tmp_path / "ours-0.pav").is_file() and len(seen) > 0,
        )
    assert len(seen) == 1
    assert not (tmp_path / "ours-0.json").exists()
    trained = (tmp_path / "ours-0.pav").stat().st_mtime_ns
    assert result(study, quick["ours"], 0).measures["test"]
    assert (tmp_path / "ours-0.pav").stat().st_mtime_ns == trained


def test_two_people_have_a_row_of_the_comparison(toy, quick, tmp_path):
    other = read_collection(make_toy(tmp_path / "other", frames=4, size=32, betas=(2, 2, 2, 2)))
    study = Study(toy, tmp_path, iterations=2, per_appearance=1)
    with pytest.raises(InputError, match="'ours_two' needs another person's clips"):
        result(study, quick["ours_two"], 0)
    found = result(dataclasses.replace(study, other=other), quick["ours_two"], 0)
    assert set(found.examples) == set(toy.appearances)
    assert math.isfinite(found.measures["test"]["psnr"])


def test_the_verb_writes_every_form_of_a_table(toy, quick, tmp_path, capsys):
    out = tmp_path / "out"
    argv = ["--collection", str(toy.path), "--out", str(out), "--iterations", "2"]
    argv += ["--seeds", "1", "--per-appearance", "1"]
    assert main(["table", "efficiency", *argv, "--only", "insta_clips"]) == 0
    assert not (out / "efficiency.json").exists()
    assert main(["table", "efficiency", *argv]) == 0
    proof = json.loads((out / "efficiency.json").read_text())
    assert {"name", "value", "target", "unit", "met"} == set(proof["claims"][0])
    assert math.isfinite(proof["results"]["ours"][0]["measures"]["test"]["psnr"])
    for suffix in (".md", ".tex", ".png"):
        assert (out / f"efficiency{suffix}").stat().st_size > 100
    assert "INSTA, one a clip" in capsys.readouterr().out
    code = main(["table", "efficiency", *argv, "--check"])
    assert code == (0 if all(c["met"] for c in proof["claims"]) else 1)
    assert main(["table", "ablation", *argv, "--only", "nothing"]) == 2
    assert main(["table", "ablation", *argv[:-2], "--seeds", "0"]) == 2
    shutil.rmtree(out)


def test_defaults_have_a_density_an_appearance():
    assert not Config().one_geometry
    assert not Config.paper().one_geometry
