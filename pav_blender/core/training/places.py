"""What lies beside an avatar that is being trained. Readable without torch."""

from __future__ import annotations

import math
from pathlib import Path

from ..errors import InputError
from ..reading import read_json

PICTURE, CURVE = "preview.png", "curve.json"
COLUMNS = ("iteration", "seconds", "loss", "psnr")  # of the curve's rows


def checkpoint_path(avatar_path: Path) -> Path:
    """Where the checkpoint of an avatar being trained lies: beside it."""
    return avatar_path.with_suffix(".checkpoint")


def read_curve(folder: Path | str) -> list[tuple[float, ...]]:
    """Rows of COLUMNS of a training so far; empty where there is no curve, or none that fits."""
    try:
        content = read_json(Path(folder) / CURVE)
        rows = [tuple(float(value) for value in row) for row in content["rows"]]
    except (InputError, ValueError, KeyError, TypeError, OverflowError):
        return []
    return [row for row in rows if len(row) == len(COLUMNS) and all(map(math.isfinite, row))]
