"""What several people in one avatar cost: each learned alone, and all together.

Trains an avatar of each person, one of both with the same iterations (so half as many a person),
and one of both with as many a person. Prints head PSNR of held-out frames, and writes a picture: a
row an appearance; filmed, alone, together, together for as long a person.

    python tools/show_identities.py anna=DIR ben=DIR --iterations 600 --work out/identities \
        --out docs/pictures/identities.png
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from pav_blender.core.collection import Collection
from pav_blender.core.config import Config
from pav_blender.core.errors import PavError
from pav_blender.core.evaluation.heldout import Score, held_out
from pav_blender.core.evaluation.metrics import over
from pav_blender.core.evaluation.sheet import grid
from pav_blender.core.field.avatar import Avatar
from pav_blender.core.files import write_text
from pav_blender.core.images import write_rgba
from pav_blender.core.progress import Progress
from pav_blender.core.training.people import People, parse_people, read_people
from pav_blender.core.training.train import fingerprint, train

ALONE, TOGETHER, AS_LONG = "alone", "together", "together, as long a person"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("people", nargs="+", metavar="NAME=COLLECTION")
    parser.add_argument("--iterations", type=int, default=600, help="of one person alone (600)")
    parser.add_argument("--work", type=Path, required=True, metavar="DIR", help="for the avatars")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.png")
    args = parser.parse_args()
    try:
        people = read_people(parse_people(args.people))
        args.work.mkdir(parents=True, exist_ok=True)
        found = measured(people, args.iterations, args.work)
    except PavError as error:
        print(f"show_identities: {error}", file=sys.stderr)
        return 2
    write_rgba(args.out, sheet(found))
    figures = {
        name: {way: _mean(scores) for way, scores in ways.items()} for name, ways in found.items()
    }
    means = {way: _mean([s for ways in found.values() for s in ways[way]]) for way in _ways(found)}
    print(f"head PSNR of held-out frames, dB, {args.iterations} iterations alone")
    for name, row in {**figures, "mean": means}.items():
        print(f"  {name:12}" + "  ".join(f"{way} {value:.2f}" for way, value in row.items()))
    content = {"iterations": args.iterations, "head_psnr": figures, "mean": means}
    write_text(args.work / "identities.json", json.dumps(content, indent=1) + "\n")
    return 0


def measured(people: People, iterations: int, work: Path) -> dict[str, dict[str, list[Score]]]:
    """Scores of each person's held-out frames by [person][way]."""
    count = len(people.collections)
    both = {
        TOGETHER: trained(people, iterations, work / "together.pav"),
        AS_LONG: trained(people, iterations * count, work / "together_as_long.pav"),
    }
    return {
        name: {
            way: held_out(avatar, own)
            for way, avatar in {
                ALONE: trained(own, iterations, work / f"{name}.pav"),
                **both,
            }.items()
        }
        for name, own in people.collections.items()
    }


def trained(source: Collection | People, iterations: int, path: Path) -> Avatar:
    """The avatar of so many iterations, trained unless it is there already."""
    if path.is_file():
        avatar = Avatar.load(path)
        known: Any = avatar.record.get("collection"), avatar.config.iterations
        if known == (fingerprint(source), iterations):
            return avatar
    config = dataclasses.replace(Config(), iterations=iterations)
    return train(source, path, config, progress=Progress(path.stem))


def sheet(found: dict[str, dict[str, list[Score]]]) -> np.ndarray:
    rows = []
    for ways in found.values():
        looks = dict.fromkeys(score.frame.appearance for score in ways[ALONE])
        for look in looks:
            at = [i for i, s in enumerate(ways[ALONE]) if s.frame.appearance == look]
            middle = at[len(at) // 2]
            truth = over(ways[ALONE][middle].frame.rgba / 255, 1)
            rows.append([truth, *(over(scores[middle].rendered, 1) for scores in ways.values())])
    return grid(rows)


def _ways(found: dict[str, dict[str, list[Score]]]) -> list[str]:
    return list(next(iter(found.values())))


def _mean(scores: list[Score]) -> float:
    return round(float(np.mean([score.head_psnr for score in scores])), 2)


if __name__ == "__main__":
    sys.exit(main())
