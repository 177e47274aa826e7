"""What holds of any mesh, camera or pose: distances, canonical points, projections, skinning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from fuzzing import MORE
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation
from test_head_pose import SMALL
from test_marching import CANONICAL, TRIANGLES

from pav_blender.core.deformation import Deformer
from pav_blender.core.deformation.rigid import head_rotation, stance
from pav_blender.core.head import HeadModel
from pav_blender.core.kernels import select
from pav_blender.core.rendering.cameras import Camera

KERNELS = {"cpu": select("cpu").nearest, "reference": select("cpu", reference=True).nearest}
KIND = st.sampled_from(sorted(KERNELS))
MODE = st.sampled_from(["rigid", "affine", "smooth"])
FEW = settings(max_examples=25 * MORE, deadline=None, derandomize=True)

seeds = st.integers(0, 2**32 - 1)


def filled(shape, most, width=64):
    """Arrays of numbers from -most to most, every one drawn for itself."""
    kind = np.float32 if width == 32 else np.float64
    return arrays(kind, shape, elements=st.floats(-most, most, width=width), fill=st.nothing())


vectors = filled(3, 1)
# the long way round as well, and no turn at all
turns = filled(3, 4).map(Rotation.from_rotvec)


@st.composite
def meshes(draw):
    """Up to 12 vertices [V, 3] within half a metre and up to 16 triangles [T, 3], connected anyhow;
    some of them may be degenerate, or all."""
    random = np.random.default_rng(draw(seeds))
    count = draw(st.integers(3, 12))
    vertices = random.uniform(-0.25, 0.25, (count, 3)).astype(np.float32)
    triangles = np.stack([random.permutation(count)[:3] for _ in range(draw(st.integers(1, 16)))])
    bad = random.random(len(triangles)) < draw(st.sampled_from([0, 0, 0.4, 1]))
    triangles[bad, 1] = triangles[bad, 0]
    return vertices, triangles.astype(np.int32)


points_near = filled((6, 3), 0.5, 32)


def flatness(vertices, triangles):
    """Twice the area over the longest edge squared, [T]; 0 for a point."""
    a, b, c = vertices.astype(np.float64)[triangles].transpose(1, 0, 2)
    longest = np.max([np.square(x - y).sum(1) for x, y in ((a, b), (b, c), (c, a))], axis=0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return area / np.where(longest > 0, longest, 1.0)


def usable(vertices, triangles):
    """Which triangles may be chosen [T]; an example with one near the limit is passed over."""
    flat = flatness(vertices, triangles)
    assume(not ((flat > 1e-6) & (flat < 1e-4)).any())
    return flat > 1e-5


def search(kernels, vertices, triangles, points):
    vertices, triangles = torch.from_numpy(vertices), torch.from_numpy(triangles)
    posed = kernels.refit(kernels.Topology(triangles, vertices), vertices)
    found = kernels.nearest(posed, torch.from_numpy(points))
    return tuple(values.numpy() for values in found)


@FEW
@given(meshes(), points_near, KIND)
def test_the_nearest_point_is_one_of_the_mesh_and_none_is_nearer(mesh, points, kind):
    """By trimesh, in double precision and another formula (Ericson's)."""
    from trimesh.triangles import closest_point

    vertices, triangles = mesh
    good = usable(vertices, triangles)
    triangle, barycentric, distance = search(KERNELS[kind], vertices, triangles, points)
    if not good.any():
        assert (triangle == -1).all()
        return
    assert good[triangle].all()
    corners = vertices.astype(np.float64)[triangles]
    for row, point in enumerate(points.astype(np.float64)):
        feet = closest_point(corners[good], np.tile(point, (good.sum(), 1)))
        least = np.linalg.norm(feet - point, axis=1).min()
        assert distance[row] == pytest.approx(least, rel=3e-6, abs=3e-7)
        at_corners = np.linalg.norm(corners[good] - point, axis=-1)
        assert distance[row] <= at_corners.min() * (1 + 3e-6) + 3e-7
        assert ((barycentric[row] >= 0) & (barycentric[row] <= 1)).all()
        assert barycentric[row].sum() == pytest.approx(1, abs=1e-6)
        foot = barycentric[row] @ corners[triangle[row]]
        assert np.linalg.norm(foot - point) == pytest.approx(least, rel=1e-5, abs=1e-6)


@FEW
@given(meshes(), points_near, turns, vectors, KIND)
def test_distances_move_with_mesh_and_points(mesh, points, turn, shift, kind):
    vertices, triangles = mesh
    usable(vertices, triangles)
    moved = [(turn.apply(x) + shift).astype(np.float32) for x in (vertices, points)]
    usable(moved[0], triangles)
    before = search(KERNELS[kind], vertices, triangles, points)
    after = search(KERNELS[kind], moved[0], triangles, moved[1])
    np.testing.assert_array_equal(after[0] < 0, before[0] < 0)
    # coordinates up to 2 m are rounded to 1.2e-7
    np.testing.assert_allclose(after[2], before[2], rtol=2e-6, atol=6e-7)


@FEW
@given(meshes(), points_near, KIND, seeds)
def test_the_order_of_triangles_changes_no_distance(mesh, points, kind, seed):
    vertices, triangles = mesh
    order = np.random.default_rng(seed).permutation(len(triangles))
    before = search(KERNELS[kind], vertices, triangles, points)[2]
    after = search(KERNELS[kind], vertices, triangles[order], points)[2]
    np.testing.assert_allclose(after, before, rtol=2e-6, atol=2e-7)


@st.composite
def deformed(draw):
    """The ball of 10 cm, stretched and rippled: [V, 3] float32."""
    stretch = 1.05 + 0.35 * draw(vectors)
    ripple = draw(st.floats(0, 0.006))
    posed = CANONICAL * stretch + ripple * np.sin(30 * CANONICAL[:, [1, 2, 0]])
    return posed.astype(np.float32)


def around(seed, count=200):
    """Points [N, 3] in the ball, on it and up to some 15 cm off."""
    points = np.random.default_rng(seed).normal(size=(count, 3)) * 0.09
    return torch.from_numpy(points.astype(np.float32))


@FEW
@given(deformed(), turns, vectors, seeds, KIND)
def test_on_a_whole_ball_none_is_nearer_wherever_it_is(posed, turn, shift, seed, kind):
    """Enough triangles that most of them are never looked at."""
    from trimesh.triangles import closest_point

    vertices = (turn.apply(posed) + shift).astype(np.float32)
    points = (turn.apply(around(seed, 20).numpy()) + shift).astype(np.float32)
    _, _, distance = search(KERNELS[kind], vertices, TRIANGLES, points)
    corners = np.tile(vertices.astype(np.float64)[TRIANGLES], (len(points), 1, 1))
    each = points.astype(np.float64).repeat(len(TRIANGLES), 0)
    feet = np.linalg.norm(closest_point(corners, each) - each, axis=1).reshape(len(points), -1)
    np.testing.assert_allclose(distance, feet.min(1), rtol=3e-6, atol=4e-7)


def carried(canonical, posed, points, mode):
    """The points' triangles [N], and where they lie in canonical space [N, 3]."""
    deformer = Deformer(canonical, TRIANGLES, mode)
    mesh = deformer.pose(posed)
    triangle, barycentric, _ = deformer.nearest(mesh, points)
    ops = deformer.kernels.marching
    return triangle, ops.canonicalise(points, triangle, barycentric, mesh)


@FEW
@given(deformed(), seeds, MODE)
def test_a_mesh_at_rest_moves_nothing(rest, seed, mode):
    points = around(seed)
    _, canonical = carried(rest, rest, points, mode)
    torch.testing.assert_close(canonical, points, rtol=0, atol=1e-6)


@FEW
@given(deformed(), seeds, turns, vectors, MODE)
def test_where_the_whole_mesh_goes_its_canonical_points_do_not(posed, seed, turn, shift, mode):
    """A deformed mesh and its points, moved rigidly, are what they were in canonical space."""
    points = around(seed)
    moved = (turn.apply(posed) + shift).astype(np.float32)
    along = torch.from_numpy((turn.apply(points.numpy()) + shift).astype(np.float32))
    before, canonical = carried(CANONICAL, posed, points, mode)
    after, again = carried(CANONICAL, moved, along, mode)
    same = before == after
    assert same.float().mean() > 0.9  # but for ties between neighbours
    torch.testing.assert_close(again[same], canonical[same], rtol=0, atol=2e-5)


@FEW
@given(deformed(), seeds, turns, vectors, MODE)
def test_a_moved_rest_pose_is_undone(rest, seed, turn, shift, mode):
    points = around(seed)
    moved = (turn.apply(rest) + shift).astype(np.float32)
    along = torch.from_numpy((turn.apply(points.numpy()) + shift).astype(np.float32))
    _, canonical = carried(rest, moved, along, mode)
    torch.testing.assert_close(canonical, points, rtol=0, atol=2e-5)


@FEW
@given(deformed(), seeds, st.sampled_from(["affine", "smooth"]))
def test_to_canonical_space_and_back(posed, seed, mode):
    """Points of the surface return where they came from when the two meshes change roles."""
    random = np.random.default_rng(seed)
    chosen = random.integers(0, len(TRIANGLES), 100)
    weights = random.dirichlet([2, 2, 2], 100)
    points = np.einsum("ni,nij->nj", weights, posed[TRIANGLES[chosen]]).astype(np.float32)
    _, canonical = carried(CANONICAL, posed, torch.from_numpy(points), mode)
    _, back = carried(posed, CANONICAL, canonical, mode)
    np.testing.assert_allclose(back.numpy(), points, atol=2e-6)


@st.composite
def cameras(draw):
    """Any view from within some metres: skewed, off the middle, parallel or not."""
    turn, shift = draw(turns), draw(vectors)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.as_matrix(), 3 * shift
    fx, fy = draw(st.floats(20, 3000)), draw(st.floats(20, 3000))
    skew, cx, cy = (draw(st.floats(-30, 30)) for _ in range(3))
    width, height = draw(st.integers(1, 4000)), draw(st.integers(1, 4000))
    intrinsics = np.array([[fx, skew, width / 2 + cx], [0, fy, height / 2 + cy], [0, 0, 1]])
    return Camera(width, height, intrinsics, pose, parallel=draw(st.booleans()))


in_front = filled((5, 3), 1).map(lambda local: local + np.array([0, 0, 1.2]))


def in_world(view, local):
    return local @ view.camera_to_world[:3, :3].T + view.origin


@FEW
@given(cameras(), in_front)
def test_the_ray_through_a_projected_point_meets_it(view, local):
    points = in_world(view, local)
    pixels, depth = view.project(points)
    np.testing.assert_allclose(depth, local[:, 2], atol=1e-9)
    origins, directions, cosine = view.rays(pixels[:, 0] - 0.5, pixels[:, 1] - 0.5)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-6)
    met = origins + directions * (depth / cosine)[:, None]
    np.testing.assert_allclose(met, points, atol=4e-6)


@FEW
@given(cameras(), in_front, turns, vectors)
def test_a_camera_that_goes_with_the_world_sees_the_same(view, local, turn, shift):
    points = in_world(view, local)
    pixels, depth = view.project(points)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn.as_matrix(), shift
    along = replace(view, camera_to_world=motion @ view.camera_to_world)
    found, deep = along.project(turn.apply(points) + shift)
    np.testing.assert_allclose(found, pixels, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(deep, depth, atol=1e-9)
    found, deep = view.moved(shift).project(points + shift)
    np.testing.assert_allclose(found, pixels, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(deep, depth, atol=1e-9)


@FEW
@given(cameras(), in_front, st.integers(1, 4000), st.integers(1, 4000), st.data())
def test_sizes_and_windows_can_be_taken_back(view, local, width, height, data):
    points = in_world(view, local)
    pixels, _ = view.project(points)
    other = view.resized(width, height)
    assert (other.width, other.height) == (width, height)
    scale = np.array([width / view.width, height / view.height])
    np.testing.assert_allclose(other.project(points)[0], pixels * scale, rtol=1e-9, atol=1e-6)
    again = other.resized(view.width, view.height)
    np.testing.assert_allclose(again.intrinsics, view.intrinsics, rtol=1e-12, atol=1e-12)
    x, y = data.draw(st.integers(0, view.width - 1)), data.draw(st.integers(0, view.height - 1))
    part = view.window(x, y, view.width, view.height)
    whole = part.window(-x, -y, part.width, part.height)
    assert (whole.width, whole.height) == (view.width, view.height)
    np.testing.assert_allclose(whole.project(points)[0], pixels, rtol=1e-9, atol=1e-9)


HEADS = {
    "plain": SMALL,
    "joints follow the expression": replace(SMALL, joints_follow_expression=True),
    "no correctives": replace(SMALL, pose_basis=SMALL.pose_basis[:0]),
}


@st.composite
def parameters(draw):
    """A head, betas [3], expression [1, 4], pose [1, 5, 3] and translation [1, 3], in double."""
    head: HeadModel = HEADS[draw(st.sampled_from(sorted(HEADS)))]
    shapes = ((3,), (1, 4), (1, 5, 3), (1, 3))
    values = [draw(filled(shape, 3)) for shape in shapes]
    return head, *(torch.from_numpy(value) for value in values)


@FEW
@given(parameters())
def test_a_head_that_is_not_posed_is_the_shaped_one(drawn):
    head, betas, expression, pose, translation = drawn
    still = torch.zeros_like(pose)
    found = head.pose(betas, expression, still, translation)[0].numpy()
    wanted = head.shaped(betas.numpy()) + np.tensordot(expression[0], head.expression_basis, 1)
    np.testing.assert_allclose(found, wanted + translation[0].numpy(), atol=1e-6)
    neutral = head.pose(betas, 0 * expression, still, 0 * translation)[0].numpy()
    np.testing.assert_allclose(neutral, head.shaped(betas.numpy()), atol=1e-6)


@FEW
@given(parameters(), turns)
def test_a_turn_of_the_root_turns_everything_about_it(drawn, turn):
    """Whatever the other joints do; distances between vertices stay."""
    head, betas, expression, pose, translation = drawn
    pose[0, 0] = 0
    turned = pose.clone()
    turned[0, 0] = torch.from_numpy(turn.as_rotvec())
    before = head.pose(betas, expression, pose, 0 * translation)[0].numpy()
    after = head.pose(betas, expression, turned, translation)[0].numpy()
    root = head.joints(betas.numpy())[0].astype(np.float64)
    if head.joints_follow_expression:
        shapes = head.joint_regressor[0].astype(np.float64) @ head.expression_basis
        root = root + expression[0].numpy() @ shapes
    wanted = turn.apply(before - root) + root + translation[0].numpy()
    np.testing.assert_allclose(after, wanted, atol=1e-6)


@FEW
@given(parameters(), st.integers(1, 4))
def test_a_joint_moves_rigidly_what_hangs_on_it_alone(drawn, joint):
    """Of a vertex that is all one joint's the distance to others of that joint stays, and joints
    that are not above it move it not at all."""
    head, betas, expression, pose, translation = drawn
    weights = np.zeros_like(head.skinning_weights)
    weights[:, 0] = 1
    weights[:4] = 0
    weights[:4, joint] = 1
    head = replace(head, skinning_weights=weights, pose_basis=head.pose_basis[:0])
    still = torch.zeros_like(pose)
    before = head.pose(betas, expression, still, translation)[0].numpy()
    after = head.pose(betas, expression, pose, translation)[0].numpy()
    for part in (slice(0, 4), slice(4, None)):
        lengths = [np.linalg.norm(v[part, None] - v[None, part], axis=-1) for v in (before, after)]
        np.testing.assert_allclose(lengths[1], lengths[0], atol=1e-9)
    only = torch.zeros_like(pose)
    only[0, joint] = pose[0, joint]
    alone = head.pose(betas, expression, only, translation)[0].numpy()
    np.testing.assert_allclose(alone[4:], before[4:], atol=1e-9)


@FEW
@given(parameters(), parameters())
def test_frames_posed_together_are_those_posed_alone(one, other):
    head, betas = one[0], one[1]
    together = head.pose(betas, *(torch.cat(pair) for pair in zip(one[2:], other[2:], strict=True)))
    for row, (_, _, *rest) in enumerate((one, other)):
        torch.testing.assert_close(together[row], head.pose(betas, *rest)[0])


@FEW
@given(deformed(), turns, vectors, seeds)
def test_how_a_mesh_stands_turns_with_it(posed, turn, shift, seed):
    """Whatever its deformation; and which way it is turned against itself does not change."""
    weights = np.random.default_rng(seed).uniform(0.1, 1, len(posed)).astype(np.float32)
    moved = (turn.apply(posed) + shift).astype(np.float32)
    rotation = head_rotation(CANONICAL, posed, weights)
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-6)
    assert np.linalg.det(rotation) > 0
    after = head_rotation(CANONICAL, moved, weights)
    np.testing.assert_allclose(after, turn.as_matrix() @ rotation, atol=1e-5)
    here, there = (stance(CANONICAL, mesh, weights) for mesh in (posed, moved))
    np.testing.assert_allclose(there.turn, here.turn, atol=1e-5)
    points = around(seed, 20)
    along = torch.from_numpy((turn.apply(points.numpy()) + shift).astype(np.float32))
    torch.testing.assert_close(there.still(along), here.still(points), rtol=0, atol=2e-5)
