"""Video -> landmarks -> head geometry -> collection."""

from .command import EXAMPLE, HELP, add_arguments, run
from .track import TrackReport, track

__all__ = ["EXAMPLE", "HELP", "TrackReport", "add_arguments", "run", "track"]
