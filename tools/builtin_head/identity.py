"""The identity space: people drawn from MakeHuman's sliders, and their principal components."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tools.builtin_head.cut import METRES, Cut, sphere_centre

COMPONENTS = 64
_PEOPLE = 6000
_RACES = ("african", "asian", "caucasian")
_GENDERS = ("female", "male")
_AGES = ("young", "old")
_LEVELS = ("min", "average", "max")
_FOLDERS = (
    "mouth", "nose", "eyebrows", "cheek", "head", "eyes", "forehead", "chin", "neck", "ears",
)  # fmt: skip
_OPPOSITES = (
    ("decr", "incr"), ("down", "up"), ("in", "out"), ("backward", "forward"),
    ("compress", "uncompress"), ("concave", "convex"),
)  # fmt: skip
# Moves of a whole part sideways, and of the head on the body: no trait of a face
_DROPPED = ("head-trans", "mouth-trans-in", "mouth-trans-out", "nose-trans-in", "nose-trans-out",
            "neck-trans", "head-angle")  # fmt: skip
# Standard deviation of slider values by folder
_SPREAD = {"ears": 0.18, "neck": 0.18, "eyes": 0.18, "nose": 0.2, "mouth": 0.2, "asym": 0.05}
_USUAL_SPREAD = 0.23
_ONE_SIDED_SPREAD = 0.15  # shapes without an opposite: round heads, pointed ears


@dataclass(frozen=True)
class Identity:
    """Metres; the eye joints of the average person lie at y = z = 0."""

    template: np.ndarray  # [V,3]
    basis: np.ndarray  # [B,V,3], unit variance in the drawn population
    kept_energy: float  # share of the population's (weighted) variance
    helper_template: np.ndarray  # [N,3] the same for MakeHuman's own vertices (joint cubes)
    helper_basis: np.ndarray  # [B,N,3]


def _macro_weights(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """MakeHuman's macro targets and their weights [people]."""
    race = rng.dirichlet(np.full(3, 0.45), _PEOPLE).T
    # most people near one end of the gender slider, some between
    gender = rng.beta(0.5, 0.5, _PEOPLE)
    age = np.clip(rng.exponential(0.22, _PEOPLE), 0, 0.8)
    muscle = np.clip(rng.normal(0.5, 0.12, _PEOPLE), 0, 1)
    weight = np.clip(rng.normal(0.5, 0.15, _PEOPLE), 0, 1)
    genders = dict(zip(_GENDERS, (1 - gender, gender), strict=True))
    ages = dict(zip(_AGES, (1 - age, age), strict=True))
    result = {}
    for g, gw in genders.items():
        for a, aw in ages.items():
            for r, rw in zip(_RACES, race, strict=True):
                result[f"macrodetails/{r}-{g}-{a}"] = rw * gw * aw
            for m, mw in zip(_LEVELS, _levels(muscle), strict=True):
                for w, ww in zip(_LEVELS, _levels(weight), strict=True):
                    name = f"macrodetails/universal-{g}-{a}-{m}muscle-{w}weight"
                    result[name] = gw * aw * mw * ww
    return result


def _levels(value: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    low = np.clip(1 - 2 * value, 0, 1)
    high = np.clip(2 * value - 1, 0, 1)
    return low, 1 - low - high, high


def _opposite(name: str) -> str | None:
    for minus, plus in _OPPOSITES:
        if name.endswith("-" + minus):
            return name.removesuffix(minus) + plus
    return None


def _detail_weights(cut: Cut, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Face sliders and their weights [people]; left and right go together but for a tenth."""
    result: dict[str, np.ndarray] = {}
    shared: dict[str, np.ndarray] = {}
    for folder in (*_FOLDERS, "asym"):
        spread = _SPREAD.get(folder, _USUAL_SPREAD)
        names = [
            name
            for name in cut.source.target_names(folder)
            if not any(part in name for part in _DROPPED) and "asymm-" not in name
        ]
        positive = {_opposite(name) for name in names}
        for name in names:
            if name in positive and _opposite(name) is None:
                continue  # drawn together with its opposite
            trait = name.replace("/l-", "/").replace("/r-", "/")
            if trait not in shared:
                shared[trait] = rng.normal(0, 1, _PEOPLE)
            own = rng.normal(0, 1, _PEOPLE)
            value = spread * np.clip(0.99 * shared[trait] + 0.1 * own, -2.5, 2.5)
            opposite = _opposite(name)
            if opposite in names:
                result[name] = np.maximum(-value, 0)
                result[opposite] = np.maximum(value, 0)
            elif folder == "asym":
                result[name] = np.maximum(value, 0)
            else:
                result[name] = np.maximum(value, 0) / spread * _ONE_SIDED_SPREAD
    return result


def build_identity(cut: Cut) -> Identity:
    """Principal components of the drawn people, heads aligned by translation of the skull."""
    rng = np.random.default_rng(7)
    drawn = {**_macro_weights(rng), **_detail_weights(cut, rng)}
    weights = np.stack(list(drawn.values()), 1)  # [people, K]
    helpers = np.stack([cut.source.target(name) for name in drawn])  # [K,N,3]
    vertices = np.stack([cut.displace(target, round_eyes=True) for target in helpers])  # [K,V,3]
    skull = _skull(cut)
    lift = vertices[:, skull].mean(1)[:, None]  # macros are bodies of other heights: the head moves
    vertices -= lift
    helpers -= lift
    mean = weights.mean(0)
    centred = weights - mean
    spread, axes = np.linalg.eigh(centred.T @ centred / len(centred))
    root = np.sqrt(np.maximum(spread, 0))[:, None] * axes.T  # root.T @ root is the covariance
    importance = _importance(cut, vertices)
    mixed = (root @ vertices.reshape(len(root), -1)).reshape(vertices.shape)
    weighted = (mixed * importance[:, None]).reshape(len(root), -1)
    left, singular, _ = np.linalg.svd(weighted, full_matrices=False)
    combine = left[:, :COMPONENTS].T @ root  # [B,K]
    combine *= np.sign(combine.sum(1, keepdims=True))
    template = cut.rest + np.tensordot(mean, vertices, 1)
    helper_template = cut.source.vertices + np.tensordot(mean, helpers, 1)
    centres = [sphere_centre(template[cut.eye_slice(side)]) for side in range(2)]
    origin = (centres[0] + centres[1]) / 2
    origin[0] = 0.0
    energy = float((singular[:COMPONENTS] ** 2).sum() / (singular**2).sum())
    return Identity(
        (template - origin) * METRES,
        np.tensordot(combine, vertices, 1) * METRES,
        energy,
        (helper_template - origin) * METRES,
        np.tensordot(combine, helpers, 1) * METRES,
    )


def _skull(cut: Cut) -> np.ndarray:
    """bool [V]: bone vertices of MakeHuman's head bone above the mouth."""
    rest = cut.rest
    head = cut.bone(cut.source.bone_weights["head"]) > 0.9
    return head & (rest[:, 1] > 6.9)


def _importance(cut: Cut, vertices: np.ndarray) -> np.ndarray:
    """Weight [V] of a vertex's variance: faces count, torsos barely."""
    height = cut.rest[:, 1]
    return 0.1 + 0.9 / (1 + np.exp(-(height - 6.1) / 0.15))
