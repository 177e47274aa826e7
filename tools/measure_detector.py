"""Measures how far the landmark detector's points lie from the built-in head's landmarks.

    python -m tools.measure_detector [COLLECTION ...] [--landmark-model FILE.task] [--out PATH]

The detector has a face of its own in mind: near the outline of a turned head, on lids and irises
its points lie millimetres off the surface, the same way for everybody. On a studio collection,
whose truth is known, the mean of that is found for each landmark, in the head's frame, the two
sides of the face alike; `core.tracking` adds it to the landmarks. Needs mediapipe==0.10.21. Several
detectors may be given; their means are averaged.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from pav_blender.core.collection import Clip, Collection, read_collection
from pav_blender.core.head import HeadModel
from pav_blender.core.images import read_rgba
from pav_blender.core.tracking.detectors import Detector, make_detector
from pav_blender.core.tracking.landmark_model import OFFSETS_PATH, rotations
from pav_blender.studio import DEFAULT_COLLECTION

_GREY = 0.45  # the background the pictures are laid on
_STIFF = 0.05  # of a frame's say: keeps directions no frame shows from running away


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("collections", nargs="*", type=Path, default=[DEFAULT_COLLECTION])
    parser.add_argument("--landmark-model", type=Path, help="measure this detector too")
    parser.add_argument("--out", type=Path, default=OFFSETS_PATH)
    arguments = parser.parse_args()
    offsets = []
    for path in arguments.collections:
        collection = read_collection(path)
        for clip in collection.clips:
            for model in dict.fromkeys((None, arguments.landmark_model)):
                detector = make_detector(model)
                found = clip_offsets(collection, clip, detector)
                detector.close()
                print(f"{path} {clip.name}: {1e3 * np.linalg.norm(found, axis=1).mean():.2f} mm")
                offsets.append(found)
    mean = symmetric(collection.head, np.mean(offsets, axis=0))
    spread = np.linalg.norm(np.array(offsets) - mean, axis=2).mean()
    size = np.linalg.norm(mean, axis=1).mean()
    print(f"mean {1e3 * size:.2f} mm, clips differ from it by {1e3 * spread:.2f} mm")
    np.save(arguments.out, mean.astype(np.float32))
    return 0


def clip_offsets(collection: Collection, clip: Clip, detector: Detector) -> np.ndarray:
    """Mean offset of detections from the head's landmarks, [L,3] metres in the head's frame."""
    head = collection.head
    neck = head.joint_names.index("neck")
    matrix = np.zeros((head.landmark_triangles.size, 3, 3))
    right = np.zeros((head.landmark_triangles.size, 3))
    for row in clip.indices("train", "test"):
        rgba = read_rgba(collection.image_path(clip, int(row))).astype(np.float64) / 255
        rgb = rgba[..., :3] * rgba[..., 3:] + _GREY * (1 - rgba[..., 3:])
        found = detector((rgb * 255 + 0.5).astype(np.uint8))
        if found is None:
            continue
        vertices = collection.posed(clip, np.array([row]))[0].astype(np.float64)
        points = np.asarray(head.landmarks(vertices))
        camera = np.linalg.inv(clip.camera_to_world[row].astype(np.float64))
        own = points @ camera[:3, :3].T + camera[:3, 3]
        focal = clip.intrinsics[row][[0, 1], [0, 1]]
        pixels = own[:, :2] / own[:, 2:] * focal + clip.intrinsics[row][:2, 2]
        missed = (np.asarray(found[0])[:, :2] * clip.width - pixels) / focal * own[:, 2:]
        pose = clip.pose[row].astype(np.float64)
        axes = (camera[:3, :3] @ rotations(pose[0]) @ rotations(pose[neck]))[:2]
        matrix += axes.T @ axes + _STIFF * np.eye(3)
        right += missed @ axes
    return np.linalg.solve(matrix, right[..., None])[..., 0]


def symmetric(head: HeadModel, offsets: np.ndarray) -> np.ndarray:
    """Offsets averaged with their mirror images, of each landmark's partner across the face."""
    places = head.landmarks(head.template.astype(np.float64))
    apart = np.linalg.norm(places[:, None] - places[None] * (-1, 1, 1), axis=2)
    partner = linear_sum_assignment(apart)[1]
    return 0.5 * (offsets + offsets[partner] * (-1, 1, 1))


if __name__ == "__main__":
    sys.exit(main())
