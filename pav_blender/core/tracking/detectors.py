"""MediaPipe, an optional dependency: where faces are in a picture, and hands."""

from __future__ import annotations

import contextlib
import functools
import importlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from ..errors import InputError
from ..head import builtin_head
from ..reading import MIB, digest, read_bytes, stored_members

INSTALL = "`pip install mediapipe==0.10.21` (Python 3.9 to 3.12)"
_LARGEST_TASK = 256 * MIB
FACES, HANDS, HAND_POINTS = 4, 2, 21  # so many at most
_SAME_FACE = 0.1  # of a face's extent: mean distance of landmarks, seen both ways


class Face(NamedTuple):
    """landmarks float32 [478, 3] in [0, 1] of the (square) picture; scores [52] or None."""

    landmarks: np.ndarray
    scores: np.ndarray | None


class Detector(Protocol):
    """Finds faces in uint8 [S, S, 3]; score_names: of the scores, known after the first face."""

    score_names: tuple[str, ...]

    def __call__(self, rgb: np.ndarray) -> list[Face]: ...

    def close(self) -> None: ...


class HandDetector(Protocol):
    """Finds hands in uint8 [H, W, 3]: [n, 21, 2] in [0, 1] of the picture."""

    def __call__(self, rgb: np.ndarray) -> np.ndarray: ...

    def close(self) -> None: ...


def make_detector(task_file: Path | str | None = None) -> Detector:
    """The best detector this Python has, looking at every picture twice; with a `.task` file one
    that scores expressions too.

    Raises InputError where MediaPipe is missing, or carries no model and no file is given.
    """
    return BothWays(_one_way(task_file), _one_way(task_file))


def _one_way(task_file: Path | str | None) -> Detector:
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


_quiet = threading.Lock()
_hushed: list[int] = []  # what standard error was, once for each that is quiet now


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Drops what native code prints on standard error; MediaPipe has no switch for it. The first
    to come silences it for all threads, and the last to leave gives it back."""
    with _quiet:
        if _hushed:
            _hushed.append(_hushed[0])
        else:
            _hushed.append(_silenced())
    try:
        yield
    finally:
        with _quiet:
            saved = _hushed.pop()
            if not _hushed and saved >= 0:
                os.dup2(saved, 2)
                os.close(saved)


def _silenced() -> int:
    """Standard error's copy; -1 where there is none, as in some windowed programs."""
    try:
        saved = os.dup(2)
    except OSError:
        return -1
    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 2)
    os.close(sink)
    return saved


def _points(landmarks: Any) -> np.ndarray:
    return np.array([(point.x, point.y, point.z) for point in landmarks], np.float32)


def finds_hands() -> bool:
    """Whether `make_hand_detector` makes one."""
    return getattr(load_mediapipe(), "solutions", None) is not None


def make_hand_detector() -> HandDetector | None:
    """MediaPipe's hands, whose models lie in the 0.10 wheel; None where they do not."""
    return _Hands(load_mediapipe()) if finds_hands() else None


def detector_name(task_file: Path | str | None) -> str:
    """Tells what `make_detector` makes apart from what other versions and files make."""
    version = getattr(load_mediapipe(), "__version__", "unknown")
    if task_file is None or not Path(task_file).is_file():
        return f"both ways, mediapipe {version}"
    return f"both ways, mediapipe {version} {digest(task_file)}"


class _Hands:
    """`mp.solutions.hands`. It follows a hand from picture to picture: a hand that lies on a face
    is seldom found afresh, but seldom lost."""

    def __init__(self, mediapipe: Any) -> None:
        with quiet():
            self._hands = mediapipe.solutions.hands.Hands(
                static_image_mode=False, max_num_hands=HANDS, model_complexity=0
            )
            self._hands.process(np.zeros((64, 64, 3), np.uint8))

    def __call__(self, rgb: np.ndarray) -> np.ndarray:
        with quiet():
            found = self._hands.process(rgb).multi_hand_landmarks or []
        return np.stack([_points(hand.landmark)[:, :2] for hand in found]) if found else _NO_HANDS

    def close(self) -> None:
        with quiet():
            self._hands.close()


_NO_HANDS = np.zeros((0, HAND_POINTS, 2), np.float32)


class BothWays:
    """A detector's look at the picture and another's at its mirror image, in the mean: what the
    network gets wrong to one side it gets wrong to the other as well.

    The second has a detector of its own, for one may follow faces from picture to picture.
    """

    def __init__(self, plain: Detector, mirrored: Detector) -> None:
        self._plain, self._mirrored = plain, mirrored
        self.score_names: tuple[str, ...] = ()

    def __call__(self, rgb: np.ndarray) -> list[Face]:
        faces = self._plain(rgb)
        self.score_names = self._plain.score_names
        again = [
            self._turned_back(face) for face in self._mirrored(np.ascontiguousarray(rgb[:, ::-1]))
        ]
        return [_mean(face, again) for face in faces]

    def _turned_back(self, face: Face) -> Face:
        landmarks = face.landmarks[mirror_partners()] * np.array([-1, 1, 1], np.float32)
        landmarks[:, 0] += 1
        if face.scores is None:
            return Face(landmarks, None)
        names = self._mirrored.score_names
        return Face(landmarks, face.scores[[names.index(_other_side(n, names)) for n in names]])

    def close(self) -> None:
        self._plain.close()
        self._mirrored.close()


def _other_side(name: str, names: tuple[str, ...]) -> str:
    """mouthSmileLeft -> mouthSmileRight, jawLeft -> jawRight."""
    for one, other in (("Left", "Right"), ("Right", "Left")):
        if name.endswith(one) and name[: -len(one)] + other in names:
            return name[: -len(one)] + other
    return name


def _mean(face: Face, again: list[Face]) -> Face:
    """Of a face and the one among `again` that lies where it does; itself where none does."""
    if not again:
        return face
    places = face.landmarks[:, :2]
    apart = [float(np.abs(other.landmarks[:, :2] - places).mean()) for other in again]
    best = int(np.argmin(apart))
    if apart[best] > _SAME_FACE * float(np.ptp(places, axis=0).max()):
        return face
    other = again[best]
    scores = face.scores
    if scores is not None and other.scores is not None:
        scores = 0.5 * (scores + other.scores)
    return Face(0.5 * (face.landmarks + other.landmarks), scores)


@functools.cache
def mirror_partners() -> np.ndarray:
    """The landmark on the other side of the face for each, [478]; those of the middle are their
    own. MediaPipe's mesh is symmetric, and so is the built-in head that carries it."""
    head = builtin_head()
    places = np.asarray(head.landmarks(head.template.astype(np.float64)))
    apart = np.linalg.norm(places[:, None] - places[None] * (-1, 1, 1), axis=2)
    return apart.argmin(axis=1)


class _BundledDetector:
    """`mp.solutions.face_mesh`, whose models lie in the wheel; no expression scores."""

    score_names: tuple[str, ...] = ()

    def __init__(self, mediapipe: Any) -> None:
        with quiet():
            self._mesh = mediapipe.solutions.face_mesh.FaceMesh(
                static_image_mode=False, max_num_faces=FACES, refine_landmarks=True
            )
            # its threads start, and chatter, with the first picture
            self._mesh.process(np.zeros((64, 64, 3), np.uint8))

    def __call__(self, rgb: np.ndarray) -> list[Face]:
        with quiet():
            faces = self._mesh.process(rgb).multi_face_landmarks or []
        return [Face(_points(face.landmark), None) for face in faces]

    def close(self) -> None:
        with quiet():
            self._mesh.close()


class _TaskDetector:
    """The Tasks API with a face landmarker file: landmarks and 52 blend shape scores."""

    def __init__(self, mediapipe: Any, path: Path) -> None:
        content = read_task(path)
        vision = importlib.import_module("mediapipe.tasks.python.vision")
        base = importlib.import_module("mediapipe.tasks.python").BaseOptions
        self._image, self._format = mediapipe.Image, mediapipe.ImageFormat.SRGB
        self.score_names: tuple[str, ...] = ()
        try:
            with quiet():
                # every frame on its own: the video mode's smoothing lags behind lips and lids
                self._landmarker = vision.FaceLandmarker.create_from_options(
                    vision.FaceLandmarkerOptions(
                        base_options=base(model_asset_buffer=content),
                        running_mode=vision.RunningMode.IMAGE,
                        num_faces=FACES,
                        output_face_blendshapes=True,
                    )
                )
        except (RuntimeError, ValueError) as error:
            raise InputError(f"{path}: not a face landmarker model ({_line(error)})") from error

    def __call__(self, rgb: np.ndarray) -> list[Face]:
        with quiet():
            result = self._landmarker.detect(self._image(image_format=self._format, data=rgb))
        faces = []
        for index, points in enumerate(result.face_landmarks):
            shapes = result.face_blendshapes[index] if result.face_blendshapes else []
            shapes = [shape for shape in shapes if shape.category_name != "_neutral"]
            self.score_names = tuple(shape.category_name for shape in shapes)
            scores = np.array([shape.score for shape in shapes], np.float32) if shapes else None
            faces.append(Face(_points(points), scores))
        return faces

    def close(self) -> None:
        with quiet():
            self._landmarker.close()


def read_task(path: Path) -> bytes:
    """A `.task` file: an archive of models, stored as they are. MediaPipe's own code, which is
    not Python, is given nothing else. InputError for any other file."""
    if not path.is_file():
        raise InputError(f"{path}: no such landmark model file")
    content = read_bytes(path, _LARGEST_TASK)
    if not stored_members(path):
        raise InputError(f"{path}: not a face landmarker model (an archive of models as they are)")
    return content


def _line(error: Exception) -> str:
    return (str(error).splitlines() or ["no reason given"])[0]
