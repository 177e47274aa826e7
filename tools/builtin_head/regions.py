"""Named vertex sets of the head."""

from __future__ import annotations

import numpy as np

from tools.builtin_head.cut import Cut
from tools.builtin_head.rig import Rig

_EYE_REACH = 0.021  # metres from an eye's centre, seen from the front
_NECK_TOP = -0.05  # metres below the eyes: the hairline at the nape


def build_regions(
    cut: Cut, template: np.ndarray, rig: Rig, triangles: np.ndarray, islands: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Region name -> bool [V]; template: [V,3] metres."""

    def of_island(*names: str) -> np.ndarray:
        mask = np.zeros(len(template), bool)
        for name in names:
            mask[triangles[islands[name]]] = True
        return mask

    head = of_island("head")
    sockets = of_island("left_socket", "right_socket") & ~head
    mouth = of_island("mouth") & ~head
    mouth_rim = of_island("mouth") & head
    painted = {name: _painted(cut, name, head) for name in ("face", "lips", "ears")}
    painted = {name: mask | mask[cut.mirror] for name, mask in painted.items()}
    neck_share = rig.weights[:, 1] + rig.weights[:, 2]
    face = painted["face"] & ~painted["ears"]
    skin = head & ~painted["ears"]
    below = template[:, 1] < _NECK_TOP
    neck = (skin | of_island("torso")) & ~face & below & (neck_share > 0.08)
    regions = {
        "face": face,
        "lips": painted["lips"] | mouth_rim,
        "ears": painted["ears"],
        "neck": neck,
        "scalp": skin & ~face & ~neck,
        "torso": of_island("torso") & ~neck,
        "eyeballs": of_island("left_eye", "right_eye"),
        "eye_sockets": sockets,
        "mouth_interior": mouth | of_island("helper-tongue"),
        "tongue": of_island("helper-tongue"),
        "teeth": of_island("helper-upper-teeth", "helper-lower-teeth"),
    }
    for side, name in enumerate(("left", "right")):
        centre = template[cut.eye_slice(side)].mean(0)
        distance = np.linalg.norm((template - centre)[:, :2] * (0.85, 1.1), axis=1)
        regions[f"{name}_eye_region"] = face & (distance < _EYE_REACH)
    return regions


def _painted(cut: Cut, name: str, allowed: np.ndarray) -> np.ndarray:
    """bool [V]: allowed vertices under white paint of one of MakeHuman's masks."""
    picture = cut.source.uv_mask(name)
    height, width = picture.shape
    corners = cut.new_index[cut.source.quads[cut.quad_index]].ravel()
    uv = cut.source.uvs[cut.source.uv_quads[cut.quad_index]].reshape(-1, 2)
    column = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    row = np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1)
    mask = np.zeros(len(allowed), bool)
    mask[corners[(picture[row, column] > 0.5) & (corners >= 0)]] = True
    return mask & allowed
