"""What layers can do: appearances blended, and regions that wear another's hair, beard or clothes.

    python tools/show_looks.py out/demo/avatar.pav --track out/demo/motion:performance \\
        --out looks.png

Row 1: the first appearance turning into the second. Row 2: the first three appearances, each with
the hair, the beard and the clothes of the others in turn. Prints what one and two appearances cost.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from pav_blender.bridge.looks import Layer, worn
from pav_blender.core.errors import InputError, PavError
from pav_blender.core.evaluation.metrics import over
from pav_blender.core.evaluation.sheet import grid
from pav_blender.core.field.avatar import Avatar, head_of
from pav_blender.core.field.identities import identity
from pav_blender.core.head.areas import area
from pav_blender.core.images import write_rgba
from pav_blender.core.rendering.cameras import Camera
from pav_blender.core.rendering.render import render
from pav_blender.core.rendering.sequence import parse_frames, parse_track, posed_avatar

GREY = 0.8
REPEATS = 5


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("avatar", type=Path)
    parser.add_argument("--track", required=True, metavar="COLLECTION:CLIP")
    parser.add_argument("--frame", default="6", help="frame number (default 6)")
    parser.add_argument("--size", type=int, default=256, help="pixels a side of a picture")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.png")
    args = parser.parse_args()
    try:
        write_rgba(args.out, show(args))
    except PavError as error:
        print(f"show_looks: {error}", file=sys.stderr)
        return 2
    return 0


def show(args: argparse.Namespace) -> np.ndarray:
    avatar = Avatar.load(args.avatar)
    if len(avatar.appearances) < 3:
        raise InputError(f"{args.avatar}: three appearances are needed")
    collection, clip = parse_track(args.track)
    row = parse_frames(args.frame, clip)[:1]
    who = identity(avatar, avatar.appearances[0])
    posed = posed_avatar(who, collection, clip, row)[0]
    camera = Camera(clip.width, clip.height, clip.intrinsics[row[0]], clip.camera_to_world[row[0]])
    camera = camera.resized(args.size, args.size)

    def picture(base: str, *layers: Layer) -> np.ndarray:
        shown = render(
            avatar, posed, camera, worn(base, layers), expression=clip.expression[row[0]]
        )
        return over(shown.rgba, GREY)

    def seconds(*layers: Layer) -> float:
        spent = []
        for _ in range(REPEATS):
            begun = time.perf_counter()
            picture(a, *layers)
            spent.append(time.perf_counter() - begun)
        return min(spent)

    head = head_of(avatar, avatar.appearances[0])
    rest = head.shaped(who.betas)
    hair, beard, clothes = (area(name, rest, head.regions) for name in ("hair", "beard", "clothes"))
    a, b, c = avatar.appearances[:3]
    blends = [picture(a, Layer(b, weight, None)) for weight in (0.0, 0.25, 0.5, 0.75, 1.0)]
    regions = [
        picture(a, Layer(c, 1.0, hair)),
        picture(c, Layer(a, 1.0, beard)),
        picture(a, Layer(c, 1.0, clothes)),
        picture(c, Layer(a, 1.0, beard), Layer(b, 1.0, hair)),
        picture(b, Layer(a, 1.0, beard), Layer(c, 1.0, clothes)),
    ]
    print(
        f"{args.size} x {args.size} pixels, least of {REPEATS}: one appearance {seconds():.2f} s, "
        f"half of another {seconds(Layer(b, 0.5, None)):.2f} s, another's hair "
        f"{seconds(Layer(c, 1.0, hair)):.2f} s"
    )
    return grid([blends, regions])


if __name__ == "__main__":
    sys.exit(main())
