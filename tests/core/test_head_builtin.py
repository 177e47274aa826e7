"""The built-in head: human measures, rig, expressions, atlas, landmarks."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pav_blender.core.head import builtin_head
from pav_blender.core.head.builtin import BUILTIN_PATH

ARKIT_MIDDLE = {
    "browInnerUp", "cheekPuff", "jawForward", "jawLeft", "jawOpen", "jawRight", "mouthClose",
    "mouthFunnel", "mouthLeft", "mouthPucker", "mouthRight", "mouthRollLower", "mouthRollUpper",
    "mouthShrugLower", "mouthShrugUpper", "tongueOut",
}  # fmt: skip
ARKIT_SIDED = {
    "browDown", "browOuterUp", "cheekSquint", "eyeBlink", "eyeLookDown", "eyeLookIn", "eyeLookOut",
    "eyeLookUp", "eyeSquint", "eyeWide", "mouthDimple", "mouthFrown", "mouthLowerDown",
    "mouthPress", "mouthSmile", "mouthStretch", "mouthUpperUp", "noseSneer",
}  # fmt: skip
ARKIT = ARKIT_MIDDLE | {name + side for name in ARKIT_SIDED for side in ("Left", "Right")}
UPPER_LID, LOWER_LID = {"Right": 159, "Left": 386}, {"Right": 145, "Left": 374}
UPPER_LIP, LOWER_LIP = 13, 14
NOSE_TIP, CHIN = 1, 152
MIRRORED_LANDMARKS = ((33, 263), (61, 291), (234, 454), (105, 334), (50, 280), (172, 397))


@pytest.fixture(scope="module")
def head():
    return builtin_head()


def posed(head, expression=None, betas=(), **turns) -> np.ndarray:
    """Vertices [V,3]; turns: joint name -> axis-angle in degrees."""
    values = np.zeros((1, len(head.expression_names)), np.float32)
    for name, value in (expression or {}).items():
        values[0, head.expression_names.index(name)] = value
    pose = np.zeros((1, len(head.joint_names), 3), np.float32)
    for joint, turn in turns.items():
        pose[0, head.joint_names.index(joint)] = np.radians(turn)
    return head.pose(np.array(betas), values, pose, np.zeros((1, 3)))[0].numpy()


def people(head, count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 1, (count, len(head.shape_basis)))


def rigid(before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, float]:
    """Best rotation [3,3] between two point sets and the largest residual, metres."""
    a, b = before - before.mean(0), after - after.mean(0)
    u, _, vt = np.linalg.svd(a.T.astype(float) @ b)
    rotation = (u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt).T
    return rotation, float(np.abs(a @ rotation.T - b).max())


def test_file_is_small_and_says_where_it_comes_from(head):
    assert BUILTIN_PATH.stat().st_size <= 5e6
    assert "CC0" in head.origin
    assert "CC0" in (BUILTIN_PATH.parent / "ORIGIN.md").read_text()


def test_size_of_the_model(head):
    assert 5000 <= head.vertex_count <= 6500
    assert len(head.shape_basis) >= 50
    assert head.joint_names == ("root", "neck", "jaw", "left_eye", "right_eye")
    assert np.array_equal(np.unique(head.triangles), np.arange(head.vertex_count))
    assert np.array_equal(np.unique(head.uv_triangles), np.arange(len(head.uvs)))


def measures(vertices, head) -> dict[str, float]:
    """Metres, ears left out of width."""
    skull = vertices[head.regions["face"] | head.regions["scalp"]]
    chin = head.landmarks(vertices)[CHIN]
    return {
        "width": np.ptp(skull[:, 0]),
        "height": skull[:, 1].max() - chin[1],
        "depth": np.ptp(skull[:, 2]),
    }


@pytest.mark.parametrize(
    ("name", "low", "high"), [("width", 0.13, 0.18), ("height", 0.19, 0.25), ("depth", 0.17, 0.23)]
)
def test_average_head_has_human_measures(head, name, low, high):
    assert low < measures(head.template, head)[name] < high


def test_identities_stay_human_two_deviations_out(head):
    for component in np.eye(len(head.shape_basis)):
        for betas in (2 * component, -2 * component):
            found = measures(head.shaped(betas), head)
            assert 0.115 < found["width"] < 0.19
            assert 0.17 < found["height"] < 0.28
            assert 0.15 < found["depth"] < 0.26


def test_components_carry_less_and_less(head):
    skin = head.regions["face"]
    size = np.sqrt((head.shape_basis[:, skin] ** 2).sum((1, 2)) / skin.sum())
    assert size[:4].min() > 1.5 * size[20:].max()
    assert size.min() > 1e-5


def test_eyes_are_the_origin_and_joints_lie_where_they_should(head):
    joints = dict(zip(head.joint_names, head.joints([]), strict=True))
    middle = 0.5 * (joints["left_eye"] + joints["right_eye"])
    np.testing.assert_allclose(middle, 0, atol=2e-4)
    assert 0.05 < joints["left_eye"][0] - joints["right_eye"][0] < 0.075
    for name in ("root", "neck", "jaw"):
        assert abs(joints[name][0]) < 2e-4
    assert joints["root"][1] < joints["neck"][1] < joints["jaw"][1] < 0
    assert joints["neck"][2] < joints["jaw"][2] < 0


def test_joints_follow_identity(head):
    for betas in people(head, 5):
        shaped, joints = head.shaped(betas), head.joints(betas)
        for side, joint in ((1, 3), (-1, 4)):
            ball = shaped[head.regions["eyeballs"] & (head.template[:, 0] * side > 0)]
            distance = np.linalg.norm(ball - joints[joint], axis=1)
            assert np.ptp(distance) < 2e-4  # a sphere round its joint
        neck = shaped[head.regions["neck"]]
        assert neck[:, 2].min() < joints[1, 2] < neck[:, 2].max()


def test_weights_are_a_partition_and_solid_parts_are_rigid(head):
    weights = head.skinning_weights
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-5)
    assert weights.min() >= 0
    assert np.isin(weights[head.regions["eyeballs"]], (0, 1)).all()
    assert np.isin(weights[head.regions["teeth"]], (0, 1)).all()
    crown = head.regions["scalp"] & (head.template[:, 1] > -0.02)
    assert weights[crown, 1].min() > 0.9
    assert weights[head.regions["torso"], 0].min() > 0.9


def test_regions_cover_the_head_without_contradiction(head):
    regions = head.regions
    assert np.any(list(regions.values()), axis=0).all()
    skin = ("face", "scalp", "ears", "neck", "torso", "eyeballs", "teeth", "mouth_interior")
    assert np.sum([regions[name] for name in skin], axis=0).max() == 1
    for name in ("left_eye_region", "right_eye_region"):
        assert not (regions[name] & ~regions["face"]).any()
    assert head.template[regions["left_eye_region"], 0].min() > 0
    assert head.template[regions["right_eye_region"], 0].max() < 0


def test_mesh_is_manifold_and_faces_outward(head):
    edges = np.sort(head.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert np.unique(edges, axis=0, return_counts=True)[1].max() == 2
    a, b, c = np.moveaxis(head.template[head.triangles].astype(float), 1, 0)
    normals = np.cross(b - a, c - a)
    assert np.linalg.norm(normals, axis=1).min() > 1e-10
    centre = (a + b + c) / 3
    face = head.regions["face"][head.triangles].all(1) & (np.abs(centre[:, 0]) < 0.03)
    assert normals[face, 2].mean() > 0
    scalp = head.regions["scalp"][head.triangles].all(1)
    assert ((normals * (centre - (0, 0.02, -0.08))).sum(1)[scalp] > 0).all()


def covered(uvs: np.ndarray, size: int) -> np.ndarray:
    """How many triangles [size,size] hold each texel centre."""
    count = np.zeros((size, size), int)
    for corners in uvs.astype(float) * size:
        low = np.floor(corners.min(0)).astype(int)
        high = np.ceil(corners.max(0)).astype(int)
        x, y = np.meshgrid(*(np.arange(a, b) + 0.5 for a, b in zip(low, high, strict=True)))
        (ax, ay), (bx, by), (cx, cy) = corners
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        u = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
        v = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
        inside = (u > 1e-7) & (v > 1e-7) & (u + v < 1 - 1e-7)
        count[low[1] : high[1], low[0] : high[0]] += inside
    return count


def test_atlas_has_no_overlap_and_is_mostly_face(head):
    assert head.uvs.min() >= 0
    assert head.uvs.max() <= 1
    corners = head.uvs[head.uv_triangles]
    count = covered(corners, 512)
    assert count.max() == 1
    assert (count > 0).mean() > 0.6
    edges = (corners[:, 1:] - corners[:, :1]).astype(float)
    area = 0.5 * (edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    assert area.min() > 0  # nothing mirrored or flat
    share = {name: area[mask[head.triangles].all(1)].sum() for name, mask in head.regions.items()}
    assert max(share, key=share.__getitem__) == "face"
    seen = head.template[:, 0] > 0.02
    assert (
        head.uvs[head.uv_triangles[(seen & head.regions["face"])[head.triangles].all(1)]][
            ..., 0
        ].min()
        > 0.5
    )  # as in a picture: the person's left is on the right


def test_overlap_check_sees_an_overlap():
    one = np.array([[[0.1, 0.1], [0.9, 0.1], [0.5, 0.8]]])
    assert covered(np.concatenate([one, one + 0.05]), 64).max() == 2


def test_expression_names_are_arkits_and_sides_mirror(head):
    assert len(ARKIT) == 52
    assert set(head.expression_names) == ARKIT
    mirror = cKDTree(head.template).query(head.template * (-1, 1, 1))[1]
    for name, offsets in zip(head.expression_names, head.expression_basis, strict=True):
        if not name.endswith("Left"):
            continue
        other = head.expression_basis[
            head.expression_names.index(name.removesuffix("Left") + "Right")
        ]
        inward = -1 if name in ("mouthLeft", "jawLeft") else 1
        assert np.abs(other - offsets[mirror] * (-1, 1, 1)).max() < 1.5e-3, name
        moved = np.abs(offsets).sum(1)
        if inward == 1:
            assert moved[head.template[:, 0] > 0.005].sum() > 2 * (
                moved[head.template[:, 0] < -0.005].sum()
            ), name


@pytest.mark.parametrize("side", ["Left", "Right"])
def test_blink_closes_the_lids_of_its_side(head, side):
    other = "Right" if side == "Left" else "Left"

    def gap(vertices, which):
        points = head.landmarks(vertices)
        return points[UPPER_LID[which], 1] - points[LOWER_LID[which], 1]

    for betas in (np.zeros(1), *people(head, 4, seed=2)):
        still = posed(head, betas=betas)
        shut = posed(head, {"eyeBlink" + side: 1}, betas)
        assert gap(still, side) > 0.004
        assert gap(shut, side) < 0.2 * gap(still, side)
        assert gap(shut, other) == pytest.approx(gap(still, other), rel=0.02)


def test_closed_lids_hide_the_eyeballs(head):
    still = posed(head)
    shut = posed(head, {"eyeBlinkLeft": 1, "eyeBlinkRight": 1})
    assert visible_eyeballs(still, head) > 20
    assert visible_eyeballs(shut, head) == 0


def visible_eyeballs(vertices, head) -> int:
    """Eyeball vertices in front of all skin, seen from straight ahead."""
    skin = head.triangles[head.regions["left_eye_region"][head.triangles].any(1)]
    a, b, c = np.moveaxis(vertices[skin].astype(float), 1, 0)
    ball = vertices[head.regions["eyeballs"] & (vertices[:, 0] > 0) & (vertices[:, 2] > 0.008)]
    seen = 0
    for point in ball:
        area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
        u = (b - point)[:, 0] * (c - point)[:, 1] - (b - point)[:, 1] * (c - point)[:, 0]
        v = (c - point)[:, 0] * (a - point)[:, 1] - (c - point)[:, 1] * (a - point)[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = u / area, v / area
        depth = u * a[:, 2] + v * b[:, 2] + (1 - u - v) * c[:, 2]
        covers = (u >= 0) & (v >= 0) & (u + v <= 1) & (depth > point[2])
        seen += not covers.any()
    return seen


def test_jaw_joint_opens_the_mouth(head):
    still, opened = posed(head), posed(head, jaw=(15, 0, 0))
    before, after = head.landmarks(still), head.landmarks(opened)
    assert after[LOWER_LIP, 1] < before[LOWER_LIP, 1] - 0.01
    assert after[CHIN, 1] < before[CHIN, 1] - 0.015
    assert abs(after[UPPER_LIP, 1] - before[UPPER_LIP, 1]) < 0.003
    np.testing.assert_allclose(after[NOSE_TIP], before[NOSE_TIP], atol=1e-3)
    lower = head.regions["teeth"] & (head.skinning_weights[:, 2] == 1)
    rotation, residual = rigid(still[lower], opened[lower])
    assert residual < 1e-5
    assert np.degrees(np.arctan2(rotation[2, 1], rotation[1, 1])) == pytest.approx(15, abs=0.05)


def test_jaw_open_expression_agrees_with_the_jaw_joint(head):
    shape = posed(head, {"jawOpen": 1})
    lower = head.regions["teeth"] & (head.skinning_weights[:, 2] == 1)
    rotation, _ = rigid(head.template[lower], shape[lower])
    degrees = np.degrees(np.arctan2(rotation[2, 1], rotation[1, 1]))
    joint = posed(head, jaw=(degrees, 0, 0))
    assert 15 < degrees < 25
    assert np.linalg.norm((shape - joint)[lower], axis=1).max() < 0.002


def test_canonical_is_neutral_with_the_jaw_open_by_12_degrees(head):
    betas = people(head, 1)[0]
    canonical = head.canonical(betas)
    np.testing.assert_allclose(canonical, posed(head, betas=betas, jaw=(12, 0, 0)), atol=1e-6)
    lips = head.landmarks(canonical)
    closed = head.landmarks(head.shaped(betas))
    gap = lips[UPPER_LIP, 1] - lips[LOWER_LIP, 1]
    assert gap > 0.008 + closed[UPPER_LIP, 1] - closed[LOWER_LIP, 1]


def test_neck_turns_the_face_to_the_persons_left_and_does_not_collapse(head):
    still, turned = posed(head), posed(head, neck=(0, 35, 0))
    assert head.landmarks(turned)[NOSE_TIP, 0] > 0.04
    np.testing.assert_allclose(turned[head.skinning_weights[:, 0] == 1], still[
        head.skinning_weights[:, 0] == 1
    ], atol=1e-6)  # fmt: skip
    around = (head.regions["neck"] | head.regions["face"])[head.triangles].all(1)
    edges = head.triangles[around][:, [0, 1]]
    before, after = (np.linalg.norm(np.diff(v[edges], axis=1)[:, 0], axis=1)
                     for v in (still, turned))  # fmt: skip
    stretch = after / before
    assert stretch.min() > 0.5
    assert stretch.max() < 1.7
    assert (head.landmarks(posed(head, neck=(20, 0, 0)))[NOSE_TIP, 1]
            < head.landmarks(still)[NOSE_TIP, 1] - 0.02)  # fmt: skip


def test_eye_joints_and_look_shapes_turn_the_eye_the_same_way(head):
    left = head.regions["eyeballs"] & (head.template[:, 0] > 0)

    def gaze(vertices):
        rotation, residual = rigid(head.template[left], vertices[left])
        assert residual < 1.5e-3
        return rotation[:, 2]

    assert gaze(posed(head, left_eye=(0, 15, 0)))[0] > 0.2
    assert gaze(posed(head, {"eyeLookOutLeft": 1}))[0] > 0.2
    assert gaze(posed(head, {"eyeLookInLeft": 1}))[0] < -0.2
    assert gaze(posed(head, left_eye=(10, 0, 0)))[1] < -0.1
    assert gaze(posed(head, {"eyeLookDownLeft": 1}))[1] < -0.1
    assert gaze(posed(head, {"eyeLookUpLeft": 1}))[1] > 0.1


def test_landmarks_lie_on_the_parts_they_name(head):
    assert head.landmark_triangles.shape == (478,)
    np.testing.assert_allclose(head.landmark_barycentrics.sum(1), 1, atol=1e-5)
    assert head.landmark_barycentrics.min() > -1e-4
    points = head.landmarks(head.template)
    corners = head.triangles[head.landmark_triangles]
    assert head.regions["eyeballs"][corners[468:]].all()
    assert not head.regions["eyeballs"][corners[:468]].any()
    lips = [0, 17, 13, 14, 37, 267, 84, 314]
    assert head.regions["lips"][corners[lips]].any(1).all()
    lip_tree = cKDTree(head.template[head.regions["lips"]])
    assert lip_tree.query(points[[61, 291]])[0].max() < 0.005  # the corners of the mouth
    assert np.argmax(points[:468, 2]) in (1, 4, 5, 44, 45, 274, 275, 19)
    joints = head.joints([])
    np.testing.assert_allclose(points[468, :2], joints[4, :2], atol=5e-4)
    np.testing.assert_allclose(points[473, :2], joints[3, :2], atol=5e-4)
    for right, left in MIRRORED_LANDMARKS:
        assert points[right, 0] < 0 < points[left, 0]
        np.testing.assert_allclose(points[right] * (-1, 1, 1), points[left], atol=1.5e-3)
    order = points[[10, 151, 168, 1, 13, 14, 17, 152], 1]
    assert (np.diff(order) < 1e-4).all()  # forehead to chin
    assert (points[[159, 386], 1] > points[[145, 374], 1]).all()
