"""`pav studio`."""

from ..studio import add_arguments, run

SUMMARY = "Render a collection of clips of one synthetic person in several appearances (Cycles)."
EXAMPLE = "pav studio out/collection --appearances 3 --frames 60 --size 256 --seed 0"

__all__ = ["EXAMPLE", "SUMMARY", "add_arguments", "run"]
