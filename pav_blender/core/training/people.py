"""Several people for one avatar: a collection of each, all of one head model.

What they share is the canonical mesh, the mean of theirs: every posed head has the same triangles,
so that each person's frames are carried into that one space as one person's are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from ..collection import Collection, identity_distance, read_collection
from ..collection.writer import check_name
from ..errors import InputError
from ..field.identities import appearance_name
from .frames import Frame

_SAME = 1e-4  # metres: two tracks of one person differ by more, two collections of one track don't


@dataclass(frozen=True, eq=False)
class People:
    """Two or more collections by the names of their people."""

    collections: dict[str, Collection]

    @property
    def identities(self) -> dict[str, list[str]]:
        """Each person's appearances, "person/look"."""
        return {
            name: [appearance_name(name, look) for look in collection.appearances]
            for name, collection in self.collections.items()
        }

    @property
    def appearances(self) -> list[str]:
        return [name for looks in self.identities.values() for name in looks]

    @property
    def first(self) -> Collection:
        """The first collection, for what all have alike."""
        return next(iter(self.collections.values()))

    @property
    def canonical(self) -> np.ndarray:
        """The mesh [V, 3], metres, in whose space all of them are learned."""
        own = [c.head.canonical(c.betas) for c in self.collections.values()]
        return np.mean(own, 0, dtype=np.float64).astype(np.float32)

    @property
    def betas(self) -> np.ndarray:
        """[P, B], each person's followed by zeros up to the longest."""
        own = [collection.betas for collection in self.collections.values()]
        longest = max(len(betas) for betas in own)
        return np.stack([np.pad(betas, (0, longest - len(betas))) for betas in own])

    @property
    def head_offset(self) -> np.ndarray | None:
        """[P, V, 3] metres, or None where nobody has one."""
        own = [collection.head_offset for collection in self.collections.values()]
        if all(offset is None for offset in own):
            return None
        nothing = np.zeros_like(self.first.head.template)
        return np.stack([nothing if offset is None else offset for offset in own])

    def joined(self, name: str, frame: Frame) -> Frame:
        """A frame of a person's collection, with its appearance and name as of all of them."""
        look = self.collections[name].appearances[frame.appearance]
        row = self.appearances.index(appearance_name(name, look))
        return dataclasses.replace(frame, appearance=row, name=f"{name}/{frame.name}")


def read_people(folders: Mapping[str, Collection | Path | str]) -> People:
    """People by name, each a collection or its folder. InputError where they are fewer than two,
    are not of one head model, or where two have the same face."""
    if len(folders) < 2:
        raise InputError("one avatar of several people needs two collections or more")
    collections = {
        check_name(name, "person"): c if isinstance(c, Collection) else read_collection(c)
        for name, c in folders.items()
    }
    for (one, first), (two, second) in combinations(collections.items(), 2):
        if (first.head.fingerprint, first.head.expression_names) != (
            second.head.fingerprint,
            second.head.expression_names,
        ):
            raise InputError(
                f"{second.path}: {two!r} is tracked with head {second.head_name!r}, {one!r} with "
                f"{first.head_name!r}, another mesh: track both with one"
            )
        heads = [c.head.shaped(c.betas) for c in (first, second)]
        distance = identity_distance(first.head, *heads)
        if distance <= _SAME:
            raise InputError(
                f"{second.path}: {two!r} has just the face of {one!r}: clips of one person belong "
                "into one collection"
            )
    return People(collections)


def parse_people(texts: list[str]) -> dict[str, Path]:
    """ "NAME=FOLDER" or "FOLDER", whose last part is the name then -> folders by name. InputError
    where two have one name."""
    folders: dict[str, Path] = {}
    for text in texts:
        name, separator, folder = text.partition("=")
        if not separator or Path(text).is_dir():
            name, folder = Path(text).resolve().name, text
        if name in folders:
            raise InputError(
                f"--identities {text}: {name!r} is there already; write NAME={folder} to call "
                "this person otherwise"
            )
        folders[name] = Path(folder)
    return folders
