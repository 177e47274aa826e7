"""Corrections of the track that are found while the avatar learns.

At two points of the schedule it is decided anew, for each clip, whether they help: some frames are
kept from training until then, and corrected by the pixels of half their blocks; the other half says
what that is worth. From then on each frame drawn is corrected once before it is learned from.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ..collection import Clip, Collection
from ..rendering.render import Scene
from . import corrections as fix
from .frames import Frame, face_depth
from .refine import Sight, choose_pixels, correct, look
from .trainer import Trainer

ROUNDS = (0.4, 0.7)  # parts of the schedule; pictures are whole from the first on
_KEPT_OUT = 12  # one training frame in so many is kept out to judge by,
_MOST_KEPT_OUT = 4  # of a clip
_FEWEST = 4  # training frames of a clip; of fewer none can be spared
_GAIN = 0.3  # dB that a kind of correction must be worth; right tracks gain less, for nothing
_PIXELS = 800
_BLOCK = 16  # pixels: what lies side by side tells the same
OFF, POSE, EXPRESSION = "off", "pose", "pose and expression"


@dataclass
class Verdict:
    """Of a clip: dB on pixels no correction was found from, as tracked, with the pose corrected
    and with expressions as well (None: not tried); which of OFF, POSE, EXPRESSION is kept."""

    kept: str = OFF
    tracked: float | None = None
    pose: float | None = None
    expression: float | None = None

    def decide(self) -> None:
        self.kept = OFF
        if self.tracked is not None and self.pose is not None:
            best = self.tracked
            for kind, value in ((POSE, self.pose), (EXPRESSION, self.expression)):
                if value is not None and value >= best + _GAIN:
                    self.kept, best = kind, value


def kept_out(collection: Collection, frames: list[Frame]) -> set[str]:
    """Names of the training frames to judge by, spread over each clip."""
    names: set[str] = set()
    for clip in collection.clips:
        own = [
            frame.name
            for frame in frames
            if frame.name.rpartition("/")[0] == clip.name and _is_person(frame.rgba).any()
        ]
        if len(own) >= _FEWEST:
            count = min(max(1, len(own) // _KEPT_OUT), _MOST_KEPT_OUT)
            at = (np.arange(count) + 0.5) * len(own) / count
            names |= {own[int(i)] for i in at}
    return names


class Refiner:
    """Corrects the frames of a training; `trainer` has those of `frames` not in `kept_out`."""

    def __init__(
        self, collection: Collection, frames: list[Frame], held: set[str], trainer: Trainer
    ) -> None:
        self.collection, self.trainer = collection, trainer
        self.space = fix.space_of(collection)
        self.round = 0
        self.verdicts = {clip.name: Verdict() for clip in collection.clips}
        self.known: dict[str, tuple[np.ndarray, int]] = {}
        self._tracked = {frame.name: frame for frame in frames}
        self._held = [frame for frame in frames if frame.name in held]
        self._corrected: dict[str, Frame] = {}
        self._rows = {
            f"{clip.name}/{number:06d}": (clip, row)
            for clip in collection.clips
            for row, number in enumerate(clip.frame_id)
        }

    def advance(self, done: float) -> None:
        """Begins the next round where the schedule is there: judges, and decides for each clip."""
        if self.round < len(ROUNDS) and done >= ROUNDS[self.round]:
            self.round += 1
            for name, verdict in self.verdicts.items():
                self._judge(name, verdict)
                verdict.decide()
            if self.round == len(ROUNDS):
                self.trainer.learn_from(self._held)

    def __call__(self, frame: Frame) -> Frame:
        """The frame as it is to be learned from, of a whole picture."""
        if self.round == 0 or self._kind(frame.name) == OFF:
            return frame
        if self.known.get(frame.name, (None, 0))[1] < self.round:
            self.known[frame.name] = self._correction(frame), self.round
            self._take(frame.name)
        return self._corrected[frame.name]

    def corrections(self, clip: Clip) -> dict[int, np.ndarray]:
        """Those of a clip that are in use, {row: [6 + K]}."""
        if self.verdicts[clip.name].kept == OFF:
            return {}
        named = {row: f"{clip.name}/{number:06d}" for row, number in enumerate(clip.frame_id)}
        return {row: self.known[name][0] for row, name in named.items() if name in self.known}

    def correct_all(self, frames: Iterable[Frame]) -> Iterator[str]:
        """Corrects frames of any split by the avatar as it is now; yields their names."""
        for frame in frames:
            if self._kind(frame.name) != OFF:
                self.known[frame.name] = self._correction(frame), self.round
                self._corrected.pop(frame.name, None)
            yield frame.name

    def record(self) -> dict[str, Any]:
        """What came of it, a clip: dB, whether kept, and how large the corrections are."""
        return {clip.name: self._summary(clip) for clip in self.collection.clips}

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """What an interrupted training must keep: tensors, and what JSON takes."""
        tensors = {name: torch.from_numpy(value) for name, (value, _) in self.known.items()}
        header = {
            "round": self.round,
            "rounds": {name: number for name, (_, number) in self.known.items()},
            "verdicts": {n: dataclasses.asdict(v) for n, v in self.verdicts.items()},
        }
        return tensors, header

    def restore(self, tensors: dict[str, torch.Tensor], header: dict[str, Any]) -> None:
        self.round = int(header["round"])
        self.verdicts = {n: Verdict(**values) for n, values in header["verdicts"].items()}
        self.known = {
            name: (tensors[name].numpy().copy(), int(number))
            for name, number in header["rounds"].items()
        }
        for name in self.known:
            self._take(name)
        if self.round == len(ROUNDS):
            self.trainer.learn_from(self._held)

    def _kind(self, name: str) -> str:
        return self.verdicts[name.rpartition("/")[0]].kept

    def _middle(self, frame: Frame) -> np.ndarray:
        return fix.middle_of(frame.vertices, self.trainer.avatar.rigid_weights)

    def _changes(self, name: str) -> np.ndarray | None:
        clip, row = self._rows[name]
        if clip.vertices is not None or len(self.space) == fix.RIGID:
            return None
        return fix.mesh_changes(self.collection, clip, row, self.space)

    def _bent(self, frame: Frame, correction: np.ndarray) -> Frame:
        """The frame with its expressions corrected; frame: as tracked."""
        if not correction[fix.RIGID :].any():
            return frame
        clip, row = self._rows[frame.name]
        mesh = fix.corrected_mesh(self.collection, clip, row, self.space, correction)
        return dataclasses.replace(frame, vertices=mesh[0], expression=mesh[1])

    def _random(self, name: str) -> np.random.Generator:
        """The same for a frame and a round, whatever was drawn before."""
        seed = self.trainer.config.seed
        return np.random.default_rng([seed, self.round, zlib.crc32(name.encode())])

    def _correction(self, frame: Frame) -> np.ndarray:
        """The frame's correction by the avatar as it is; frame: as tracked."""
        nothing = np.zeros(len(self.space))
        start = self.known.get(frame.name, (nothing, 0))[0].copy()
        kind = self._kind(frame.name)
        if kind == POSE:
            start[fix.RIGID :] = 0
        sight = choose_pixels(frame.rgba, frame.camera, _PIXELS, self._random(frame.name))
        changes = self._changes(frame.name) if kind == EXPRESSION else None
        scene = self.trainer.scene(self._bent(frame, start))
        arguments = self._middle(frame), self.space, changes, frame.expression
        return correct(scene, sight, start, *arguments)

    def _take(self, name: str) -> None:
        """Makes the corrected frame of a known correction."""
        tracked, correction = self._tracked[name], self.known[name][0]
        frame = self._bent(tracked, correction)
        motion = fix.motion(correction, self._middle(tracked))
        camera = fix.seen_from(tracked.camera, motion)
        depth = face_depth(self.collection, tracked.rgba, frame.vertices, camera)
        self._corrected[name] = dataclasses.replace(frame, camera=camera, depth=depth)

    def _judge(self, clip: str, verdict: Verdict) -> None:
        held = [frame for frame in self._held if frame.name.rpartition("/")[0] == clip]
        if not held:
            return
        errors = np.array([self._errors(frame) for frame in held])  # [N, 3]
        values = -10 * np.log10(np.maximum(errors.mean(0), 1e-10))
        verdict.tracked, verdict.pose = float(values[0]), float(values[1])
        verdict.expression = float(values[2]) if np.isfinite(values[2]) else None

    def _errors(self, frame: Frame) -> tuple[float, float, float]:
        """Mean squared errors of a frame as tracked, corrected in pose, and in expression too
        (nan: it can't be), on pixels that the corrections were not found from."""
        random = self._random(frame.name)
        blocks = random.random(
            (-(-frame.camera.height // _BLOCK), -(-frame.camera.width // _BLOCK))
        )
        found_from = blocks < np.median(blocks)
        sight = choose_pixels(frame.rgba, frame.camera, 2 * _PIXELS, random)
        mine = found_from[sight.rows // _BLOCK, sight.columns // _BLOCK]
        judged = _head_pixels(frame, ~found_from, random)
        middle, nothing = self._middle(frame), np.zeros(len(self.space))
        scene = self.trainer.scene(frame)

        def error(scene: Scene, correction: np.ndarray) -> float:
            return float(((look(scene, judged, correction, middle) - judged.colours) ** 2).mean())

        arguments = scene, sight.part(mine), nothing, middle, self.space
        moved = correct(*arguments, None, frame.expression)
        tracked, pose = error(scene, nothing), error(scene, moved)
        changes = self._changes(frame.name)
        if changes is None:
            return tracked, pose, np.nan
        bent = correct(*arguments, changes, frame.expression)
        return tracked, pose, error(self.trainer.scene(self._bent(frame, bent)), bent)

    def _summary(self, clip: Clip) -> dict[str, Any]:
        verdict = self.verdicts[clip.name]
        found = self.corrections(clip)
        values = np.array([found[row] for row in sorted(found)]).reshape(-1, len(self.space))
        out: dict[str, Any] = {"kept": verdict.kept}
        for name in ("tracked", "pose", "expression"):
            value = getattr(verdict, name)
            out[f"psnr_{name}"] = None if value is None else round(value, 2)
        out["frames"] = len(values)
        if len(values):
            out["degrees"] = round(float(np.degrees(_length(values[:, :3]))), 3)
            out["millimetres"] = round(float(1e3 * _length(values[:, 3 : fix.RIGID])), 3)
        return out


def _is_person(rgba: np.ndarray) -> np.ndarray:
    return rgba[..., 3] > 127


def _length(vectors: np.ndarray) -> float:
    return float(np.linalg.norm(vectors, axis=1).mean())


def _head_pixels(frame: Frame, blocks: np.ndarray, random: np.random.Generator) -> Sight:
    """Some of the person's pixels in blocks [h, w] bool, drawn evenly."""
    rows, columns = np.nonzero(_is_person(frame.rgba))
    inside = np.flatnonzero(blocks[rows // _BLOCK, columns // _BLOCK])
    if not len(inside):  # a person of a block or less
        inside = np.arange(len(rows))
    chosen = np.sort(random.permutation(inside)[: 2 * _PIXELS])
    colours = frame.rgba[rows[chosen], columns[chosen]].astype(np.float64) / 255
    colours[:, :3] *= colours[:, 3:]
    return Sight(frame.camera, columns[chosen], rows[chosen], colours)
