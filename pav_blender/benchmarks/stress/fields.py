"""Fields that no training ends in: nothing, everything, and numbers at the ends of float32."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ...core import kernels
from ...core.errors import InputError
from ...core.field.avatar import Avatar
from .checks import LEVELS, agrees, black, likeness, shown, sound
from .scene import Found, Given, Scene
from .subjects import Head, ball_of


def _biased(head: Head, network: str, value: float) -> Head:
    """The last layer's first output, or all of them for the colour, biased."""
    biases = getattr(head.avatar.field, network).biases
    with torch.no_grad():
        biases[-1][0 if network == "density" else slice(None)] = value
    return head


def all_skipped(given: Given) -> Found:
    """No cell of canonical space holds anything."""
    head, found = given.ball, Found()
    head.avatar.occupied[:] = False
    picture = shown(head)
    sound(found, picture, head.camera)
    found.at_most("pixels that show anything", int((picture.rgba != 0).sum()), 0)
    found.at_most("densities evaluated", picture.evaluations, 0)
    agrees(found, head)
    return found


def clear(given: Given) -> Found:
    """Transmittance stays 1: log-densities of -1e4."""
    head, found = _biased(given.ball, "density", -1e4), Found()
    agrees(found, head)
    found.at_most("greatest alpha", shown(head).rgba[..., 3].max(), 0)
    return found


def opaque(given: Given) -> Found:
    """Transmittance is 0 at the first sample: log-densities of 1e4."""
    head, found = _biased(given.ball, "density", 1e4), Found()
    agrees(found, head)
    alpha = shown(head).rgba[..., 3]
    found.at_most("pixels neither clear nor solid", int(((alpha > 0) & (alpha < 1)).sum()), 0)
    found.at_least("pixels that are solid", int((alpha == 1).sum()), 100)
    return found


def colours(given: Given) -> Found:
    """Logits of -1e4 and 1e4: black and white, neither beyond nor not a number."""
    found = Found()
    for value, wanted in ((-1e4, 0.0), (1e4, 1.0)):
        head = _biased(given.ball, "colour", value)
        picture = shown(head)
        seen = picture.rgba[picture.rgba[..., 3] > 0][:, :3]
        gap = np.abs(seen - wanted).max() * LEVELS
        found.at_most(f"from what it must be at {value:g}", gap, 0.001, "/255")
        agrees(found, head, of=f" at {value:g}")
    return found


def quadrature(given: Given) -> Found:
    """Thick and thin samples composited in float32, against float64."""
    found = Found()
    generator = torch.Generator().manual_seed(0)
    rays, many = 64, 40
    ray = torch.arange(rays).repeat_interleave(many).int()
    rgb = torch.rand(len(ray), 3, generator=generator)
    t = torch.rand(rays, many, generator=generator).sort(1).values.view(-1)
    worst = 0.0
    for scale in (0.0, 1e-42, 1e-20, 1e-3, 1.0, 1e3, 1e12, 3e38):
        sigma = torch.rand(len(ray), generator=generator) * scale
        found32 = kernels.select("cpu").marching.composite(sigma, rgb, t, 1e-3, ray, rays)
        found64 = kernels.select("cpu", reference=True).marching.composite(
            sigma.double(), rgb.double(), t.double(), 1e-3, ray, rays
        )
        gap = max(float((a - b).abs().max()) for a, b in zip(found32, found64, strict=True))
        found.raw[f"off at {scale:g} a metre"] = gap
        worst = max(worst, gap if np.isfinite(gap) else np.inf)
    found.at_most("from float64, in 1e-6", worst * 1e6, 5.0)
    return found


def largest(given: Given) -> Found:
    """Weights at float32's ends: refused by name where a value may overflow, else drawn."""
    found, refused = Found(), 0
    path = given.folder / "largest.pav"
    cases = {
        "all": lambda name, v: torch.full_like(v, 3.4e38),
        "signs": lambda name, v: torch.sign(v) * 3.4e38,
        "density": lambda name, v: v * 1e30 if name.startswith("density.weights") else v,
        "latent": lambda name, v: v * 3e38 if name == "latent" else v,
    }
    for case, change in cases.items():
        try:
            _saved(given.ball, path, change)
        except InputError as error:
            refused += "overflow" in str(error)
            found.raw[case] = str(error).replace(str(given.folder), "")
    found.at_least("refused by name", refused, len(cases))
    head = _saved(given.ball, path, lambda name, v: v * 1e3)
    agrees(found, head, levels=8, skip_db=20)
    return found


def denormal(given: Given) -> Found:
    """Weights too small for float32's normal numbers, and a mesh with such in it."""
    found = Found()
    path = given.folder / "denormal.pav"
    head = _saved(given.ball, path, lambda name, v: v * 1e-41)
    agrees(found, head)
    moved = given.ball
    tiny = np.where(np.abs(moved.vertices) < 1e-3, np.float32(1e-42), moved.vertices)
    agrees(found, replace(moved, vertices=tiny.astype(np.float32)), of=", in the mesh")
    return found


def _saved(head: Head, path, change) -> Head:  # type: ignore[no-untyped-def]
    state = head.avatar.field.state_dict()
    head.avatar.field.load_state_dict({k: change(k, v) for k, v in state.items()})
    head.avatar.save(path)
    return replace(head, avatar=Avatar.load(path))


def one_appearance(given: Given) -> Found:
    """An avatar of a single appearance."""
    found = Found()
    agrees(found, ball_of(1))
    return found


def many_appearances(given: Given) -> Found:
    """An avatar of 64: each alone, and all of them mixed."""
    found, head = Found(), ball_of(64)
    agrees(found, head)
    names = head.avatar.appearances
    alone = shown(head, appearance=names[63])
    sound(found, alone, head.camera, ", the last")
    mixed = shown(head, appearance=dict.fromkeys(names, 1.0))
    sound(found, mixed, head.camera, ", all mixed")
    found.raw["dB, mixed to the first"] = round(likeness(mixed, shown(head)), 1)
    # the mean of 64 shows less contrast than any one of them
    solid = (mixed.rgba[..., 3] > 0.9) & (alone.rgba[..., 3] > 0.9)
    spread = [float(black(p)[solid][:, :3].std()) for p in (mixed, alone)]
    found.raw["contrast, mixed and alone"] = [round(s, 4) for s in spread]
    return found


SCENES = [
    Scene("all samples skipped", all_skipped),
    Scene("transmittance stays 1", clear),
    Scene("transmittance falls to 0", opaque),
    Scene("logits of -1e4 and 1e4", colours),
    Scene("densities 0 to 3e38", quadrature),
    Scene("weights at float32's limits", largest),
    Scene("denormals", denormal),
    Scene("1 appearance", one_appearance),
    Scene("64 appearances", many_appearances),
]
