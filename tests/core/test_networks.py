"""A field's networks in one pass: against the same field network by network, and in plain torch."""

import dataclasses

import numpy as np
import pytest
import torch
from test_field import TINY, make_field, make_samples

from pav_blender.core import kernels
from pav_blender.core.errors import InputError
from pav_blender.core.kernels.cpu import exponential

FIELDS = {
    "default": TINY,
    "paper": dataclasses.replace(
        TINY,
        shoulder_levels=0,
        density_layers=2,
        colour_layers=3,
        geometry_channels=5,
        latent_channels=7,
        offset_sees_geometry=False,
        appearance_code=False,
        start_on_mesh=False,
    ),
    "global": dataclasses.replace(
        TINY, density_offset=False, appearance="global", global_channels=6
    ),
    "none": dataclasses.replace(TINY, appearance="none"),
    "surface": dataclasses.replace(
        TINY, hidden=20, appearance="surface", levels=6, shoulder_levels=6
    ),
}


def samples_of(count):
    direction = torch.randn(count, 3, generator=torch.Generator().manual_seed(1))
    return dataclasses.replace(
        make_samples(count),
        direction=torch.nn.functional.normalize(direction, dim=1),
        frame=torch.arange(count, dtype=torch.int32) * 2 // max(count, 1),
    )


def double(samples):
    values = dataclasses.asdict(samples)
    wide = {k: v.double() if v.is_floating_point() else v for k, v in values.items()}
    return dataclasses.replace(samples, **wide)


def answers(field, samples, upstream):
    """Density, colour and the gradient of both to every parameter."""
    field.zero_grad()
    sigma, rgb = field(samples)
    kind = sigma.dtype
    total = (sigma * 1e-3 * upstream[0].to(kind)).sum() + (rgb * upstream[1].to(kind)).sum()
    total.backward()
    named = {n: p.grad.clone() for n, p in field.named_parameters() if p.grad is not None}
    return {"density": sigma.detach(), "colour": rgb.detach(), **named}


@pytest.mark.parametrize("config", FIELDS.values(), ids=FIELDS)
@pytest.mark.parametrize("count", [1, 96, 97, 1000])
def test_agrees_with_double_precision(config, count):
    """Values and all gradients; counts about the size of a block, and of several parts."""
    field, samples = make_field(config), samples_of(count)
    upstream = torch.rand(count), torch.rand(count, 3)
    got = answers(field, samples, upstream)
    with kernels.plain_torch():
        want = answers(field.double(), double(samples), upstream)
    assert got.keys() == want.keys()
    for name, value in got.items():
        if value.numel():
            largest = want[name].abs().max().clamp(min=1e-9)
            assert float((value.double() - want[name]).abs().max() / largest) < 2e-5, name


def test_what_reaches_the_limit_has_no_gradient():
    field, samples = make_field(dataclasses.replace(TINY, log_density_limit=-1.0)), samples_of(200)
    sigma, _ = field(samples)
    limited = sigma.detach() >= float(np.exp(-1.0) * 1e3) * (1 - 1e-6)
    assert 20 < int(limited.sum()) < 180
    encoded = field.encode(samples).detach().requires_grad_()
    field(samples, encoded=encoded)[0].sum().backward()
    moved = encoded.grad.abs().sum(1) > 0
    assert torch.equal(moved, ~limited)


def test_gradients_do_not_depend_on_threads(monkeypatch):
    field, samples = make_field(), samples_of(3000)
    upstream = torch.rand(3000), torch.rand(3000, 3)
    runs = []
    for count in (1, 2, 3):
        monkeypatch.setattr("pav_blender.core.kernels.cpu.threads.threads", lambda n=count: n)
        runs.append(answers(field, samples, upstream))
    for other in runs[1:]:
        for name, value in runs[0].items():
            assert torch.equal(value, other[name]), name


def test_samples_do_not_spoil_one_another():
    field, samples = make_field(), samples_of(300)
    encoded = field.encode(samples).detach()
    with torch.no_grad():
        good = field(samples, encoded=encoded)
        encoded[17] = float("nan")
        spoiled = field(samples, encoded=encoded)
    kept = torch.arange(300) != 17
    for a, b in zip(good, spoiled, strict=True):
        assert torch.equal(a[kept], b[kept])
        assert b[17].isnan().all()


def test_what_does_not_fit_is_refused():
    field, samples = make_field(), samples_of(10)
    with pytest.raises(InputError, match="density takes"):
        field(samples, encoded=torch.zeros(10, 3))
    with pytest.raises(InputError, match="ray"):
        field(dataclasses.replace(samples, ray=samples.ray + 1))
    with pytest.raises(InputError, match="frame"):
        field(dataclasses.replace(samples, frame=samples.frame - 1))


def test_no_samples_at_all():
    field = make_field()
    sigma, rgb = field(samples_of(0))
    (sigma.sum() + rgb.sum()).backward()
    assert rgb.shape == (0, 3)
    assert all(p.grad is None or not p.grad.any() for p in field.parameters())


def test_exponentials_are_within_their_bound():
    random = np.random.default_rng(0)
    spread = np.linspace(-87, 88, 1 << 18), random.normal(size=1 << 18) * 1e-3
    x = np.concatenate(spread).astype(np.float32)
    found = x.copy()
    exponential.exp_all(found, len(found))
    assert np.abs(found / np.exp(x.astype(np.float64)) - 1).max() < 2e-7
    edges = np.array([np.nan, 0, -1e9, 1e9, np.inf, -np.inf] + [0] * 10, np.float32)
    exponential.exp_all(edges, len(edges))
    assert np.isnan(edges[0])
    assert edges[1] == 1
    assert 0 <= edges[2] == edges[5] < 1e-37
    assert 1e38 < edges[3] == edges[4]
