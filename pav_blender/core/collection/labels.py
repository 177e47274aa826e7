"""What each pixel of a frame shows, where a collection says it."""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from ..images import read_gray
from .model import LABELS, Clip, Collection


def read_labels(collection: Collection, clip: Clip, row: int) -> np.ndarray | None:
    """Indices into LABELS, uint8 [H, W]; None where the frame has none. Raises InputError for
    another size than the picture's, and for labels that there are not."""
    path = collection.labels_path(clip, row)
    if not path.is_file():
        return None
    labels = read_gray(path)
    if labels.shape != (clip.height, clip.width) or labels.max() >= len(LABELS):
        raise InputError(f"{path}: not labels of a {clip.width}x{clip.height} picture")
    return labels
