"""Measures how far the landmark detector's points lie from the built-in head's landmarks.

    python -m tools.measure_detector [COLLECTION ...] [--landmark-model FILE.task] [--out PATH]

The detector has a face of its own in mind: near the outline of a turned head, on lids and irises
its points lie millimetres off the surface, the same way for everybody, and it makes less of a nod
than there is. On studio collections, whose truth is known, the mean of that is found for each
landmark, in the head's frame, and how it grows with the side from which the head is seen; the two
sides of the face alike. `core.tracking` allows for it. Needs mediapipe==0.10.21. Several detectors
may be given; their means are averaged.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pav_blender.core.collection import Clip, Collection, read_collection
from pav_blender.core.images import read_rgba
from pav_blender.core.tracking.detectors import Detector, make_detector, mirror_partners
from pav_blender.core.tracking.landmark_model import OFFSETS_PATH, rotations, sides
from pav_blender.studio import DEFAULT_COLLECTION

_GREY = 0.45  # the background the pictures are laid on
# of a clip's say: keeps directions that no frame shows, and slopes, from running away
_STIFF, _STIFF_SLOPES = 0.01, 0.004


@dataclass(eq=False)
class Missed:
    """What a clip's F frames show: turns [F,3,3] of the head, sides [F,2] it is seen from, missed
    [F,L,2] metres to the right and up that the detector's points lie off the head's own."""

    turns: np.ndarray
    sides: np.ndarray
    missed: np.ndarray

    def mirrored(self) -> Missed:
        flip = np.diag([-1.0, 1.0, 1.0])
        return Missed(
            flip @ self.turns @ flip,
            self.sides * (-1, 1),
            self.missed[:, mirror_partners()] * (-1, 1),
        )

    def shown(self, offsets: np.ndarray) -> np.ndarray:
        """What `offsets` [3,L,3] make of `missed`, [F,L,2]."""
        whole = np.einsum("fk,klc->flc", _terms(self.sides), offsets)
        return np.einsum("fxc,flc->flx", self.turns[:, :2], whole)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("collections", nargs="*", type=Path, default=[DEFAULT_COLLECTION])
    parser.add_argument("--landmark-model", type=Path, help="measure this detector too")
    parser.add_argument("--out", type=Path, default=OFFSETS_PATH)
    arguments = parser.parse_args()
    found = []
    for path in arguments.collections:
        collection = read_collection(path)
        for clip in collection.clips:
            for model in dict.fromkeys((None, arguments.landmark_model)):
                detector = make_detector(model)
                found.append(missed_in(collection, clip, detector))
                detector.close()
    offsets = offsets_of(found)
    np.save(arguments.out, offsets.astype(np.float32))
    raw, left = ([1e3 * _size(m.missed - part) for m, part in zip(found, parts, strict=True)]
                 for parts in ([0.0] * len(found), [m.shown(offsets) for m in found]))  # fmt: skip
    print(f"{len(found)} clips: {np.mean(raw):.2f} mm off, {np.mean(left):.2f} with the offsets")
    return 0


def missed_in(collection: Collection, clip: Clip, detector: Detector) -> Missed:
    head = collection.head
    neck = head.joint_names.index("neck")
    upright = np.diag([1.0, -1.0, -1.0])
    turns, places, missed = [], [], []
    for row in clip.indices("train", "test"):
        rgba = read_rgba(collection.image_path(clip, int(row))).astype(np.float64) / 255
        rgb = rgba[..., :3] * rgba[..., 3:] + _GREY * (1 - rgba[..., 3:])
        found = detector((rgb * 255 + 0.5).astype(np.uint8))
        if not found:
            continue
        vertices = collection.posed(clip, np.array([row]))[0].astype(np.float64)
        camera = np.linalg.inv(clip.camera_to_world[row].astype(np.float64))
        turn = upright @ camera[:3, :3]
        own = np.asarray(head.landmarks(vertices)) @ turn.T + upright @ camera[:3, 3]
        focal = clip.intrinsics[row][[0, 1], [0, 1]] * (1, -1)
        pixels = own[:, :2] / -own[:, 2:] * focal + clip.intrinsics[row][:2, 2]
        apart = found[0].landmarks[:, :2] * (clip.width, clip.height) - pixels
        pose = clip.pose[row].astype(np.float64)
        turns.append(turn @ rotations(pose[0]) @ rotations(pose[neck]))
        places.append(own)
        missed.append(apart / focal * -own[:, 2:])
    whole = np.stack(turns)
    return Missed(whole, sides(whole, np.stack(places)), np.stack(missed))


def offsets_of(found: list[Missed]) -> np.ndarray:
    """[3,L,3] metres in the head's frame: from the front, and by each of the two sides; every clip
    has the same say, and so has its mirror image."""
    size = 3 * _terms(np.zeros((1, 2))).shape[1]
    stiff = np.repeat([_STIFF, _STIFF_SLOPES, _STIFF_SLOPES], 3) * len(found)
    matrix, right = np.diag(stiff), np.zeros((size, found[0].missed.shape[1]))
    for seen in (part for one in found for part in (one, one.mirrored())):
        both = np.einsum("fk,fxc->fxkc", _terms(seen.sides), seen.turns[:, :2])
        both = both.reshape(-1, size) / np.sqrt(len(seen.turns))
        matrix += both.T @ both
        right += (
            both.T
            @ (np.swapaxes(seen.missed, 1, 2).reshape(len(both), -1))
            / np.sqrt(len(seen.turns))
        )
    return np.linalg.solve(matrix, right).T.reshape(-1, 3, 3).swapaxes(0, 1)


def _terms(seen_from: np.ndarray) -> np.ndarray:
    return np.concatenate([np.ones((len(seen_from), 1)), seen_from], axis=1)


def _size(missed: np.ndarray) -> float:
    return float(np.sqrt((missed**2).sum(axis=2).mean()))


if __name__ == "__main__":
    sys.exit(main())
