"""A collection of clips of one person, on disk and in memory."""

from .labels import read_labels
from .model import LABELS, SPLITS, Clip, Collection
from .reader import read_collection
from .relative import identity_distance, relative_clip
from .writer import CollectionWriter

__all__ = [
    "LABELS",
    "SPLITS",
    "Clip",
    "Collection",
    "CollectionWriter",
    "identity_distance",
    "read_collection",
    "read_labels",
    "relative_clip",
]
