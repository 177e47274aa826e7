"""A collection of clips of one person, on disk and in memory."""

from .model import LABELS, SPLITS, Clip, Collection
from .reader import read_collection
from .writer import CollectionWriter

__all__ = ["LABELS", "SPLITS", "Clip", "Collection", "CollectionWriter", "read_collection"]
