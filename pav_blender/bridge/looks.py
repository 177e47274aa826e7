"""What a head wears: an appearance, and layers of others over it, everywhere or where a vertex
group says. No bpy at the top: `worn` runs on any thread."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core.errors import InputError
from . import avatars, mesh

AREA_PREFIX = "area."
AREAS = ("hair", "beard", "clothes")  # of `core.head.areas`, which takes torch to load


@dataclass(frozen=True, eq=False)
class Layer:
    """An appearance over what lies below: by `weight`, and by `mask` [V] float32 where given."""

    appearance: str
    weight: float
    mask: np.ndarray | None

    def equals(self, other: Layer) -> bool:
        """Whether both look the same."""
        if (self.appearance, self.weight) != (other.appearance, other.weight):
            return False
        if self.mask is None or other.mask is None:
            return self.mask is other.mask
        return np.array_equal(self.mask, other.mask)


def worn(base: str, layers: tuple[Layer, ...]) -> str | dict[str, np.ndarray]:
    """The appearance, or the weight of each at every vertex ([V], or [] for the same everywhere).

    A layer hides what lies below it by its weight, as paint does.
    """
    if not layers:
        return base
    weights = {base: np.ones((), np.float32)}
    for layer in layers:
        part = np.asarray(1.0 if layer.mask is None else layer.mask, np.float32) * layer.weight
        weights = {name: np.asarray((1 - part) * weight) for name, weight in weights.items()}
        weights[layer.appearance] = np.asarray(weights.get(layer.appearance, 0) + part)
    return weights


def read_layers(evaluated: Any) -> tuple[Layer, ...]:
    """The layers of an evaluated head that show anything. InputError for a wrong choice."""
    original = evaluated.original
    every: np.ndarray | None = None
    found = []
    for index, layer in enumerate(evaluated.pav.layers):
        if layer.weight <= 0:
            continue
        if not layer.appearance:
            raise InputError(
                f"object {original.name!r}: layer {index + 1} has no appearance; choose one, or "
                "remove the layer"
            )
        mask = None
        if layer.region:
            group = original.vertex_groups.get(layer.region)
            if group is None:
                raise InputError(
                    f"object {original.name!r}: layer {index + 1} is for the vertex group "
                    f"{layer.region!r}, which is not there"
                )
            every = mesh.group_weights(original) if every is None else every
            mask = np.ascontiguousarray(every[:, group.index])
            if not mask.any():
                continue
        found.append(Layer(layer.appearance, float(layer.weight), mask))
    return tuple(found)


def add_area(object_: Any, name: str) -> str:
    """A vertex group with an area of a head (`core.head.areas`), ready to be painted over; returns
    its name. A group of that name that is there stays as it is."""
    from ..core.head.areas import area
    from .rig import REGION_PREFIX

    called = AREA_PREFIX + name
    if called in object_.vertex_groups:
        return called
    keys = object_.data.shape_keys
    points = keys.reference_key.data if keys else object_.data.vertices
    flat = np.empty(3 * len(points), np.float32)
    points.foreach_get("co", flat)
    every = mesh.group_weights(object_)
    regions = {
        group.name.removeprefix(REGION_PREFIX): every[:, group.index] > 0.5
        for group in object_.vertex_groups
        if group.name.startswith(REGION_PREFIX)
    }
    weights = area(name, mesh.points_to_core(flat.reshape(-1, 3)), regions)
    mesh.add_group(object_, called, weights)
    return called


def other_appearances(head: Any) -> list[str]:
    """Appearances of a head's avatar that neither it nor a layer wears yet; all others than its own
    where each is worn."""
    path = avatars.path_of(head.pav)
    known = avatars.looks(path, head.pav.identity)
    names = [name for name in known if name != head.pav.appearance]
    worn_already = {layer.appearance for layer in head.pav.layers}
    return [name for name in names if name not in worn_already] or names
