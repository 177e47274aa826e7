"""Heads out of any mesh with shape keys."""

import numpy as np
import pytest

from pav_blender.core.errors import InputError
from pav_blender.core.head import head_from_shape_keys, oracle

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
SIDES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
     [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)  # fmt: skip
TALL = CUBE * (1, 2, 1)


def test_keys_become_expressions_and_a_missing_atlas_is_made():
    head = head_from_shape_keys(CUBE, SIDES, {"tall": TALL})
    assert head.expression_names == ("tall",)
    posed = head.pose([], np.array([[0.5]]), np.zeros((1, 1, 3)), np.zeros((1, 3)))
    np.testing.assert_allclose(posed[0], 0.5 * (CUBE + TALL), atol=1e-6)
    assert head.uvs.min() >= 0
    assert head.uvs.max() <= 1
    corners = head.uvs[head.uv_triangles].astype(float)
    edges = corners[:, 1:] - corners[:, :1]
    area = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]) / 2
    assert (area > 1e-3).all()
    assert area.sum() <= 1


def test_given_joints_uvs_and_weights_are_used():
    places = np.array([[0.5, 0.0, 0.5], [0.5, 0.75, 0.1]])
    weights = np.stack([1 - CUBE[:, 1], CUBE[:, 1]], 1) * 7
    head = head_from_shape_keys(
        CUBE, SIDES, {}, uvs=CUBE[:, :2], joint_names=("root", "neck"), joint_parents=(-1, 0),
        joint_positions=places, skinning_weights=weights,
    )  # fmt: skip
    np.testing.assert_allclose(head.joints([]), places, atol=1e-6)
    pose = np.zeros((2, 3))
    pose[1] = (0, 0, np.pi / 2)
    posed = oracle.pose(head, [], [], pose, np.zeros(3))
    low = CUBE[:, 1] == 0
    np.testing.assert_allclose(posed[low], CUBE[low], atol=1e-6)
    around = CUBE[~low] - places[1]
    wanted = places[1] + around @ oracle.rotation_matrix(pose[1]).T
    np.testing.assert_allclose(posed[~low], wanted, atol=1e-6)
    assert head.canonical([]).shape == CUBE.shape  # no jaw: neutral


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ({"keys": {"tall": TALL[:4]}}, "tall"),
        ({"vertices": CUBE[:, :2]}, "vertices"),
        ({"joint_names": ("root", "neck"), "joint_parents": (-1, 0)}, "joint_positions"),
        ({"skinning_weights": np.zeros((8, 1))}, "vertex 0"),
        ({"skinning_weights": np.ones((7, 1))}, "skinning weights"),
        ({"vertices": CUBE * (1, 1, 0), "joint_positions": np.ones((1, 3))}, "flat"),
        ({"triangles": SIDES + 1}, "indices"),
    ],
)
def test_wrong_input_is_named(arguments, word):
    given = {"vertices": CUBE, "triangles": SIDES, "keys": {}, "uvs": CUBE[:, :2], **arguments}
    with pytest.raises(InputError, match=word):
        head_from_shape_keys(
            given.pop("vertices"), given.pop("triangles"), given.pop("keys"), **given
        )
