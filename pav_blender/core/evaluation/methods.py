"""The methods that the paper's tables compare, as settings of one and the same code."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from ..config import Config
from ..errors import InputError

_PAPER = Config.paper()
_OURS = Config()


@dataclass(frozen=True)
class Method:
    """key names its files; title is what tables call it; per_clip: a network for each appearance
    instead of one for all; two_people: one network for another person's clips too."""

    key: str
    title: str
    config: Config
    per_clip: bool = False
    two_people: bool = False


_INSTA = dataclasses.replace(_PAPER, appearance="none")
# the paper's vector has 512 values; they enter 64 hidden units, so that 64 can do as much, sooner
_NO_LNF = dataclasses.replace(_PAPER, appearance="global", global_channels=64)
_NO_OFFSET = dataclasses.replace(_PAPER, density_offset=False)
# a texture of 512 x 512 x 16 a clip, read where the nearest point lies instead of at vertices
_SURFACE = dataclasses.replace(_PAPER, appearance="surface")

# ours, each with one choice taken back to the paper's, or to none
_ALIKE = ("learning_rate", "offset_learning_rate", "table_learning_rate", "latent_learning_rate")
_RATES = {name: getattr(_PAPER, name) for name in (*_ALIKE, "final_learning_rate")}
_CHANGES: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("no_turn", "density does not see the turn", {"sees_turn": False}),
    ("no_shoulders", "no features that rest with the shoulders", {"shoulder_levels": 0}),
    ("expression", "density sees the expression", {"sees_expression": True}),
    ("no_code", "no vector an appearance", {"appearance_code": False}),
    ("blind_offset", "offset sees the embedding alone", {"offset_sees_geometry": False}),
    ("from_fog", "begins as fog", {"start_on_mesh": False, "density_bias": _PAPER.density_bias}),
    ("no_distortion", "no distortion loss", {"distortion_weight": 0.0}),
    ("rigid", "a rigid frame a triangle", {"frames": _PAPER.frames}),
    ("paper_rates", "the paper's learning rates", _RATES),
)
CHOICES = tuple(
    Method(key, f"ours, {words}", dataclasses.replace(_OURS, **changes))
    for key, words, changes in _CHANGES
)

METHODS = (
    Method("insta", "INSTA, unified", _INSTA),
    Method("insta_clips", "INSTA, one a clip", _INSTA, per_clip=True),
    Method("no_lnf", "PAV without LNF", _NO_LNF),
    Method("no_offset", "PAV without density offset", _NO_OFFSET),
    Method("surface", "PAV, features on the surface", _SURFACE),
    # features at the vertices of the nearest triangle, as the paper reads them
    Method("full", "PAV, full", _PAPER),
    Method("ours", "ours", _OURS),
    Method("ours_two", "ours, two people in one", _OURS, two_people=True),
    *CHOICES,
)


def method(key: str) -> Method:
    """The method of that key; InputError naming those there are."""
    for one in METHODS:
        if one.key == key:
            return one
    raise InputError(f"method {key!r}: one of {', '.join(m.key for m in METHODS)}")
