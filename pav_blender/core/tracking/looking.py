"""From sources to shots: what is seen, whose face it is, where it was cut, what is of use."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..errors import InputError
from . import detectors, people, sift
from .cache import Cache, key_of
from .crop import Crop, content_box, plan_crop
from .decode import Source
from .observe import Observations, Sightings, observe
from .shots import cut_into_shots
from .spread import spread

# a shot with fewer frames of use teaches nothing that is worth an identity of its own
SHORTEST = 10
_BORDER_SAMPLES = 32


@dataclass(eq=False)
class Shot:
    """A run of one source's frames without a cut, which becomes a clip.

    seen: the frames that are used; crop: a window for each of them; left_out: numbers of frames
    by reason; not_chosen: how many more could have been used.
    """

    source: Source
    name: str
    appearance: str
    every: int
    seen: Observations
    crop: Crop
    left_out: dict[str, list[int]]
    not_chosen: int


@dataclass(frozen=True, eq=False)
class Take:
    """A source, what is seen in every `every`-th of its frames, and what its clips are called."""

    source: Source
    seen: Sightings
    every: int
    name: str
    appearance: str


@dataclass(eq=False)
class Looked:
    """shots: those that are used; skipped: a dict for each that is not (video, first, last,
    reason, left_out); warnings: one line each."""

    shots: list[Shot] = field(default_factory=list)
    skipped: list[dict] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def sight(
    source: Source,
    every: int,
    model: Path | str | None,
    cache: Cache,
    tell: Callable[[int], None],
    should_stop: Callable[[], bool] | None,
) -> Sightings:
    """See `observe`: with MediaPipe's detectors, and a key of everything that matters."""
    return observe(
        source,
        every,
        lambda: (detectors.make_detector(model), detectors.make_hand_detector()),
        cache=cache,
        key=key_of("seen", source.fingerprint(), every, detectors.detector_name(model)),
        tell=tell,
        should_stop=should_stop,
    )


def choose_shots(takes: Sequence[Take], most: int | None, *, cuts: bool = True) -> Looked:
    """The shots of all sources that show the person, each with the frames that are used.

    most: frames a shot. Raises InputError where a source has nothing of use.
    """
    looked = Looked()
    runs = [_runs(take.seen, cuts) for take in takes]
    faces = [
        face
        for number, take in enumerate(takes)
        for shot, rows in enumerate(runs[number])
        for face in people.follow(take.seen, number, shot, rows)
    ]
    person, absent = people.choose(faces)
    for number in absent:
        looked.warnings.append(
            f"{takes[number].source.path}: no face in it resembles that of the other clips; its "
            "largest is used, see `pav check`"
        )
        person += people.choose([face for face in faces if face.source == number])[0]
    for number, take in enumerate(takes):
        mine = [face for face in person if face.source == number]
        others = {other.name for other in takes} | {shot.name for shot in looked.shots}
        _add_shots(looked, take, runs[number], mine, others, most)
    return looked


def _runs(seen: Sightings, cuts: bool) -> list[np.ndarray]:
    whole = [np.arange(len(seen.frame_id))]
    return cut_into_shots(seen) if cuts else whole


def _add_shots(
    looked: Looked,
    take: Take,
    runs: list[np.ndarray],
    person: list[people.Face],
    taken: set[str],
    most: int | None,
) -> None:
    source, seen = take.source, take.seen
    usable = [_usable(seen, rows, person, shot) for shot, rows in enumerate(runs)]
    long_enough = [len(faces) >= SHORTEST or len(runs) == 1 for faces, _ in usable]
    if not any(long_enough) and len(runs) > 1:
        looked.warnings.append(
            f"{source.path}: no shot has {SHORTEST} frames of use; it is taken as one clip, which "
            "suits single photographs only"
        )
        runs = [np.arange(len(seen.frame_id))]
        usable = [_merged(usable)]
        long_enough = [True]
    count, made = sum(long_enough), 0
    for rows, (faces, left_out), used in zip(runs, usable, long_enough, strict=True):
        if not used:
            looked.skipped.append(
                {
                    "video": source.path.name,
                    "first": int(seen.frame_id[rows[0]]),
                    "last": int(seen.frame_id[rows[-1]]),
                    "reason": _main_reason(left_out, len(rows)),
                    "left_out": left_out,
                }
            )
            continue
        if len(faces) == 0:
            raise InputError(
                f"{source.path}: none of its frames can be used "
                f"({', '.join(f'{len(v)} {k}' for k, v in left_out.items())})"
            )
        name = take.name
        while count > 1 and name in taken:  # another source may be called NAME_2
            made += 1
            name = f"{take.name}_{made}"
        looked.shots.append(_shot(take, faces, left_out, name, most))


def _usable(
    seen: Sightings, rows: np.ndarray, person: list[people.Face], shot: int
) -> tuple[np.ndarray, dict[str, list[int]]]:
    mine = [face.faces for face in person if face.shot == shot]
    faces = np.sort(np.concatenate(mine)) if mine else np.zeros(0, int)
    return sift.sift(seen, rows, faces)


def _merged(
    usable: list[tuple[np.ndarray, dict[str, list[int]]]],
) -> tuple[np.ndarray, dict[str, list[int]]]:
    left_out: dict[str, list[int]] = {}
    for _, reasons in usable:
        for reason, numbers in reasons.items():
            left_out.setdefault(reason, []).extend(numbers)
    return np.concatenate([faces for faces, _ in usable]), left_out


def _main_reason(left_out: dict[str, list[int]], frames: int) -> str:
    """What most of a shot's frames are left out for; else that it is short."""
    reason = max(left_out, key=lambda key: len(left_out[key]), default=sift.SHORT_SHOT)
    return reason if len(left_out.get(reason, ())) > frames / 2 else sift.SHORT_SHOT


def _shot(
    take: Take, faces: np.ndarray, left_out: dict[str, list[int]], name: str, most: int | None
) -> Shot:
    seen = take.seen
    usable = seen.observations(faces)
    used = usable.subset(spread(usable, most))
    some = slice(None, None, max(1, len(seen.tall) // _BORDER_SAMPLES))
    box = content_box(seen.tall[some], seen.wide[some])
    crop = plan_crop(used, box, str(take.source.path))
    more = len(usable) - len(used)
    return Shot(take.source, name, take.appearance, take.every, used, crop, left_out, more)
