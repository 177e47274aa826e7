"""`pav scene`."""

from ..bridge.scene import add_arguments, run

SUMMARY = "Build a .blend: the avatar's head on a track, its camera, our render engine."
EXAMPLE = "pav scene out/avatar.pav --track out/collection:grey --out out/avatar.blend"

__all__ = ["EXAMPLE", "SUMMARY", "add_arguments", "run"]
