"""The synthetic person: Cycles films a head in several appearances and writes a collection."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..core.errors import InputError
from ..core.progress import Progress

__all__ = ["DEFAULT_COLLECTION", "add_arguments", "render_collection", "run"]

# what `render_collection` gave by default; only beside the sources, not in an extension
DEFAULT_COLLECTION = Path(__file__).parents[2] / "data" / "studio3"


def render_collection(out, **options) -> Path:
    """See :func:`pav_blender.studio.render.render_collection`; raises InputError without bpy."""
    try:
        import bpy  # noqa: F401
    except ImportError as error:
        raise InputError(
            "the studio renders with Blender: run it inside Blender or `pip install bpy`"
        ) from error
    from .render import render_collection as render

    return render(Path(out), **options)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `pav studio`."""
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the new collection")
    parser.add_argument("--appearances", type=int, default=3, help="clips, one a look (1-5)")
    parser.add_argument("--first", type=int, default=1, help="number of the first look (1)")
    parser.add_argument("--frames", type=int, default=60, help="pictures a clip")
    parser.add_argument("--size", type=int, default=256, help="pixels a side")
    parser.add_argument("--seed", type=int, default=0, help="who it is and what they do")
    parser.add_argument(
        "--performance",
        type=int,
        default=0,
        metavar="N",
        help="another performance before another camera: poses no other has",
    )
    parser.add_argument("--truth", choices=("full", "light"), default="full",
                        help="full: also depth and posed vertices")  # fmt: skip
    parser.add_argument(
        "--samples", type=int, metavar="N", help="of a pixel, for less noise (16; large: 24)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace a collection there")


def run(args: argparse.Namespace) -> int:
    """`pav studio`: renders the collection, progress on stderr; returns the exit code."""
    render_collection(
        args.out, appearances=args.appearances, frames=args.frames, size=args.size,
        seed=args.seed, performance=args.performance, truth=args.truth, overwrite=args.overwrite,
        progress=Progress("studio", as_json=args.json_progress), first=args.first,
        samples=args.samples,
    )  # fmt: skip
    print(args.out)
    return 0
