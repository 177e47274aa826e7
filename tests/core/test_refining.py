import dataclasses
import json

import numpy as np
import pytest
import torch
from toy import make_toy

from pav_blender.cli import main
from pav_blender.core.collection import read_collection
from pav_blender.core.config import Config
from pav_blender.core.deformation.rigid import head_rotation
from pav_blender.core.errors import Cancelled, InputError
from pav_blender.core.field.avatar import Avatar
from pav_blender.core.images import read_rgba
from pav_blender.core.rendering.render import pose_scene
from pav_blender.core.training import refine, refiner
from pav_blender.core.training.corrections import (
    RIGID,
    corrected_clip,
    corrected_mesh,
    mesh_changes,
    middle_of,
    motion,
    seen_from,
    space_of,
)
from pav_blender.core.training.frames import load_frames
from pav_blender.core.training.prepare import load_training_frames, new_avatar
from pav_blender.core.training.refined import refined_writer
from pav_blender.core.training.refiner import EXPRESSION, OFF, POSE, Verdict
from pav_blender.core.training.train import train
from pav_blender.core.training.trainer import Trainer

TURN, SHIFT = np.radians(2.0), 3e-3  # how wrong the tracks are made, in the mean


def weights_of(head) -> np.ndarray:
    return (head.regions["scalp"] | head.regions["ears"]).astype(np.float32)


def errors(count: int, size: int, seed: int = 0) -> np.ndarray:
    """Corrections [count, size] that turn and shift by TURN and SHIFT some way."""
    random = np.random.default_rng(seed)
    out = np.zeros((count, size))
    for columns, length in ((slice(0, 3), TURN), (slice(3, RIGID), SHIFT)):
        way = random.normal(size=(count, 3))
        out[:, columns] = way / np.linalg.norm(way, axis=1, keepdims=True) * length
    return out


def mistrack(collection, path) -> None:
    """The same pictures under tracks that are wrong by known motions."""
    space = space_of(collection)
    with refined_writer(collection, path, {}) as writer:
        for number, clip in enumerate(collection.clips):
            wrong = dict(enumerate(errors(len(clip), len(space), number)))
            weights = weights_of(collection.head)
            writer.clip(corrected_clip(collection, clip, space, wrong, weights))
            for row in range(len(clip)):
                picture = read_rgba(collection.image_path(clip, row))
                writer.image(clip.name, int(clip.frame_id[row]), picture)


def misses(collection, truth, split: str) -> tuple[float, float]:
    """Degrees and millimetres across the view that the head's track is off, in the mean."""
    degrees, lengths = [], []
    skin = truth.head.regions["face"] | truth.head.regions["scalp"]
    for clip, own in zip(collection.clips, truth.clips, strict=True):
        rows = clip.indices(split)
        found, right = (c.posed(k, rows)[:, skin] for c, k in ((collection, clip), (truth, own)))
        for a, b in zip(found, right, strict=True):
            turn = head_rotation(b, a, np.ones(len(b)))
            degrees.append(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
            lengths.append(1e3 * np.linalg.norm((a - b)[:, :2], axis=1).mean())
    return float(np.mean(degrees)), float(np.mean(lengths))


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    return read_collection(make_toy(tmp_path_factory.mktemp("t") / "truth", frames=10, size=96))


@pytest.fixture(scope="module")
def off_track(truth, tmp_path_factory):
    path = tmp_path_factory.mktemp("o") / "collection"
    mistrack(truth, path)
    return read_collection(path)


@pytest.fixture
def always(monkeypatch):
    """Everything is kept, however little it is worth."""
    monkeypatch.setattr(refiner, "_GAIN", -np.inf)
    monkeypatch.setattr(refiner, "_PIXELS", 150)  # an untrained avatar is fog, slow to look through


def stop_at(call: int):
    """A `should_stop` that says so once, when it is asked for that time."""
    calls = iter(range(10_000))
    return lambda: next(calls) == call


@pytest.mark.parametrize("own_vertices", [False, True])
def test_a_correction_moves_the_head_as_it_says(toy, own_vertices):
    clip, space = toy.clips[0], space_of(toy)
    if own_vertices:
        clip = dataclasses.replace(clip, vertices=toy.posed(clip, np.arange(len(clip))))
    correction = errors(1, len(space))[0]
    tracked = toy.posed(clip, np.array([2]))[0]
    moving = motion(correction, middle_of(tracked, weights_of(toy.head)))
    assert np.linalg.norm(moving[:3, 3]) > 1e-3
    out = corrected_clip(toy, clip, space, {2: correction}, weights_of(toy.head))
    expected = tracked @ moving[:3, :3].T + moving[:3, 3]
    np.testing.assert_allclose(toy.posed(out, np.array([2]))[0], expected, atol=2e-6)
    parametric = dataclasses.replace(out, vertices=None)
    np.testing.assert_allclose(toy.posed(parametric, np.array([2]))[0], expected, atol=2e-6)
    np.testing.assert_array_equal(out.pose[3], clip.pose[3])
    frame = load_frames(toy, toy.clips[0], np.array([2]), targets=False)[0]
    ours = seen_from(frame.camera, moving).project(tracked)[0]
    np.testing.assert_allclose(ours, frame.camera.project(expected)[0], atol=1e-6)


def test_only_expressions_that_the_track_uses_are_corrected(toy):
    space = space_of(toy)
    assert [toy.head.expression_names[row] for row in space.rows] == ["jawOpen"]
    assert 0 < space.low[0] < space.high[0] <= 1
    wild = np.concatenate([np.zeros(RIGID), [5.0]])
    own = toy.clips[0].expression[0]
    assert own[space.rows] + space.bounded(wild, own)[RIGID:] == pytest.approx(space.high)


def test_rays_moved_back_show_the_derivative_by_a_mesh_that_moves(toy, toy_avatar):
    """Against a head posed anew: by its motion, and by a mouth that opens."""
    clip, row, space = toy.clips[0], 3, space_of(toy)
    frame = load_frames(toy, clip, np.array([row]), targets=False)[0]
    middle = middle_of(frame.vertices, toy_avatar.rigid_weights)
    random = np.random.default_rng(0)
    sight = refine.choose_pixels(frame.rgba, frame.camera, 800, random)
    nothing = np.zeros(len(space))
    scene = pose_scene(toy_avatar, frame.vertices, clip.appearance, frame.expression)
    rays = refine.camera_rays(frame.camera, sight.columns, sight.rows)
    _, points = refine._trace(scene, rays)
    changes = mesh_changes(toy, clip, row, space)
    jacobian, _ = refine._jacobian(scene, frame.camera, rays, points, middle, changes, len(space))
    for index in range(len(space)):
        step = np.zeros(len(space))
        step[index] = 0.7 * (0.02, 3e-3, 0.2)[(index >= 3) + (index >= RIGID)]
        ends = []
        for sign in (1, -1):
            mesh, expression = corrected_mesh(toy, clip, row, space, sign * step)
            moving = motion(sign * step, middle)
            moved = (mesh @ moving[:3, :3].T + moving[:3, 3]).astype(np.float32)
            other = pose_scene(toy_avatar, moved, clip.appearance, expression)
            ends.append(refine.look(other, sight, nothing, middle))
        true = (ends[0] - ends[1]).reshape(-1)
        ours = 2 * step[index] * jacobian[..., index].reshape(-1)
        assert true.std() > 1e-3
        assert np.corrcoef(true, ours)[0, 1] > 0.6, index
        if index != 5:  # along the view next to nothing changes
            assert 0.6 < ours.std() / true.std() < 1.4, index


def solve(toy, avatar, row: int, wrong: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Motions [V, 3] of a frame's mesh: off by `wrong`, and corrected again."""
    clip, space = toy.clips[0], space_of(toy)
    frame = load_frames(toy, clip, np.array([row]), targets=False)[0]
    middle = middle_of(frame.vertices, avatar.rigid_weights)
    scene = pose_scene(avatar, frame.vertices, clip.appearance, frame.expression)
    sight = refine.choose_pixels(frame.rgba, frame.camera, 800, np.random.default_rng(row))
    # the head lies as it should and the camera off it: the same as a head that was tracked wrong
    off = dataclasses.replace(sight, camera=seen_from(sight.camera, motion(wrong, middle)))
    nothing = np.zeros(len(space))
    found = refine.correct(scene, off, nothing, middle, space, None, frame.expression)
    ends = []
    for moving in (motion(wrong, middle), motion(wrong, middle) @ motion(found, middle)):
        ends.append(frame.vertices @ moving[:3, :3].T + moving[:3, 3] - frame.vertices)
    return ends[0], ends[1]


def across(moved: np.ndarray) -> float:
    """Millimetres across the view, in the mean."""
    return float(1e3 * np.linalg.norm(moved[:, :2], axis=1).mean())


def across_of(correction: np.ndarray, middle: np.ndarray, vertices: np.ndarray) -> float:
    moving = motion(correction, middle)
    return across(vertices @ moving[:3, :3].T + moving[:3, 3] - vertices)


def test_the_track_of_a_frame_is_found_again(toy, toy_avatar):
    wrong = errors(3, len(space_of(toy)))
    pairs = [solve(toy, toy_avatar, row, e) for row, e in zip((1, 3, 4), wrong, strict=True)]
    before, after = np.array([[across(a), across(b)] for a, b in pairs]).T
    assert before.min() > 3
    assert (after < 0.45 * before).all(), (before, after)


def test_a_right_track_stays(toy, toy_avatar):
    """A pixel is six millimetres here."""
    nothing = np.zeros(len(space_of(toy)))
    moved = [across(solve(toy, toy_avatar, row, nothing)[1]) for row in (1, 3, 4)]
    assert max(moved) < 0.9, moved


def test_a_mouth_that_was_tracked_closed_is_opened(toy, toy_avatar):
    clip, space = toy.clips[0], space_of(toy)
    row = int(np.argmax(clip.expression[:6, space.rows[0]]))
    closed = dataclasses.replace(clip, expression=clip.expression.copy())
    closed.expression[row, space.rows[0]] -= 0.2
    frame = load_frames(toy, closed, np.array([row]), targets=False)[0]
    middle = middle_of(frame.vertices, toy_avatar.rigid_weights)
    scene = pose_scene(toy_avatar, frame.vertices, clip.appearance, frame.expression)
    sight = refine.choose_pixels(frame.rgba, frame.camera, 800, np.random.default_rng(0))
    changes = mesh_changes(toy, closed, row, space)
    nothing = np.zeros(len(space))
    found = refine.correct(scene, sight, nothing, middle, space, changes, frame.expression)
    assert 0.1 < found[RIGID] < 0.3, found
    assert across_of(found, middle, frame.vertices) < 0.9


def test_what_is_kept_is_what_helps():
    def decided(tracked, pose, expression):
        verdict = Verdict(tracked=tracked, pose=pose, expression=expression)
        verdict.decide()
        return verdict.kept

    assert decided(None, None, None) == OFF
    assert decided(25.0, 25.22, 25.25) == OFF
    assert decided(25.0, 26.0, 26.2) == POSE
    assert decided(25.0, 26.0, None) == POSE
    assert decided(25.0, 26.0, 27.0) == EXPRESSION
    assert decided(25.0, 24.0, 24.5) == OFF


@pytest.mark.slow
def test_a_wrong_track_is_corrected_and_written(truth, off_track, small_config, tmp_path, capsys):
    out, refined_path = tmp_path / "a.pav", tmp_path / "refined"
    arguments = ["train", off_track.path, "--out", out, "--iterations", 200, "--refine-poses"]
    before = {p: p.read_bytes() for p in off_track.path.rglob("*") if p.is_file()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Config, "preset", classmethod(lambda cls, name: small_config))
        assert main([str(a) for a in (*arguments, "--refined-collection", refined_path)]) == 0
    printed = capsys.readouterr().out
    refined = read_collection(refined_path)
    found = {split: misses(refined, truth, split) for split in ("train", "test")}
    given = {split: misses(off_track, truth, split) for split in ("train", "test")}
    for index in (0, 1):  # degrees, millimetres
        assert found["train"][index] < 0.75 * given["train"][index]
    assert found["test"][0] < given["test"][0]  # turned farther than any frame learned from
    record = Avatar.load(out).record["refinement"]
    assert record == refined.extra["refinement"]["clips"]
    assert "test" in refined.extra["refinement"]["note"]
    for clip in refined.clips:
        assert f"{clip.name}: {record[clip.name]['kept']} corrected" in printed
        assert record[clip.name]["frames"] == len(clip)
        np.testing.assert_array_equal(clip.split, off_track.clip(clip.name).split)
        for row in range(len(clip)):
            picture = read_rgba(refined.image_path(clip, row))
            np.testing.assert_array_equal(picture, read_rgba(off_track.image_path(clip, row)))
    assert all(path.read_bytes() == content for path, content in before.items())
    assert {p.name for p in tmp_path.iterdir()} == {"a.pav", "refined"}


def test_where_it_does_not_help_the_track_stays(toy, small_config, tmp_path, monkeypatch):
    monkeypatch.setattr(refiner, "_GAIN", np.inf)
    config = dataclasses.replace(small_config, iterations=8, rays=256, refine_poses=True)
    avatar = train(toy, tmp_path / "a.pav", config, refined=tmp_path / "refined")
    refined = read_collection(tmp_path / "refined")
    for clip, own in zip(refined.clips, toy.clips, strict=True):
        entry = avatar.record["refinement"][clip.name]
        assert entry["kept"] == OFF
        assert entry["frames"] == 0
        assert min(entry["psnr_tracked"], entry["psnr_pose"]) > 5
        np.testing.assert_array_equal(clip.pose, own.pose)
        np.testing.assert_array_equal(clip.expression, own.expression)


@pytest.mark.slow
def test_the_same_input_gives_the_same_and_so_does_a_stopped_training(
    toy, small_config, tmp_path, always
):
    config = dataclasses.replace(small_config, iterations=8, rays=256, refine_poses=True)
    whole = train(toy, tmp_path / "whole.pav", config, refined=tmp_path / "whole")
    kinds = {entry["kept"] for entry in whole.record["refinement"].values()}
    assert kinds == {EXPRESSION}
    again = train(toy, tmp_path / "again.pav", config)
    for key, value in whole.field.state_dict().items():
        assert torch.equal(again.field.state_dict()[key], value), key
    with pytest.raises(Cancelled, match="--resume"):  # between the rounds
        train(toy, tmp_path / "again.pav", config, should_stop=stop_at(4))
    resumed = train(toy, tmp_path / "again.pav", config, resume=True)
    for key, value in again.field.state_dict().items():
        torch.testing.assert_close(resumed.field.state_dict()[key], value, msg=key)
    for name, entry in again.record["refinement"].items():
        assert resumed.record["refinement"][name] == pytest.approx(entry, abs=0.011)
    out, folder = tmp_path / "late.pav", tmp_path / "late"
    with pytest.raises(Cancelled, match="--resume"):  # in the pass over all frames at the end
        train(toy, out, config, refined=folder, should_stop=stop_at(10))
    assert not folder.exists()
    assert not out.exists()
    train(toy, out, config, refined=folder, resume=True)
    for clip in toy.clips:
        one, other = (read_collection(p).clip(clip.name) for p in (tmp_path / "whole", folder))
        assert np.abs(one.pose - clip.pose).max() > 1e-4
        assert np.abs(one.expression - clip.expression).max() > 1e-4
        np.testing.assert_allclose(one.pose, other.pose, atol=1e-5)
        np.testing.assert_allclose(one.expression, other.expression, atol=1e-4)


def test_hostile_pictures_do_no_harm(toy, small_config, always):
    """Frames with nothing on them, with one pixel, or of noise: no correction runs away."""
    frames, random = load_training_frames(toy), np.random.default_rng(0)
    for number, frame in enumerate(frames):
        rgba = np.zeros_like(frame.rgba)
        if number % 3 == 1:
            rgba[20, 30] = 255
        elif number % 3 == 2:
            rgba = random.integers(0, 256, frame.rgba.shape, np.uint8)
        frames[number] = dataclasses.replace(frame, rgba=rgba)
    config = dataclasses.replace(small_config, refine_poses=True)
    held = refiner.kept_out(toy, frames)
    blank = {frame.name for frame in frames if not frame.rgba.any()}
    assert len(held) == 2
    assert not held & blank
    trainer = Trainer(new_avatar(toy, load_training_frames(toy), config), frames)
    refining = refiner.Refiner(toy, frames, held, trainer)
    refining.advance(0.5)
    for frame in frames[:3]:
        refining(frame)
    sigma = refining.space.sigma
    for correction, _ in refining.known.values():
        assert (np.abs(correction) <= 6 * sigma).all()
    json.dumps(refining.record(), allow_nan=False)


def test_what_can_not_be_is_refused_before_the_work(toy, small_config, tmp_path):
    on = dataclasses.replace(small_config, refine_poses=True, iterations=6)
    out = tmp_path / "a.pav"
    with pytest.raises(InputError, match="--refine-poses"):
        train(toy, out, small_config, refined=tmp_path / "refined")
    with pytest.raises(InputError, match="exists already"):
        train(toy, out, on, refined=toy.path)
    with pytest.raises(Cancelled):
        train(toy, out, dataclasses.replace(on, refine_poses=False), should_stop=lambda: True)
    with pytest.raises(InputError, match="other settings"):
        train(toy, out, on, resume=True)
