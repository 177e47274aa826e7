"""`pav track`."""

from ..core.tracking import add_arguments, run

SUMMARY = "Make a collection from videos of one person: landmarks, matte, head geometry."
EXAMPLE = "pav track a.mp4 b.mp4 --out out/collection"

__all__ = ["EXAMPLE", "SUMMARY", "add_arguments", "run"]
