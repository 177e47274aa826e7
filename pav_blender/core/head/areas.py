"""Areas of a head that wear something of their own, with soft edges: hair, beard, clothes.

Made for painting over: what hangs from the head belongs to the place of the mesh it is nearest to.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ..errors import InputError

_EDGE = 0.012  # metres over which an area ends
_HAIR = 0.06  # metres beside the scalp
_TEMPLES = 0.02  # metres before the ears


def area(name: str, vertices: np.ndarray, regions: Mapping[str, np.ndarray]) -> np.ndarray:
    """Weights [V] float32 from 0 to 1 of one of AREAS, on a head at rest.

    vertices [V, 3] metres, core axes; regions: bool [V] each. InputError where a region that the
    area is made of is missing.
    """
    if name not in AREAS:
        raise InputError(f"area {name!r}: one of {', '.join(AREAS)}")
    needed, make = AREAS[name]
    for region in needed:
        if region not in regions or not regions[region].any():
            raise InputError(f"the head has no region {region!r}, which the area {name!r} needs")
    return make(np.asarray(vertices, np.float64), regions).astype(np.float32)


Regions = Mapping[str, np.ndarray]


def _beside(vertices: np.ndarray, members: np.ndarray, reach: float) -> np.ndarray:
    """1 up to `reach` metres from a region, 0 an edge farther."""
    from scipy.spatial import cKDTree  # here, for the add-on loads where there is none

    distance, _ = cKDTree(vertices[members]).query(vertices)
    return np.clip((reach + _EDGE - distance) / _EDGE, 0, 1)


def _hair(vertices: np.ndarray, regions: Regions) -> np.ndarray:
    """About the scalp: all from the temples back, and what lies above the eyes before them."""
    near = _beside(vertices, regions["scalp"], _HAIR)
    eyes = vertices[regions["eyeballs"], 1].mean()
    ears = vertices[regions["ears"], 2].mean()
    above = np.clip((vertices[:, 1] - eyes) / _EDGE, 0, 1)
    behind = np.clip((ears + _TEMPLES - vertices[:, 2]) / _EDGE + 0.5, 0, 1)
    return near * np.maximum(above, behind)


def _beard(vertices: np.ndarray, regions: Regions) -> np.ndarray:
    """The face below the nose, but not the lips."""
    eyes, lips = (vertices[regions[name], 1].mean() for name in ("eyeballs", "lips"))
    nose = (eyes + 2 * lips) / 3
    low = np.clip((nose - vertices[:, 1]) / _EDGE + 0.5, 0, 1)
    inside = np.maximum.reduce([regions[n] for n in ("lips", "mouth_interior") if n in regions])
    return low * _beside(vertices, regions["face"], 0.0) * ~inside.astype(bool)


def _clothes(vertices: np.ndarray, regions: Regions) -> np.ndarray:
    """Torso and neck: collars stand as high as the chin."""
    low = regions["torso"] | regions["neck"]
    return _beside(vertices, low, 0.0) * (1 - _hair(vertices, regions))


AREAS: dict[str, tuple[tuple[str, ...], Callable[[np.ndarray, Regions], np.ndarray]]] = {
    "hair": (("scalp", "eyeballs", "ears"), _hair),
    "beard": (("face", "lips", "eyeballs"), _beard),
    "clothes": (("torso", "neck", "scalp", "eyeballs", "ears"), _clothes),
}
