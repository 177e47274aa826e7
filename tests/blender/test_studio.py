"""The studio: geometry equals the head model, pictures line up with their truth, renders repeat."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from pav_blender.core.collection import LABELS, read_collection
from pav_blender.core.errors import InputError
from pav_blender.core.head import builtin_head
from pav_blender.core.images import read_gray, read_rgba
from pav_blender.core.progress import Progress
from pav_blender.core.rendering.cameras import Camera
from pav_blender.core.rendering.rasterise import rasterise

bpy = pytest.importorskip("bpy")

from pav_blender.studio import motion, render, render_collection, subdivision  # noqa: E402
from pav_blender.studio.appearances import APPEARANCES  # noqa: E402
from pav_blender.studio.identity import identity  # noqa: E402
from pav_blender.studio.person import build_person  # noqa: E402

DEFAULT = Path(__file__).parents[2] / "data" / "studio3"


@pytest.fixture(scope="module")
def person():
    head = builtin_head()
    return build_person(head, identity(head, 0))


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Three frames and one held-out view of the first appearance, with full truth."""
    path, told = tmp_path_factory.mktemp("studio") / "small", io.StringIO()
    render_collection(
        path, appearances=1, frames=3, size=96, seed=4, views=(35.0,), samples=4,
        progress=Progress("film", stream=told),
    )  # fmt: skip
    assert "film 100.0 %  step filming" in told.getvalue()
    return read_collection(path)


def test_a_cube_rounds_to_the_catmull_clark_values():
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    faces = np.array(
        [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    )
    matrix, quads = subdivision.subdivide(faces, 8)
    points = matrix @ corners
    assert len(points) == 8 + 6 + 12
    assert quads.shape == (24, 4)
    # a corner: (F + 2R + 0P) / 3 with F = 1/3 and R = 2/3 of it; a face: its middle
    np.testing.assert_allclose(points[7], np.full(3, 5 / 9), atol=1e-12)
    np.testing.assert_allclose(np.sort(np.abs(points[8:14]).sum(1)), np.ones(6), atol=1e-12)
    edge = points[14:]
    np.testing.assert_allclose(np.sort(np.abs(edge), 1), np.tile([0, 0.75, 0.75], (12, 1)))


def test_triangles_become_the_quads_they_were_cut_from():
    quads = np.array([[0, 1, 4, 3], [1, 2, 5, 4], [3, 4, 7, 6]])
    halves = [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    extra = np.array([[6, 7, 8]])
    for cut in (np.stack(halves, 1).reshape(-1, 3), np.concatenate(halves)):
        faces = subdivision.quads_of(np.concatenate([cut, extra]))
        np.testing.assert_array_equal(faces[:3], quads)
        np.testing.assert_array_equal(faces[3:], [[6, 7, 8, -1]])


def test_the_refined_mesh_follows_the_head_model(person):
    head = person.head
    rng = np.random.default_rng(1)
    played = motion.perform(head, 4, rng)
    posed = head.pose(person.betas, played.expression, played.pose, played.translation).numpy()
    for k in range(4):
        mine = person.posed(played.expression[k], played.pose[k], played.translation[k])
        np.testing.assert_allclose(mine, posed[k], atol=1e-7)
    np.testing.assert_allclose(np.asarray(person.matrix.sum(1)), 1, atol=1e-5)
    assert set(person.parts) == {
        "skin", "left_eye", "right_eye", "upper_teeth", "lower_teeth", "tongue"
    }  # fmt: skip


def test_joint_transforms_are_the_head_models(person):
    """Rigid parts ride on these: a vertex that one joint owns must land where the model puts it."""
    from pav_blender.studio.person import joint_transforms

    head = person.head
    pose = np.random.default_rng(2).normal(0, 0.3, (len(head.joint_names), 3)).astype(np.float32)
    posed = person.posed(np.zeros(len(head.expression_names)), pose, np.zeros(3))
    transforms = joint_transforms(pose, person.joints, head.joint_parents)
    for joint in range(len(head.joint_names)):
        owned = head.skinning_weights[:, joint] > 0.9999
        assert owned.any(), head.joint_names[joint]
        moved = person.rest[owned] @ transforms[joint, :3, :3].T + transforms[joint, :3, 3]
        np.testing.assert_allclose(moved, posed[owned], atol=2e-6)


def test_performances_move_and_repeat(person):
    first = motion.perform(person.head, 60, np.random.default_rng(7))
    again = motion.perform(person.head, 60, np.random.default_rng(7))
    np.testing.assert_array_equal(first.expression, again.expression)
    np.testing.assert_array_equal(first.pose, again.pose)
    yaw = np.degrees(first.pose[:, 1, 1])
    assert yaw.max() > 18
    assert yaw.min() < -18
    assert np.abs(yaw).max() <= 35.01
    names = list(person.head.expression_names)
    for name, least in (("jawOpen", 0.4), ("eyeBlinkLeft", 0.9), ("mouthSmileLeft", 0.3)):
        assert first.expression[:, names.index(name)].max() > least, name
    assert first.expression.min() >= 0
    assert first.expression.max() <= 1


def test_truth_lines_up_with_the_pictures(small):
    clip = small.clips[0]
    assert list(clip.split) == ["train", "train", "test", "view"]
    assert clip.vertices is not None
    head = small.head
    posed = head.pose(small.betas, clip.expression, clip.pose, clip.translation).numpy()
    np.testing.assert_allclose(clip.vertices, posed, atol=1e-7)  # batches round apart
    for row in range(len(clip)):
        rgba = read_rgba(small.image_path(clip, row))
        labels = read_gray(small.labels_path(clip, row))
        coded = read_gray(small.path / "clips" / clip.name / "depth" / f"{row:06d}.png")
        matte = rgba[..., 3]
        assert not rgba[matte == 0].any()
        assert ((labels > 0) == (matte >= 128)).mean() > 0.99
        assert 0.3 < (matte > 127).mean() < 0.85
        camera = Camera(clip.width, clip.height, clip.intrinsics[row], clip.camera_to_world[row])
        depth, _, _ = rasterise(posed[row], head.triangles, camera)
        face = (labels == LABELS.index("face")) & np.isfinite(depth)
        assert face.sum() > 200
        error = np.abs(coded[face] * 1e-4 - depth[face])
        assert np.median(error) < 1e-3  # the refined surface lies within a millimetre
        for name in ("lips", "eyes", "scalp_hair", "facial_hair", "cloth", "accessory"):
            assert (labels == LABELS.index(name)).any(), name


def test_hair_edges_keep_the_foregrounds_colour(small):
    """Straight colours: thin dark hair over nothing must not turn white or black at random."""
    clip = small.clips[0]
    rgba = read_rgba(small.image_path(clip, 0)).astype(float)
    labels = read_gray(small.labels_path(clip, 0))
    hair = labels == LABELS.index("scalp_hair")
    rows, columns = np.nonzero(hair)
    top = rows < rows.min() + 0.12 * clip.height
    near = np.zeros_like(hair)
    near[rows[top].min() - 2 : rows[top].max(), columns.min() : columns.max()] = True
    edge = near & (rgba[..., 3] > 8) & (rgba[..., 3] < 200)
    solid = hair & near & (rgba[..., 3] > 250)
    assert edge.sum() > 10
    difference = rgba[edge][:, :3].mean(0) - rgba[solid][:, :3].mean(0)
    assert np.abs(difference).max() < 40


def test_more_samples_are_nearer_to_the_converged_picture(tmp_path, monkeypatch, capsys):
    from pav_blender.benchmarks import studio
    from pav_blender.benchmarks.measure import Options

    monkeypatch.setattr(studio, "_LOOKS", 1)
    monkeypatch.setattr(studio, "_SIZE", 64)
    monkeypatch.setattr(studio, "_SAMPLES", (2, 32))
    monkeypatch.setattr(studio, "_CONVERGED", 96)
    fields, claims = studio.run(Options(tmp_path), None)
    few, many = fields["rows"]
    assert few["head_psnr"] + 3 < many["head_psnr"] < 70
    assert claims[0].value == pytest.approx(few["head_psnr"], abs=1e-3)
    assert "head_psnr" in capsys.readouterr().out
    assert (tmp_path / "studio.svg").is_file()


def test_nothing_stays_in_blender(small):
    assert not [item.name for item in bpy.data.objects if item.name.startswith("studio")]
    assert not [item.name for item in bpy.data.materials if item.name.startswith("studio")]
    assert not [item.name for item in bpy.data.scenes if item.name.startswith("pav studio")]


def test_wrong_requests_are_refused(tmp_path):
    for options in (
        {"appearances": 6},
        {"frames": 0},
        {"size": 8},
        {"truth": "half"},
        {"samples": 0},
    ):
        with pytest.raises(InputError):
            render_collection(tmp_path / "refused", **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_committed_collection_renders_again():
    """Two frames of the default collection: the parameters but for the last bit, which differs
    between versions of numpy; the pictures closely."""
    collection = read_collection(DEFAULT)
    extra = collection.extra
    assert extra["head_fingerprint"] == collection.head.fingerprint
    person = build_person(collection.head, identity(collection.head, extra["seed"]))
    np.testing.assert_array_equal(np.round(person.betas, 6), np.round(collection.betas, 6))
    for number, row in ((0, 5), (2, 20)):
        clip, look = collection.clips[number], APPEARANCES[number]
        shots = render.plan(person, look, extra["frames"], clip.width, (extra["seed"], 0))
        for key in ("expression", "pose", "translation", "intrinsics", "camera_to_world"):
            planned = np.stack([getattr(shot, key) for shot in shots]).astype(np.float32)
            np.testing.assert_allclose(planned, getattr(clip, key), rtol=1e-6, atol=1e-8)
        with render.filming(person, look, clip.width, extra["seed"]) as take:
            picture = take(shots[row], None)
        stored = read_rgba(collection.image_path(clip, row)).astype(float)
        mine = picture.rgba.astype(float)
        over = [c[..., :3] * c[..., 3:] / 255 for c in (stored, mine)]
        error = np.mean((over[0] - over[1]) ** 2)
        assert 10 * np.log10(255**2 / max(error, 1e-9)) > 35
        assert np.abs(stored[..., 3] - mine[..., 3]).mean() < 1.0
        assert (picture.labels == read_gray(collection.labels_path(clip, row))).mean() > 0.99


def test_a_short_performance_begins_a_longer_one(person):
    short = motion.perform(person.head, 12, np.random.default_rng(3))
    longer = motion.perform(person.head, 54, np.random.default_rng(3))
    np.testing.assert_array_equal(short.expression, longer.expression[:12])
    np.testing.assert_array_equal(short.pose, longer.pose[:12])
    assert np.abs(np.diff(longer.pose[:, 1], axis=0)).max() < np.radians(20)  # no jumps
