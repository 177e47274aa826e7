"""How far two folders of frames are apart, in steps of 255 of what is seen.

    python tools/compare_frames.py out/demo/real out/demo/pav

Frames go by their names (PNG); colours count by their alpha. Ends with 1 where the folders hold
other frames or sizes.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from pav_blender.core.images import read_rgba


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", type=Path, nargs=2)
    one, other = parser.parse_args().folders
    names = sorted(path.name for path in one.glob("*.png"))
    if not names or names != sorted(path.name for path in other.glob("*.png")):
        print(f"{one} and {other} do not hold the same frames", file=sys.stderr)
        return 1
    worst, above, values = 0, 0, 0
    for name in names:
        first, second = (read_rgba(folder / name).astype(float) for folder in (one, other))
        if first.shape != second.shape:
            print(f"{name}: {first.shape[:2]} and {second.shape[:2]} pixels", file=sys.stderr)
            return 1
        for picture in (first, second):
            picture[..., :3] *= picture[..., 3:] / 255
        apart = np.abs(first - second).round(6)
        worst, values = max(worst, apart.max()), values + apart.size
        above += int((apart > 1).sum())
    print(
        f"{len(names)} frames: {above} of {values:,} values more than 1 apart, at most {worst:.0f}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
