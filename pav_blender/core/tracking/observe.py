"""Facial landmarks of a video's frames, by MediaPipe, which is an optional dependency."""

from __future__ import annotations

import contextlib
import importlib
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ..errors import Cancelled, InputError
from .decode import Frame

LANDMARKS = 478
INSTALL = "`pip install mediapipe==0.10.21` (Python 3.9 to 3.12)"


@dataclass(eq=False)
class Observations:
    """What was seen in the F frames that show a face.

    landmarks [F, 478, 3] float32 pixels of the source frame (x right, y down from the top left
    corner; z relative, same scale, smaller is nearer); scores [F, 52] float32 in [0, 1] or None;
    score_names: the scores' ARKit names; frame_id [F] int32; missing: numbers of the frames
    without a face; width, height: of the source frame.
    """

    landmarks: np.ndarray
    scores: np.ndarray | None
    score_names: tuple[str, ...]
    frame_id: np.ndarray
    missing: list[int]
    width: int
    height: int

    def __len__(self) -> int:
        return len(self.frame_id)

    def subset(self, rows: np.ndarray) -> Observations:
        """The frames at `rows` only; the others count as missing."""
        left_out = np.setdiff1d(np.arange(len(self)), rows)
        return Observations(
            self.landmarks[rows],
            None if self.scores is None else self.scores[rows],
            self.score_names,
            self.frame_id[rows],
            sorted([*self.missing, *self.frame_id[left_out].tolist()]),
            self.width,
            self.height,
        )


class Detector(Protocol):
    """Finds a face: uint8 [H, W, 3] -> landmarks [478, 3] in [0, 1] of the picture, and scores."""

    score_names: tuple[str, ...]

    def __call__(self, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray | None] | None: ...

    def close(self) -> None: ...


def observe(
    frames: Iterable[Frame],
    detector: Detector,
    *,
    name: str,
    on_frame: Callable[[Frame], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Observations:
    """Runs `detector` over the frames. Raises InputError naming the video if no face is in it."""
    found, scores, ids, missing = [], [], [], []
    height = width = 0
    for frame in frames:
        if should_stop is not None and should_stop():
            raise Cancelled("tracking stopped; nothing was written")
        height, width = frame.rgb.shape[:2]
        side = max(height, width)
        # the landmark model's region maths holds for square pictures only
        square = np.zeros((side, side, 3), np.uint8)
        square[:height, :width] = frame.rgb
        result = detector(square)
        if result is None or not np.isfinite(result[0]).all():
            missing.append(frame.number)
        else:
            found.append(result[0] * side)
            scores.append(result[1])
            ids.append(frame.number)
        if on_frame is not None:
            on_frame(frame)
    if not found:
        raise InputError(
            f"{name}: no face was found in any of its {len(missing)} frames; "
            "use a video in which the face is visible"
        )
    scored = detector.score_names and all(row is not None for row in scores)
    return Observations(
        np.asarray(found, np.float32),
        np.asarray(scores, np.float32) if scored else None,
        detector.score_names if scored else (),
        np.asarray(ids, np.int32),
        missing,
        width,
        height,
    )


def make_detector(task_file: Path | str | None = None) -> Detector:
    """The best detector this Python has; with a `.task` file one that scores expressions too.

    Raises InputError where MediaPipe is missing, or carries no model and no file is given.
    """
    mediapipe = load_mediapipe()
    if task_file is not None:
        return _TaskDetector(mediapipe, Path(task_file))
    if getattr(mediapipe, "solutions", None) is None:
        raise InputError(
            f"mediapipe {mediapipe.__version__} carries no face model: give one with "
            f"--landmark-model face_landmarker.task, or {INSTALL}"
        )
    return _BundledDetector(mediapipe)


def load_mediapipe() -> Any:
    """Imports MediaPipe quietly. Raises InputError with what to install where it is absent."""
    os.environ.setdefault("GLOG_minloglevel", "2")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    try:
        with quiet():
            return importlib.import_module("mediapipe")
    except ImportError as error:
        raise InputError(f"tracking needs MediaPipe, which is missing: {INSTALL}") from error


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Drops what native code prints on standard error; MediaPipe has no switch for it."""
    try:
        saved = os.dup(2)
    except OSError:  # no standard error, as in some windowed programs
        yield
        return
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(sink)


def _points(landmarks: Any) -> np.ndarray:
    return np.array([(point.x, point.y, point.z) for point in landmarks], np.float32)


class _BundledDetector:
    """`mp.solutions.face_mesh`, whose models lie in the wheel; no expression scores."""

    score_names: tuple[str, ...] = ()

    def __init__(self, mediapipe: Any) -> None:
        with quiet():
            self._mesh = mediapipe.solutions.face_mesh.FaceMesh(
                static_image_mode=False, max_num_faces=1, refine_landmarks=True
            )
            # its threads start, and chatter, with the first picture
            self._mesh.process(np.zeros((64, 64, 3), np.uint8))

    def __call__(self, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray | None] | None:
        with quiet():
            faces = self._mesh.process(rgb).multi_face_landmarks
        return (_points(faces[0].landmark), None) if faces else None

    def close(self) -> None:
        with quiet():
            self._mesh.close()


class _TaskDetector:
    """The Tasks API with a face landmarker file: landmarks and 52 blend shape scores."""

    def __init__(self, mediapipe: Any, path: Path) -> None:
        if not path.is_file():
            raise InputError(f"{path}: no such landmark model file")
        vision = importlib.import_module("mediapipe.tasks.python.vision")
        base = importlib.import_module("mediapipe.tasks.python").BaseOptions
        self._image, self._format = mediapipe.Image, mediapipe.ImageFormat.SRGB
        self.score_names: tuple[str, ...] = ()
        try:
            with quiet():
                # every frame on its own: the video mode's smoothing lags behind lips and lids
                self._landmarker = vision.FaceLandmarker.create_from_options(
                    vision.FaceLandmarkerOptions(
                        base_options=base(model_asset_buffer=path.read_bytes()),
                        running_mode=vision.RunningMode.IMAGE,
                        num_faces=1,
                        output_face_blendshapes=True,
                    )
                )
        except (RuntimeError, ValueError) as error:
            raise InputError(f"{path}: not a face landmarker model ({_line(error)})") from error

    def __call__(self, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray | None] | None:
        with quiet():
            result = self._landmarker.detect(self._image(image_format=self._format, data=rgb))
        if not result.face_landmarks:
            return None
        shapes = result.face_blendshapes[0] if result.face_blendshapes else []
        shapes = [shape for shape in shapes if shape.category_name != "_neutral"]
        self.score_names = tuple(shape.category_name for shape in shapes)
        scores = np.array([shape.score for shape in shapes], np.float32) if shapes else None
        return _points(result.face_landmarks[0]), scores

    def close(self) -> None:
        with quiet():
            self._landmarker.close()


def _line(error: Exception) -> str:
    return (str(error).splitlines() or ["no reason given"])[0]
