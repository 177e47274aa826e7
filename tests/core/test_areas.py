"""Areas of a head that may wear something of their own."""

from __future__ import annotations

import numpy as np
import pytest

from pav_blender.core.errors import InputError
from pav_blender.core.head import builtin_head
from pav_blender.core.head.areas import AREAS, area


@pytest.fixture(scope="module")
def head():
    return builtin_head()


@pytest.mark.parametrize("name", AREAS)
def test_areas_have_soft_edges(head, name):
    weights = area(name, head.template, head.regions)
    assert weights.shape == (len(head.template),)
    assert weights.dtype == np.float32
    assert weights.min() == 0
    assert weights.max() == 1
    assert 0.03 < (weights > 0.5).mean() < 0.5
    edge = (weights > 0.05) & (weights < 0.95)
    assert edge.sum() > 20
    # next to each other, weights differ little: a third of what an edge as wide would show
    corners = head.triangles[:, [0, 1]]
    steps = np.abs(np.diff(weights[corners], axis=1))[:, 0]
    lengths = np.linalg.norm(np.diff(head.template[corners], axis=1)[:, 0], axis=1)
    inside = head.regions["lips"] | head.regions["mouth_interior"]
    free = ~inside[corners].any(1)  # a beard ends at the lips, which is meant to be sharp
    assert (steps[free] <= 3 * lengths[free] / 0.012 + 1e-3).all()


def test_areas_are_where_they_are_called(head):
    y, z = head.template[:, 1], head.template[:, 2]
    hair, beard, clothes = (area(n, head.template, head.regions) for n in AREAS)
    eyes = y[head.regions["eyeballs"]].mean()
    assert y[hair > 0.5].max() == y.max()
    assert hair[head.regions["scalp"] & (z < z[head.regions["ears"]].mean())].min() == 1
    assert hair[head.regions["lips"]].max() == 0
    assert (y[beard > 0] < eyes).all()
    assert beard[head.regions["lips"]].max() == 0
    assert clothes[head.regions["torso"]].min() > 0.99
    assert clothes[head.regions["face"]].mean() < 0.05


def test_an_unknown_area_and_a_region_too_few_are_named(head):
    with pytest.raises(InputError, match="area 'hat': one of hair, beard, clothes"):
        area("hat", head.template, head.regions)
    less = {name: mask for name, mask in head.regions.items() if name != "ears"}
    with pytest.raises(InputError, match="no region 'ears', which the area 'hair' needs"):
        area("hair", head.template, less)
