"""Other programs' segmentations in our labels."""

from __future__ import annotations

import numpy as np

from ..model import LABELS
from .parsed import LEAVE

# INSTA's seg_mask, red channel
_INSTA = {
    "face": (250, 240, 230, 150),  # skin, brows, nose
    "eyes": (210, 200),
    "accessory": (190, 160, 100, 70),  # glasses, earring, necklace, hat
    "ears": (180, 170),
    "mouth": (140,),
    "lips": (130, 120),
    "neck": (110,),
    "cloth": (90,),
    "scalp_hair": (80,),
}
# the nineteen classes of CelebAMask-HQ, as face-parsing networks number them
_PARSING = {
    "face": (1, 2, 3, 10),
    "eyes": (4, 5),
    "accessory": (6, 9, 15, 18),
    "ears": (7, 8),
    "mouth": (11,),
    "lips": (12, 13),
    "neck": (14,),
    "cloth": (16,),
    "scalp_hair": (17,),
}


def _table(groups: dict[str, tuple[int, ...]]) -> np.ndarray:
    table = np.full(256, LABELS.index("background"), np.uint8)
    for name, values in groups.items():
        table[list(values)] = LABELS.index(name)
    return table


def _threshold(below: int, above: int) -> np.ndarray:
    table = np.full(256, below, np.uint8)
    table[128:] = above
    return table


INSTA = _table(_INSTA)
# the code that INSTA's parser gives each of LABELS: left and right are one here; a beard is skin
INSTA_CODES = np.array([_INSTA.get(name, (0,))[0] for name in LABELS], np.uint8)
INSTA_CODES[LABELS.index("facial_hair")] = _INSTA["face"][0]
PARSING = _table(_PARSING)
# FlashAvatar tells head from the rest, and the mouth
NECK_AND_HEAD = _threshold(LABELS.index("cloth"), LABELS.index("face"))
MOUTH = _threshold(LEAVE, LABELS.index("mouth"))
