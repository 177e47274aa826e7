"""The methods that the paper's tables compare, as settings of one and the same code."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from ..config import Config
from ..errors import InputError

_PAPER = Config.paper()


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

METHODS = (
    Method("insta", "INSTA, unified", _INSTA),
    Method("insta_clips", "INSTA, one a clip", _INSTA, per_clip=True),
    Method("no_lnf", "PAV without LNF", _NO_LNF),
    Method("no_offset", "PAV without density offset", _NO_OFFSET),
    Method("surface", "PAV, features on the surface", _SURFACE),
    # features at the vertices of the nearest triangle, as the paper reads them
    Method("full", "PAV, full", _PAPER),
    Method("ours", "ours", Config()),
    Method("ours_two", "ours, two people in one", Config(), two_people=True),
)


def method(key: str) -> Method:
    """The method of that key; InputError naming those there are."""
    for one in METHODS:
        if one.key == key:
            return one
    raise InputError(f"method {key!r}: one of {', '.join(m.key for m in METHODS)}")
