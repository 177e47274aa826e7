"""Several appearances at once: how densities and colours mix, and where shares lie in space."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pav_blender.core.errors import InputError
from pav_blender.core.evaluation.metrics import over, psnr
from pav_blender.core.field.mixture import EMPTY, SOLID, Mixture, at_samples, mix
from pav_blender.core.rendering.guide import neighbourhood
from pav_blender.core.rendering.render import render
from pav_blender.core.rendering.sequence import parse_appearance
from pav_blender.core.rendering.wearing import deformer_of, shares_of, wearing_of
from pav_blender.core.training.frames import camera_of

densities = st.floats(0, 1e3)  # a millimetre: from nothing to what nothing passes
share = st.floats(0, 1)


def mixed(share, one, other):
    shares = torch.tensor([[1 - share, share]], dtype=torch.float64)
    return mix(shares, torch.tensor([[one, other]], dtype=torch.float64))


@given(share, densities, densities)
def test_a_mixture_is_no_denser_than_its_densest(share, one, other):
    density, parts = mixed(share, one, other)
    assert 0 <= density.item() <= max(one, other) * (1 + 1e-9)
    assert torch.isfinite(parts).all()
    assert (parts >= 0).all()
    brought = (1 - share) * one + share * other
    assert parts.sum().item() == pytest.approx(1) or brought < 1e-9


@given(densities, densities)
def test_a_whole_share_is_that_appearance(one, other):
    density, parts = mixed(1.0, one, other)
    assert density.item() == pytest.approx(max(other - EMPTY, 0), abs=1e-9, rel=1e-6)
    assert parts[0, 0] == 0


@given(share, share, densities, densities)
def test_more_of_the_denser_is_denser(low, high, one, other):
    low, high = sorted((low, high))
    thin, thick = sorted((one, other))
    assert mixed(low, thin, thick)[0] <= mixed(high, thin, thick)[0] * (1 + 1e-9) + 1e-12


def test_what_one_lacks_fades_evenly():
    """Two centimetres of hair that is there in one appearance only."""
    seen = [1 - np.exp(-mixed(s, 0.0, 5.0)[0].item() * 20) for s in (0.25, 0.5, 0.75, 0.95)]
    assert 0.05 < seen[0] < 0.2 < seen[1] < 0.5 < seen[2] < 0.8 < seen[3]


def test_what_both_have_stays_solid():
    assert mixed(0.5, 3.0, 3.0)[0].item() == pytest.approx(3.0, rel=2e-3)
    assert mixed(0.5, SOLID, 8.0)[0].item() > SOLID


def test_shares_in_space_are_read_between_the_middles_of_cells():
    shares = torch.rand(1, 4, 4, 4)
    mixture = Mixture(torch.cat([shares, 1 - shares]), torch.ones(2, 2, 2, 2, dtype=torch.bool))
    middles = torch.stack(torch.meshgrid(*[(torch.arange(4) + 0.5) / 4] * 3, indexing="ij"), -1)
    found, _ = at_samples(mixture, middles.reshape(-1, 3))
    torch.testing.assert_close(found[:, 0], shares.reshape(-1))
    halfway, _ = at_samples(mixture, (middles[1, 1, 1] + middles[2, 1, 1])[None] / 2)
    torch.testing.assert_close(halfway[0, 0], (shares[0, 1, 1, 1] + shares[0, 2, 1, 1]) / 2)


def test_filled_cells_are_those_of_the_place():
    filled = torch.zeros(2, 2, 2, 2, dtype=torch.bool)
    filled[1, 1, 0, 1] = True
    mixture = Mixture(torch.full((2, 1, 1, 1), 0.5), filled)
    _, found = at_samples(mixture, torch.tensor([[0.9, 0.1, 0.6], [0.1, 0.9, 0.6], [1.0, 0, 1.0]]))
    assert found.tolist() == [[False, True], [False, False], [False, True]]


def test_wrong_weights_are_named(toy_avatar):
    with pytest.raises(InputError, match=r"'plain'.*\[3\]; a number or"):
        shares_of(toy_avatar, {"plain": np.ones(3)})
    with pytest.raises(InputError, match="unknown appearance 'bald'"):
        shares_of(toy_avatar, {"bald": 1.0})
    for wrong in (-1.0, np.nan, 0.0):
        with pytest.raises(InputError, match="plain: finite, none negative"):
            shares_of(toy_avatar, {"plain": wrong})


def test_blends_on_a_command_line(toy_avatar):
    assert parse_appearance("bushy", toy_avatar) == "bushy"
    assert parse_appearance("bushy=0.25,plain=1", toy_avatar) == {"bushy": 0.25, "plain": 1.0}
    for text, words in (
        ("bald", "unknown appearance 'bald'"),
        ("bald=1", "unknown appearance 'bald'"),
        ("plain=", "write NAME=WEIGHT"),
        ("plain=1,bushy", "write NAME=WEIGHT"),
        ("plain=-1,bushy=2", "none negative"),
    ):
        with pytest.raises(InputError, match=words):
            parse_appearance(text, toy_avatar)


def test_only_what_is_worn_somewhere_counts(toy_avatar):
    rows, shares = shares_of(toy_avatar, {"plain": 3.0, "bushy": 0.0})
    assert rows == (toy_avatar.appearances.index("plain"),)
    assert (shares == 1).all()
    assert wearing_of(toy_avatar, {"plain": 3.0}).mixture is None


def test_shares_are_sharp_on_the_mesh_and_blurred_away_from_it(toy_avatar):
    right = (toy_avatar.canonical_vertices[:, 0] > 0).astype(np.float32)
    mixture = wearing_of(toy_avatar, {"plain": 1 - right, "bushy": right}).mixture
    size = mixture.filled.shape[-1]
    middles = (np.argwhere(mixture.filled.any(0).numpy()) + 0.5) / size * toy_avatar.box_size
    points = torch.from_numpy((middles + toy_avatar.box_min).astype(np.float32))
    deformer = deformer_of(toy_avatar)
    mesh = deformer.pose(toy_avatar.canonical_vertices)
    distance = deformer.nearest(mesh, points)[2].numpy()
    unit = torch.from_numpy((middles / toy_avatar.box_size).astype(np.float32))
    shares = at_samples(mixture, unit)[0].numpy()
    np.testing.assert_allclose(shares.sum(1), 1, atol=1e-5)
    between = (shares[:, 0] > 0.02) & (shares[:, 0] < 0.98)
    near, far = distance < 0.004, distance > 0.03
    assert near.any()
    assert far.any()
    assert between[far].mean() > 1.5 * between[near].mean()


def test_each_half_of_a_head_wears_its_own(toy, toy_avatar):
    """Left of the middle one appearance, right of it the other; far from the seam each is as it is
    alone."""
    clip = toy.clip("plain")
    pose = {
        "vertices": toy.posed(clip, np.array([7]))[0],
        "camera": camera_of(clip, 7).resized(64, 64),
        "expression": clip.expression[7],
    }
    left = (toy_avatar.canonical_vertices[:, 0] > 0).astype(np.float32)
    both = render(toy_avatar, appearance={"plain": left, "bushy": 1 - left}, **pose)
    alone = {n: render(toy_avatar, appearance=n, **pose) for n in ("plain", "bushy")}
    columns = np.flatnonzero((both.rgba[..., 3] > 0.5).any(0))
    width = len(columns) // 4
    sides = {"bushy": slice(columns[0], columns[width]),
             "plain": slice(columns[-width], columns[-1])}  # fmt: skip
    for name, other in (("plain", "bushy"), ("bushy", "plain")):
        part = np.s_[:, sides[name]]
        own = psnr(over(both.rgba[part], 1.0), over(alone[name].rgba[part], 1.0))
        others = psnr(over(both.rgba[part], 1.0), over(alone[other].rgba[part], 1.0))
        assert own > max(40, others + 10), (name, own, others)


def test_a_neighbourhood_is_the_greatest_of_27_cells():
    grids = torch.rand(2, 7, 5, 6, generator=torch.Generator().manual_seed(0))
    pooled = torch.nn.functional.max_pool3d(grids[:, None], 3, 1, 1)[:, 0]
    assert torch.equal(neighbourhood(grids), pooled)
