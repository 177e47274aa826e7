"""`pav import`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.progress import Progress

if TYPE_CHECKING:
    from ..core.collection.importers import ParsedClip
    from ..core.head import HeadModel

SUMMARY = (
    "Make a collection of what INSTA, metrical-tracker, VHAP, GaussianAvatars, IMavatar or "
    "FlashAvatar wrote; each source is an appearance of one person."
)
EXAMPLE = "pav import short=insta/me2019 long=imavatar/me2023 --head generic_model.pkl --out out/me"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "sources", nargs="*", metavar="SOURCE", help="folders, PATH or NAME=PATH (an appearance)"
    )
    parser.add_argument("--out", type=Path, help="the collection folder to write")
    parser.add_argument(
        "--head",
        type=Path,
        help="FLAME's model: a .pkl, a converted .npz, or a folder with one (or another head that "
        "was exported); remembered by its fingerprint, so that alone it makes a head known on this "
        "machine, and need not be named again",
    )
    parser.add_argument(
        "--format",
        default="auto",
        help="auto (the default), insta, vhap, imavatar, flashavatar, metrical or vhap-track",
    )
    parser.add_argument(
        "--shapes", default="mean", help="the identity all share: mean (the default) or first"
    )
    parser.add_argument(
        "--hold-out",
        type=int,
        metavar="N",
        help="test on the last N frames where nothing says so",
    )
    parser.add_argument(
        "--flame-version",
        default="",
        help="2020, 2023 or '2023 Open', if its name is silent",
    )
    parser.add_argument(
        "--tracked-with",
        default="",
        metavar="VERSION",
        help="the FLAME of the tracks, if not their tool's usual (2023 for VHAP, 2020 for others)",
    )
    parser.add_argument("--dry-run", action="store_true", help="say what would be written")
    parser.add_argument("--overwrite", action="store_true", help="replace an older collection")


def run(args: argparse.Namespace) -> int:
    from ..core.collection.importers import Person, normalise, read_sources, write_person
    from ..core.errors import InputError
    from ..core.head import remember_head

    if args.head is None and not args.sources:
        raise InputError("name sources to import, or with --head a head to remember")
    if args.sources and not (args.out or args.dry_run):
        raise InputError("--out is missing: the collection folder to write (or --dry-run)")
    if args.hold_out is not None and args.hold_out < 0:
        raise InputError(f"--hold-out {args.hold_out}: 0 or more")
    if args.out and args.out.exists() and not (args.overwrite or args.dry_run):
        raise InputError(f"{args.out}: exists already; choose another folder, or --overwrite")
    head = args.head and remember_head(args.head, flame_version=args.flame_version)
    parsed = []
    if args.sources:
        reading = Progress("read", as_json=args.json_progress)
        parsed = read_sources(args.sources, args.format, reading)
        head = head or _known(parsed, args.tracked_with)
    print(
        f"head: {head.name}, {len(head.expression_names)} expressions, "
        f"{len(head.landmark_triangles)} landmarks, fingerprint {head.fingerprint[:12]}\n"
        f"  {head.origin}"
    )
    if not args.sources:
        print("remembered; no sources were named")
        return 0
    person: Person = normalise(
        parsed,
        head,
        shapes=args.shapes,
        tracked_with=args.tracked_with,
        hold_out=args.hold_out,
        progress=Progress("fit", as_json=args.json_progress),
    )
    _say(person)
    if args.dry_run:
        print("nothing was written (--dry-run)")
        return 0
    write_person(
        person,
        args.out,
        overwrite=args.overwrite,
        progress=Progress("write", as_json=args.json_progress),
    )
    print(f"wrote {args.out}")
    return 0


def _known(parsed: list[ParsedClip], tracked_with: str) -> HeadModel:
    """The head that these clips need, where it was named once before."""
    from ..core.errors import InputError
    from ..core.head import remembered_head

    first = parsed[0]
    version = tracked_with or first.flame
    found = remembered_head("" if first.head else version, first.head)
    if found is None:
        what = "the head they were exported with" if first.head else f"FLAME {version}'s model"
        raise InputError(f"--head is missing: {what}, which these clips were tracked with")
    return found


def _say(person) -> None:  # type: ignore[no-untyped-def]
    for each in person.clips:
        clip = each.clip
        splits = ", ".join(
            f"{len(clip.indices(split))} {split}"
            for split in ("train", "test", "view")
            if len(clip.indices(split))
        )
        print(
            f"{clip.name} ({each.tool}): appearance {clip.appearance}, {len(clip)} frames of "
            f"{clip.width}x{clip.height} ({splits}); its shape is "
            f"{1000 * each.shape_distance:.2f} mm from the shared one"
        )
        if not each.has_matte:
            print("  warning: no matte; the background would be learned with the person")
        for note in each.notes:
            print(f"  {note}")
        if each.lost:
            print(f"  lost: {', '.join(each.lost)}")
        if each.skipped:
            shown = "; ".join(each.skipped[:3]) + ("; ..." if len(each.skipped) > 3 else "")
            print(f"  skipped {len(each.skipped)}: {shown}")
