"""Pixels that lie between others: what may be their mean, and what must be looked at."""

from __future__ import annotations

import numpy as np
import pytest

from pav_blender.core import kernels
from pav_blender.core.kernels.reference import sparing as reference
from pav_blender.core.rendering.sparing import passes

AROUND = {(1, 1): ((-1, -1), (-1, 1), (1, -1), (1, 1)), (2, 1): ((-1, 0), (1, 0), (0, -1), (0, 1))}


def painted(truth, far, agreement, limit=None):
    """A picture made of passes over the truth [H, W, 4] (straight) and its depth, and what was
    traced."""
    rgba, depth = np.zeros_like(truth), np.full_like(far, np.inf)
    traced = np.zeros(far.shape, bool)
    for wanted in passes(rgba, depth, limit, agreement):
        assert not (wanted & traced).any()
        rgba[wanted], depth[wanted] = truth[wanted], far[wanted]
        traced |= wanted
    return rgba, depth, traced


def hills(height, width, seed=0):
    rng = np.random.default_rng(seed)
    row, column = np.mgrid[:height, :width] / 16
    waves = [np.sin(row * a + column * b + c) for a, b, c in rng.normal(size=(4, 3))]
    rgba = np.stack(waves, -1).astype(np.float32) / 4 + 0.5
    rgba[..., 3] = np.clip(3 * rgba[..., 3] - 0.6, 0, 1)
    depth = np.where(rgba[..., 3] > 0, 1 + 0.05 * rgba[..., 0], np.inf).astype(np.float32)
    rgba[rgba[..., 3] == 0] = 0
    return rgba, depth


@pytest.mark.parametrize("corner", AROUND)
@pytest.mark.parametrize("limited", [False, True])
@pytest.mark.parametrize("size", [(3, 3), (4, 5), (33, 40)])
def test_compiled_fill_is_the_reference(corner, limited, size):
    rgba, depth = hills(*size)
    rng = np.random.default_rng(1)
    limit = None
    if limited:
        limit = np.where(rng.random(size) < 0.5, np.inf, 1 + 0.2 * rng.random(size))
        limit = limit.astype(np.float32)
    free = rng.random(reference.lattice(depth, *corner).shape) < 0.8
    results = []
    for fill in (reference.fill, kernels.select("cpu").sparing.fill):
        own, far = rgba.copy(), depth.copy()
        filled = fill(own, far, limit, corner, AROUND[corner], 0.05, free)
        results.append((filled, own, far))
    np.testing.assert_array_equal(results[0][0], results[1][0])
    for plain, compiled in zip(results[0][1:], results[1][1:], strict=True):
        np.testing.assert_allclose(compiled, plain, rtol=1e-5, atol=1e-6)
    if size == (33, 40) and not limited:
        assert 0 < results[0][0].mean() < 1


@pytest.mark.parametrize("size", [(1, 1), (2, 9), (3, 3), (48, 31), (64, 64)])
def test_what_is_not_traced_differs_by_no_more_than_its_neighbours(size):
    truth, far = hills(*size)
    rgba, depth, traced = painted(truth, far, 0.05)
    np.testing.assert_array_equal(rgba[traced], truth[traced])
    assert np.abs(rgba - truth).max() < 0.05
    assert (np.isinf(depth) == (rgba[..., 3] == 0)).all()
    if min(size) > 40:
        assert traced.mean() < 0.8


def test_without_agreement_every_pixel_is_traced():
    truth, far = hills(20, 20)
    assert painted(truth, far, 0.0)[2].all()


@pytest.mark.parametrize("angle", np.linspace(0, np.pi, 9)[:-1])
@pytest.mark.parametrize("wide", [0.7, 1.0, 2.0])
def test_fine_lines_stay(angle, wide):
    row, column = np.mgrid[:96, :96] + 0.5
    for shift in (0.0, 0.5, 1.0):
        off = (column - 48.2 - shift) * np.cos(angle) + (row - 47.7 - shift) * np.sin(angle)
        line = np.clip(wide / 2 + 0.5 - np.abs(off), 0, 1)
        truth = np.ones((96, 96, 4), np.float32)
        truth[..., :3] -= 0.5 * line[..., None]
        rgba, _, _ = painted(truth, np.ones((96, 96), np.float32), 0.05)
        assert (1 - rgba[..., 0]).sum() > 0.95 * (1 - truth[..., 0]).sum()


def test_a_step_in_depth_of_one_colour_is_traced():
    truth = np.ones((32, 32, 4), np.float32)
    far = np.where(np.arange(32)[None] < 16, 1.0, 1.1).repeat(32, 0).astype(np.float32)
    _, depth, _ = painted(truth, far, 0.05)
    assert set(np.unique(depth).tolist()) == set(np.unique(far).tolist())


def test_what_stands_before_a_pixel_is_no_mean():
    """A wire before the face cuts single pixels off: none of them may show the face."""
    truth, far = np.ones((32, 32, 4), np.float32), np.ones((32, 32), np.float32)
    limit = np.full((32, 32), np.inf, np.float32)
    limit[:, 7] = limit[:, 12] = 0.5
    truth[limit < 1], far[limit < 1] = 0, np.inf
    rgba, _, _ = painted(truth, far, 0.05, limit)
    np.testing.assert_array_equal(rgba, truth)


def test_a_gap_between_what_stands_before_is_looked_through():
    truth, far = np.zeros((32, 32, 4), np.float32), np.full((32, 32), np.inf, np.float32)
    limit = np.full((32, 32), 0.5, np.float32)
    limit[:, 7] = limit[:, 12] = np.inf
    truth[limit > 1], far[limit > 1] = 1, 1.0
    rgba, _, _ = painted(truth, far, 0.05, limit)
    np.testing.assert_array_equal(rgba, truth)
