"""Whose head an appearance is, in an avatar of several people.

They share the canonical mesh (the mean of theirs) and all networks; the density is told whose head
it is as it is told how the head is turned: by a number each, 1 for that person and 0 for others,
so that the weights such a number meets are the person's learned code.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..collection import Collection, identity_distance
from ..collection.relative import OTHER_PERSON
from ..errors import InputError
from ..head import HeadModel

if TYPE_CHECKING:
    from .avatar import Avatar


@dataclass(frozen=True, eq=False)
class Identity:
    """One person's head: betas [B], and head_offset [V, 3], metres, or None; name: "" in an avatar
    of one person."""

    name: str
    betas: np.ndarray
    head_offset: np.ndarray | None

    def of(self, head: HeadModel) -> HeadModel:
        """A head model, as it was before anyone's offset, with this person's."""
        return head if self.head_offset is None else head.with_offset(self.head_offset)

    def neutral(self, collection: Collection) -> np.ndarray:
        """The person's neutral head [V, 3], metres, by the head model of a collection."""
        return collection.head_with(self.head_offset).shaped(self.betas)


def appearance_name(person: str, look: str) -> str:
    """What an appearance of one of several people is called."""
    return f"{person}/{look}"


def person_of(avatar: Avatar, appearance: str) -> int:
    """The row of the person that an appearance is of; InputError where it is unknown."""
    avatar.appearance_index(appearance)
    for row, looks in enumerate(avatar.identities.values()):
        if appearance in looks:
            return row
    return 0


def identity(avatar: Avatar, appearance: str | None = None) -> Identity:
    """Whose head an appearance is; None will do where there is but one person, else InputError."""
    if not avatar.identities:
        return Identity("", avatar.betas, avatar.head_offset)
    if appearance is None:
        raise InputError(
            f"an avatar of {', '.join(avatar.identities)}: name an appearance, which says whose "
            "head it is"
        )
    row = person_of(avatar, appearance)
    offset = None if avatar.head_offset is None else avatar.head_offset[row]
    return Identity([*avatar.identities][row], avatar.betas[row], offset)


def code(avatar: Avatar, row: int) -> torch.Tensor:
    """What `condition` is told of the person of an appearance, by its row: [P], or [0] in an
    avatar of one person."""
    return codes(avatar)[row]


def codes(avatar: Avatar) -> torch.Tensor:
    """The same for every appearance: [A, P], or [A, 0]."""
    people = len(avatar.identities)
    if not people:
        return torch.zeros(len(avatar.appearances), 0)
    return torch.eye(people)[[person_of(avatar, name) for name in avatar.appearances]]


def check_one_person(avatar: Avatar, rows: Sequence[int]) -> None:
    """InputError where appearances, by their rows, are not of one person: a picture is of one."""
    names = [avatar.appearances[row] for row in rows]
    first = person_of(avatar, names[0])
    for name in names[1:]:
        if person_of(avatar, name) != first:
            raise InputError(
                f"appearances {names[0]!r} and {name!r} are of two people: those of one can be "
                "mixed"
            )


def own_appearances(avatar: Avatar, collection: Collection) -> list[str]:
    """What the appearances of a collection are called in an avatar that learned from it.

    Of several people it is the one whose head the collection was tracked on; InputError where it
    is nobody's.
    """
    if not avatar.identities:
        return collection.appearances
    people = [identity(avatar, looks[0]) for looks in avatar.identities.values()]
    tracked = collection.head.shaped(collection.betas)
    far = [identity_distance(collection.head, p.neutral(collection), tracked) for p in people]
    if min(far) > OTHER_PERSON:
        raise InputError(
            f"{collection.path}: tracked on none of {', '.join(avatar.identities)}; the nearest "
            f"face is {1e3 * min(far):.1f} mm off"
        )
    person = people[int(np.argmin(far))].name
    return [appearance_name(person, look) for look in collection.appearances]


def read_identities(header: Mapping[str, Any]) -> dict[str, list[str]]:
    """The people of a `.pav` file's header, {} for one. InputError where the appearances said to
    be theirs are not just those there are."""
    if "identities" not in header:
        return {}
    stored, appearances = header["identities"], header.get("appearances")
    fits = isinstance(stored, dict) and len(stored) > 1
    if not fits or not all(isinstance(looks, list) and looks for looks in stored.values()):
        raise InputError("the identities are not two or more people with their appearances")
    named = [str(look) for looks in stored.values() for look in looks]
    there = [str(name) for name in appearances] if isinstance(appearances, list) else []
    if len(set(there)) < len(there) or sorted(named) != sorted(there):
        raise InputError("the identities' appearances are not those of the avatar, each once")
    return {person: [str(look) for look in looks] for person, looks in stored.items()}


def check_shapes(
    identities: Mapping[str, list[str]], betas: np.ndarray, offset: np.ndarray | None, vertices: int
) -> None:
    """InputError unless a `.pav` file's betas and head offset are one person's, or a row each."""
    people = (len(identities),) if identities else ()
    if betas.ndim != len(people) + 1 or betas.shape[: len(people)] != people:
        whose = f"{len(identities)} people's" if identities else "one person's"
        raise InputError(f"the betas are {betas.shape}; {whose} expected")
    if offset is not None and offset.shape != (*people, vertices, 3):
        raise InputError(f"the head's offset is {offset.shape}; {(*people, vertices, 3)} expected")
