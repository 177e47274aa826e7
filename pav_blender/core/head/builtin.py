"""The head that comes with the project (CC0; see ``data/ORIGIN.md``)."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from .files import read_head
from .model import HeadModel

BUILTIN = "builtin"
BUILTIN_PATH = Path(__file__).parent / "data" / "builtin_head.npz"


@lru_cache(maxsize=1)
def builtin_head() -> HeadModel:
    """The built-in head; read once."""
    return read_head(BUILTIN_PATH)
