"""One avatar of several people: their names, one canonical space, whose head is drawn, the file."""

import dataclasses
import json
import struct

import numpy as np
import pytest
import torch
from toy import make_toy

from pav_blender.benchmarks.accuracy import gradients, steps
from pav_blender.benchmarks.accuracy.exact import Exact, some_rays
from pav_blender.benchmarks.plain import quadrature
from pav_blender.cli import main
from pav_blender.core.baking.bake import neutral_scene
from pav_blender.core.errors import Cancelled, InputError, OtherPerson
from pav_blender.core.evaluation.evaluate import evaluate
from pav_blender.core.evaluation.heldout import held_out, score
from pav_blender.core.evaluation.report import measure
from pav_blender.core.field.avatar import Avatar, head_of, read_header
from pav_blender.core.field.identities import (
    appearance_name,
    codes,
    identity,
    own_appearances,
    person_of,
)
from pav_blender.core.images import read_rgba
from pav_blender.core.rendering.render import RenderSettings, pose_scene, render
from pav_blender.core.rendering.sequence import render_track
from pav_blender.core.training.people import parse_people, read_people
from pav_blender.core.training.prepare import load_training_frames, new_avatar
from pav_blender.core.training.preview import MOST_COLUMNS, _sights
from pav_blender.core.training.train import fingerprint, train
from pav_blender.core.training.trainer import Trainer

OTHER = (3.0, -2.5, 2.0, -3.0, 2.5)
NAMES = ["anna/plain", "anna/bushy", "ben/plain", "ben/bushy"]
IDENTITIES = {"anna": NAMES[:2], "ben": NAMES[2:]}


@pytest.fixture(scope="module")
def folders(toy_path, tmp_path_factory):
    """Two people whose looks have the same names; ben's are painted the other way round."""
    other = tmp_path_factory.mktemp("ben") / "ben"
    return {"anna": toy_path, "ben": make_toy(other, betas=OTHER, painted=(1, 0), seed=1)}


@pytest.fixture(scope="module")
def people(folders):
    return read_people(folders)


@pytest.fixture(scope="module")
def path(people, small_config, tmp_path_factory):
    made = tmp_path_factory.mktemp("two") / "two.pav"
    train(people, made, dataclasses.replace(small_config, iterations=150))
    return made


@pytest.fixture(scope="module")
def avatar(path):
    return Avatar.load(path)


def test_people_share_one_canonical_space_and_keep_their_names(people):
    assert people.identities == IDENTITIES
    assert people.appearances == NAMES
    own = [c.head.canonical(c.betas) for c in people.collections.values()]
    np.testing.assert_allclose(people.canonical, (own[0] + own[1]) / 2, atol=1e-7)
    assert np.abs(own[0] - own[1]).max() > 0.004
    np.testing.assert_array_equal(people.betas, np.float32([(0, 0, 0, 0, 0), OTHER]))
    assert people.head_offset is None


def test_offsets_of_some_are_zeros_of_the_others(people):
    ben = people.collections["ben"]
    offset = np.full_like(ben.head.template, 0.01)
    moved = dataclasses.replace(ben, head=ben.head.with_offset(offset), head_offset=offset)
    several = read_people({"anna": people.collections["anna"], "ben": moved})
    np.testing.assert_array_equal(several.head_offset, np.stack([0 * offset, offset]))


def test_frames_know_their_person_by_name_and_appearance(people):
    frames = load_training_frames(people)
    assert {frame.name.split("/")[0]: frame.appearance // 2 for frame in frames} == {
        "anna": 0,
        "ben": 1,
    }
    assert len({frame.name for frame in frames}) == len(frames) == 24
    for frame in frames:
        person, look, _ = frame.name.split("/")
        assert NAMES[frame.appearance] == appearance_name(person, look)


def test_a_preview_shows_everyone(people):
    shown = _sights(people)
    assert len(shown) == MOST_COLUMNS
    assert [NAMES[frame.appearance].split("/")[0] for frame in shown] == ["anna", "ben"] * 2


def test_who_cannot_be_taken_together_is_told(people, folders):
    anna, ben = people.collections.values()
    with pytest.raises(InputError, match="two collections or more"):
        read_people({"anna": anna})
    with pytest.raises(InputError, match="just the face of 'anna'"):
        read_people({"anna": anna, "again": anna})
    with pytest.raises(InputError, match=r"person 'a/b'"):
        read_people({"a/b": anna, "ben": ben})
    head = dataclasses.replace(ben.head, template=ben.head.template * 1.01)
    with pytest.raises(InputError, match="track both with one"):
        read_people({"anna": anna, "ben": dataclasses.replace(ben, head=head)})
    with pytest.raises(InputError, match="no such collection"):
        read_people({"anna": anna, "ben": "nowhere"})


def test_people_are_called_as_their_folders_or_as_one_says(tmp_path):
    for place in ("one/collection", "two/collection", "x=y"):
        (tmp_path / place).mkdir(parents=True)
    one, two, odd = (str(tmp_path / p) for p in ("one/collection", "two/collection", "x=y"))
    assert list(parse_people([one, f"ben={two}", odd])) == ["collection", "ben", "x=y"]
    with pytest.raises(InputError, match=r"write NAME=.*two"):
        parse_people([one, two])


def test_each_person_is_shown_with_the_own_look(avatar, people):
    """Also where the other's look of the same name, or the other's head, would be another."""
    for name, collection in people.collections.items():
        assert own_appearances(avatar, collection) == IDENTITIES[name]
        scores = held_out(avatar, collection, per_appearance=1)
        assert [s.appearance for s in scores] == IDENTITIES[name]
        stranger = {"anna": "ben", "ben": "anna"}[name]
        for own in scores:
            assert own.head_psnr > 17
            look = own.appearance.split("/")[1]
            worn = score(avatar, own.frame, f"{stranger}/{look}", RenderSettings())
            assert worn.head_psnr < own.head_psnr - 2


def test_a_persons_frames_are_measured_in_that_persons_appearances(avatar, people):
    ben = people.collections["ben"]
    assert list(measure(avatar, ben, 1).scores) == IDENTITIES["ben"]
    found = evaluate(avatar, ben, metrics=["head_psnr"], appearances=["bushy"], keep=1)
    assert [score.appearance for score in found.scores] == ["ben/bushy"]
    assert {row["appearance"] for row in found.rows} == {"bushy"}
    assert found.left_out == []


def test_a_stranger_is_told(avatar, people):
    ben = people.collections["ben"]
    stranger = dataclasses.replace(ben, betas=-np.float32(OTHER))
    with pytest.raises(InputError, match="none of anna, ben"):
        held_out(avatar, stranger)


def test_the_density_learns_and_sees_whose_head_it_is(avatar, people):
    assert codes(avatar).tolist() == [[1, 0], [1, 0], [0, 1], [0, 1]]
    weight = avatar.field.density.group_weight
    assert weight.shape[1] == 3 + 2
    assert (weight[:, -2:].abs().sum(0) > 0.1).all()
    assert not torch.allclose(weight[:, -2], weight[:, -1], atol=1e-2)
    rest = people.collections["ben"].head.shaped(OTHER)
    conditions = [pose_scene(avatar, rest, name).condition for name in NAMES]
    assert [c[3:].tolist() for c in conditions] == codes(avatar).tolist()


def test_training_sees_whom_rendering_sees(people, small_config):
    frames = load_training_frames(people)
    trainer = Trainer(new_avatar(people, frames, small_config), frames)
    for frame in (frames[0], frames[-1]):
        name = NAMES[frame.appearance]
        wanted = pose_scene(trainer.avatar, frame.vertices, name, frame.expression)
        torch.testing.assert_close(trainer.scene(frame).condition, wanted.condition)


def test_one_person_costs_nothing(toy_avatar, toy, toy_avatar_path):
    assert toy_avatar.identities == {}
    assert "identities" not in read_header(toy_avatar_path)
    assert toy_avatar.field.density.group_weight.shape[1] == 3
    assert pose_scene(toy_avatar, toy.head.shaped(toy.betas), "plain").condition.shape == (3,)
    assert own_appearances(toy_avatar, toy) == toy.appearances
    assert identity(toy_avatar).betas is toy_avatar.betas


def test_the_head_is_that_of_the_appearance(avatar, people):
    with pytest.raises(InputError, match="anna, ben"):
        head_of(avatar)
    with pytest.raises(InputError, match="unknown appearance"):
        head_of(avatar, "ben/bald")
    for name in NAMES:
        own = people.collections[name.split("/")[0]]
        who = identity(avatar, name)
        assert who.name == name.split("/")[0] == [*IDENTITIES][person_of(avatar, name)]
        shaped = head_of(avatar, name).shaped(who.betas)
        np.testing.assert_allclose(shaped, own.head.shaped(own.betas), atol=1e-6)
    scenes = [neutral_scene(avatar, name) for name in ("anna/plain", "ben/plain")]
    far = np.abs(scenes[0].mesh.vertices - scenes[1].mesh.vertices).max()
    assert far > 0.004


def test_looks_of_one_person_mix_and_of_two_do_not(avatar, people):
    rest = people.collections["anna"].head.shaped(np.zeros(4))
    pose_scene(avatar, rest, {"anna/plain": 0.5, "anna/bushy": 0.5, "ben/plain": 0.0})
    with pytest.raises(InputError, match="'anna/plain' and 'ben/plain' are of two people"):
        pose_scene(avatar, rest, {"anna/plain": 0.5, "ben/plain": 0.5})


def test_a_track_moves_the_person_whose_look_is_rendered(avatar, path, people, folders, tmp_path):
    track, out = f"{folders['ben']}:plain", str(tmp_path / "{appearance}" / "####.png")
    with pytest.raises(OtherPerson, match=r"off anna's .*--other-identity"):
        render_track(path, track, "all", out, frames="7")
    assert not any(tmp_path.iterdir())
    written = render_track(path, track, "ben/plain", out, frames="7", quality="preview")
    assert written == [tmp_path / "ben" / "plain" / "0007.png"]
    frame = held_out(avatar, people.collections["ben"])[1].frame
    preview = RenderSettings.preset("preview")
    expected = render(avatar, frame.vertices, frame.camera, "ben/plain", preview,
                      expression=frame.expression)  # fmt: skip
    assert np.abs(read_rgba(written[0]) / 255 - expected.rgba).max() < 0.01
    driven = render_track(
        path, track, "anna/bushy", out, frames="7", quality="preview", other_identity=True
    )
    assert np.abs(read_rgba(driven[0]).astype(int) - read_rgba(written[0])).max() > 10


def test_an_avatar_file_keeps_its_people(avatar, path, tmp_path):
    assert avatar.identities == read_header(path)["identities"] == IDENTITIES
    assert avatar.betas.shape == (2, 5)
    avatar.save(tmp_path / "again.pav")
    assert (tmp_path / "again.pav").read_bytes() == path.read_bytes()
    avatar.head_offset = np.zeros((2, *avatar.canonical_vertices.shape), np.float32)
    avatar.head_offset[1] += 0.25
    avatar.save(tmp_path / "moved.pav")
    read = Avatar.load(tmp_path / "moved.pav")
    avatar.head_offset = None
    moved = head_of(read, "ben/plain").template - head_of(read, "anna/plain").template
    np.testing.assert_allclose(moved, 0.25, atol=1e-6)


def changed(content, change):
    """A `.pav` file with its JSON header changed."""
    size = struct.unpack("<Q", content[:8])[0]
    outer = json.loads(content[8 : 8 + size])
    header = json.loads(outer["__metadata__"]["pav"])
    change(header)
    outer["__metadata__"]["pav"] = json.dumps(header)
    raw = json.dumps(outer).encode()
    raw += b" " * (-len(raw) % 8)
    return struct.pack("<Q", len(raw)) + raw + content[8 + size :]


@pytest.mark.parametrize(
    "change",
    [
        lambda h: h.pop("identities"),
        lambda h: h.update(identities=None),
        lambda h: h.update(identities=["anna", "ben"]),
        lambda h: h.update(identities={"anna": NAMES}),
        lambda h: h.update(identities={"anna": NAMES, "ben": []}),
        lambda h: h.update(identities={"anna": NAMES[:2], "ben": "ben/plain"}),
        lambda h: h.update(identities={"anna": NAMES[:2], "ben": ["ben/plain", "ben/bald"]}),
        lambda h: h.update(identities={"anna": NAMES[:3], "ben": NAMES[2:]}),
        lambda h: h.update(identities={"anna": NAMES[:1], "ben": NAMES[2:]}),
        lambda h: h.update(identities={"anna": NAMES[:1], "ben": NAMES[1:2], "cy": NAMES[2:]}),
        lambda h: h.update(appearances=[NAMES[0]] * 4),
    ],
)
def test_identities_that_do_not_fit_are_told(path, tmp_path, change):
    (tmp_path / "b.pav").write_bytes(changed(path.read_bytes(), change))
    with pytest.raises(InputError, match=r"b\.pav") as caught:
        Avatar.load(tmp_path / "b.pav")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("shape", [(5,), (3, 5), (2, 5, 1)])
def test_betas_or_offsets_that_are_not_a_row_a_person_are_told(avatar, tmp_path, shape):
    wrong = dataclasses.replace(avatar, betas=np.zeros(shape, np.float32))
    wrong.save(tmp_path / "b.pav")
    with pytest.raises(InputError, match=r"betas are .*2 people"):
        Avatar.load(tmp_path / "b.pav")
    wrong = dataclasses.replace(avatar, head_offset=np.zeros(shape, np.float32))
    wrong.save(tmp_path / "b.pav")
    with pytest.raises(InputError, match="offset"):
        Avatar.load(tmp_path / "b.pav")


@pytest.mark.slow
def test_a_stopped_training_of_several_goes_on_and_not_with_others(people, small_config, tmp_path):
    config = dataclasses.replace(small_config, iterations=3, rays=256)
    whole = train(people, tmp_path / "whole.pav", config)
    calls = iter(range(100))
    with pytest.raises(Cancelled, match="--resume"):
        train(people, tmp_path / "b.pav", config, should_stop=lambda: next(calls) == 1)
    swapped = read_people(dict(reversed(people.collections.items())))
    assert len({fingerprint(source) for source in (people, swapped, people.first)}) == 3
    with pytest.raises(InputError, match="another collection"):
        train(swapped, tmp_path / "b.pav", config, resume=True)
    resumed = train(people, tmp_path / "b.pav", config, resume=True)
    for key, value in whole.field.state_dict().items():
        torch.testing.assert_close(resumed.field.state_dict()[key], value, msg=key)


def test_the_verb_takes_one_collection_or_several_people(folders, tmp_path, capsys):
    out = ["--out", str(tmp_path / "two.pav")]
    people = [f"{name}={folder}" for name, folder in folders.items()]
    for wrong, told in (
        (["train", *out], "--identities"),
        (["train", str(folders["anna"]), *out, "--identities", *people], "--identities"),
        (["train", *out, "--identities", people[0]], "two collections or more"),
        (["train", *out, "--refine-poses", "--identities", *people], "takes one person"),
    ):
        assert main(wrong) == 2
        found = capsys.readouterr().err
        assert told in found
        assert "Traceback" not in found
    assert main(["train", *out, "--iterations", "2", "--identities", *people]) == 0
    assert "anna/plain, anna/bushy, ben/plain, ben/bushy" in capsys.readouterr().out
    assert main(["info", out[1]]) == 0
    assert json.loads(capsys.readouterr().out)["identities"] == IDENTITIES


def test_plain_torch_is_told_whose_head_it_is(people, avatar):
    frame = next(f for f in load_training_frames(people) if f.appearance == 2)
    rays = some_rays(frame, 64, 4)
    scene = pose_scene(avatar, frame.vertices, NAMES[2], frame.expression)
    ours = steps.shown(scene, rays, steps.every(2e-3))
    truth = Exact.of(avatar, frame).shown(rays, 2e-3)
    assert truth.std() > 0.05
    assert steps.differences(ours, truth)["psnr"] > 60

    camera, pixels = frame.camera.resized(16, 16), np.array([16 * 6 + 8, 16 * 11 + 7])
    pose = frame.vertices, frame.expression
    plain = quadrature(avatar, *pose, 2, camera, pixels, 4e-3)
    settings = steps.every(4e-3)
    drawn = render(avatar, pose[0], camera, NAMES[2], settings, expression=pose[1]).rgba
    drawn = drawn.reshape(-1, 4)[pixels]
    assert (drawn[:, 3] > 0.5).all()
    np.testing.assert_allclose(plain[:, :3], drawn[:, :3] * drawn[:, 3:], atol=1e-3)

    claims = gradients.measure(avatar, frame, 64)[1]
    assert all(claim.met for claim in claims), [c for c in claims if not c.met]
