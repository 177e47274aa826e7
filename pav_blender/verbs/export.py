"""`pav export`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ..core.progress import Progress

SUMMARY = (
    "Write a collection in another tool's layout, or its posed meshes; an avatar in half the size."
)
EXAMPLE = "pav export out/collection --to insta --out out/insta"

DATASETS = ("insta", "vhap")
MESHES = ("obj", "ply")
ANIMATED = ("abc", "usd")
SMALLER = "half"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "collection",
        metavar="COLLECTION[:CLIP]",
        help="folder of the collection, and one of its clips (default: all); of half an avatar "
        "(.pav)",
    )
    parser.add_argument(
        "--to",
        required=True,
        choices=(*DATASETS, *MESHES, *ANIMATED, SMALLER),
        help="insta, vhap: a folder a clip; obj, ply: a mesh a frame; abc, usd: one animated file "
        "with the clip's camera (Blender); half: an avatar with two bytes a number instead of four",
    )
    parser.add_argument(
        "--out", type=Path, required=True, help="new folder; of abc, usd and half a file"
    )
    parser.add_argument("--fps", type=float, default=25.0, help="of abc and usd (default 25)")


def run(args: argparse.Namespace) -> int:
    from ..core.exporting import export_insta, export_meshes, export_vhap

    if args.to == SMALLER:
        return _halved(Path(args.collection), args.out)
    collection, clips = _chosen(args.collection)
    progress = Progress("export", as_json=args.json_progress)
    if args.to in ANIMATED:
        return _animated(args, collection, clips)
    if args.to in DATASETS:
        write = export_insta if args.to == "insta" else export_vhap
        count = write(collection, clips, args.out, progress=progress)
    else:
        count = export_meshes(collection, clips, args.out, args.to, progress=progress)
    for clip in clips:
        splits = ", ".join(f"{len(clip.indices(s))} {s}" for s in dict.fromkeys(clip.split))
        print(f"{args.out / clip.name}: {len(clip)} frames ({splits})")
    print(f"{args.out}: {count} frames")
    return 0


def _halved(source: Path, out: Path) -> int:
    from ..core.errors import InputError
    from ..core.field.avatar import Avatar

    for path in (source, out):
        if path.suffix != ".pav":
            raise InputError(f"{path}: --to {SMALLER} takes an avatar file and writes one (.pav)")
    avatar = Avatar.load(source)
    before = source.stat().st_size
    avatar.save(out, half=True)
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB, {source} has {before / 1e6:.1f}")
    return 0


def _chosen(text: str) -> tuple[Any, list[Any]]:
    """ "FOLDER" -> the collection and all its clips; "FOLDER:CLIP" -> that one."""
    from ..core.collection import read_collection
    from ..core.rendering.sequence import parse_track

    if Path(text).exists() or ":" not in text:
        collection = read_collection(text)
        return collection, collection.clips
    collection, clip = parse_track(text)
    return collection, [clip]


def _animated(args: argparse.Namespace, collection: Any, clips: list[Any]) -> int:
    from ..bridge.exchange import export_animated
    from ..core.errors import InputError

    if len(clips) > 1:
        names = ", ".join(clip.name for clip in clips)
        raise InputError(f"--to {args.to} takes one clip: write COLLECTION:CLIP, of {names}")
    first, last = export_animated(collection, clips[0], args.out, args.to, args.fps)
    print(f"{args.out}: clip {clips[0].name}, frames {first} to {last}, {args.fps:g} a second")
    return 0
