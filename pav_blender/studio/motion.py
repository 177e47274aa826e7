"""What the person does: smooth random expressions, speech, blinks, glances and head turns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from ..core.head import HeadModel

BLOCK = 60  # frames are planned in blocks of this many
FRAMES_PER_BEAT = 5.0  # a clip is watched at about 10 pictures a second

# One-sided names stand for both sides.
MOODS: tuple[dict[str, float], ...] = (
    {"mouthSmile": 0.75, "cheekSquint": 0.5, "eyeSquint": 0.2},
    {"mouthSmile": 0.55, "mouthUpperUp": 0.45, "mouthLowerDown": 0.35, "cheekSquint": 0.4,
     "jawOpen": 0.10},
    {"browInnerUp": 0.8, "browOuterUp": 0.75, "eyeWide": 0.6, "jawOpen": 0.25},
    {"browDown": 0.85, "noseSneer": 0.45, "mouthFrown": 0.45, "mouthPress": 0.4, "eyeSquint": 0.25},
    {"mouthFrown": 0.7, "browInnerUp": 0.6, "mouthShrugLower": 0.5},
    {"mouthPucker": 0.7, "mouthFunnel": 0.2},
    {"cheekPuff": 0.7, "mouthPress": 0.3},
    {"mouthLeft": 0.55, "mouthSmileLeft": 0.5, "browOuterUpLeft": 0.6},
    {"mouthRight": 0.5, "mouthSmileRight": 0.45, "browDownRight": 0.4},
    {"mouthStretch": 0.6, "mouthLowerDown": 0.5, "browInnerUp": 0.4, "eyeWide": 0.3},
    {"noseSneer": 0.7, "mouthUpperUp": 0.6, "browDown": 0.4, "eyeSquint": 0.5},
    {},
)  # fmt: skip
VISEMES = (
    {"jawOpen": 0.55, "mouthLowerDown": 0.2, "mouthUpperUp": 0.15},  # ah
    {"jawOpen": 0.22, "mouthStretch": 0.3, "mouthSmile": 0.25, "mouthLowerDown": 0.35,
     "mouthUpperUp": 0.3},  # ee
    {"jawOpen": 0.30, "mouthFunnel": 0.6},  # oh
    {"jawOpen": 0.12, "mouthPucker": 0.75},  # oo
    {"mouthPress": 0.5, "mouthClose": 0.05, "mouthRollLower": 0.25, "mouthRollUpper": 0.2},  # m
    {"jawOpen": 0.10, "mouthRollLower": 0.5, "mouthUpperUp": 0.35},  # f
    {"jawOpen": 0.16, "mouthLowerDown": 0.45, "mouthUpperUp": 0.35},  # s
    {"jawOpen": 0.80, "mouthStretch": 0.1},  # a wide one
)  # fmt: skip


@dataclass(eq=False)
class Motion:
    """Head parameters of F frames in the head model's terms."""

    expression: np.ndarray  # [F,E]
    pose: np.ndarray  # [F,J,3] axis-angle
    translation: np.ndarray  # [F,3] metres


def perform(head: HeadModel, frames: int, rng: np.random.Generator) -> Motion:
    """A performance of `frames` pictures; covers turns to both sides and a wide range of faces."""
    count = BLOCK * -(-frames // BLOCK)  # a shorter clip is the beginning of a longer one
    expression = np.zeros((count, len(head.expression_names)))
    for recipes, beat, gain in ((MOODS, 1.6, 1.0), (VISEMES, 0.7, 1.0)):
        for name, values in _speech(recipes, count, beat, rng).items():
            for channel in channels(head, name):
                expression[:, channel] += gain * values
    blink = _blinks(count, rng)
    for name in ("eyeBlinkLeft", "eyeBlinkRight"):
        _add(head, expression, name, blink)
    _add(head, expression, "eyeWideLeft", 0.18 * (1 - blink))
    _add(head, expression, "eyeWideRight", 0.18 * (1 - blink))

    yaw = _turns(count, rng, 35.0, 5.5)
    pitch = np.clip(5.5 * _drift(count, 5.0, rng), -13, 13)
    roll = np.clip(4.0 * _drift(count, 5.0, rng), -10, 10)
    gaze = np.stack([_glances(count, rng, 16.0, -0.25 * yaw), _glances(count, rng, 8.0, 0 * yaw)])
    _look(head, expression, gaze)

    pose = np.zeros((count, len(head.joint_names), 3))
    neck = head.joint_names.index("neck")
    pose[:, neck] = np.radians(np.stack([pitch, yaw, roll], axis=1))
    for name in ("left_eye", "right_eye"):  # the lids follow the expression, the eyes also dart
        eye = head.joint_names.index(name)
        pose[:, eye, 0] = np.radians(0.3 * gaze[1])
        pose[:, eye, 1] = np.radians(0.45 * gaze[0])
    body = np.stack([_drift(count, 8.0, rng) for _ in range(3)], axis=1)
    pose[:, 0] = np.radians(np.clip(body * [1.2, 2.2, 1.0], -5, 5))
    sway = np.stack([_drift(count, 8.0, rng) for _ in range(3)], axis=1)
    translation = np.clip(sway * [0.006, 0.003, 0.006], -0.016, 0.016)
    return Motion(
        np.clip(expression, 0, 1)[:frames].astype(np.float32),
        pose[:frames].astype(np.float32),
        translation[:frames].astype(np.float32),
    )


def channels(head: HeadModel, name: str) -> list[int]:
    """Indices of an expression, or of its Left and Right halves; empty where the head has none."""
    names = head.expression_names
    wanted = [name] if name in names else [f"{name}Left", f"{name}Right"]
    return [names.index(n) for n in wanted if n in names]


def _add(head: HeadModel, expression: np.ndarray, name: str, values: np.ndarray) -> None:
    for channel in channels(head, name):
        expression[:, channel] += values


def _speech(recipes, count: int, beat: float, rng) -> dict[str, np.ndarray]:
    """Curves through recipes, one a beat, each at a random strength; all have their turn."""
    step = beat * FRAMES_PER_BEAT
    keys = int(np.ceil(count / step)) + 2
    order = np.concatenate([rng.permutation(len(recipes)) for _ in range(keys // len(recipes) + 1)])
    times = np.arange(keys) * step + rng.uniform(-0.25, 0.25, keys) * step - 0.5 * step
    strength = rng.uniform(0.5, 1.0, keys)
    names = {name for recipe in recipes for name in recipe}
    moments = np.arange(count)
    curves = {}
    for name in sorted(names):
        values = [recipes[order[k]].get(name, 0.0) * strength[k] for k in range(keys)]
        curves[name] = PchipInterpolator(times, values, extrapolate=True)(moments)
    return curves


def _blinks(count: int, rng) -> np.ndarray:
    out = np.zeros(count)
    moment = rng.uniform(2, 8)
    while moment < count:
        distance = np.abs(np.arange(count) - moment)
        out = np.maximum(out, np.clip(1.25 - 0.55 * distance, 0, 1))
        moment += rng.uniform(7, 17)
    return out


def _drift(count: int, smooth: float, rng) -> np.ndarray:
    """Smooth noise of unit standard deviation."""
    raw = gaussian_filter1d(rng.standard_normal(count + 200), smooth)[100 : 100 + count]
    return raw * np.sqrt(2 * np.sqrt(np.pi) * smooth)


def _turns(count: int, rng, limit: float, beat: float) -> np.ndarray:
    """Degrees of yaw that sweep both sides: sorted into left, right and middle by turns."""
    keys = int(np.ceil(count / (beat * 1.3))) + 2
    sides = np.where(np.arange(keys) % 2 == rng.integers(2), 1.0, -1.0)
    size = rng.uniform(0.35, 0.95, keys)
    size[rng.permutation(keys)[: keys // 3]] = rng.uniform(0.75, 1.0, keys // 3)
    times = np.arange(keys) * beat * 1.3 - 2
    return limit * np.clip(PchipInterpolator(times, sides * size)(np.arange(count)), -1, 1)


def _glances(count: int, rng, limit: float, lean: np.ndarray) -> np.ndarray:
    """Degrees; the gaze rests for some pictures, then jumps."""
    out = np.zeros(count)
    moment = 0
    while moment < count:
        stay = int(rng.integers(3, 9))
        out[moment : moment + stay] = rng.normal(0, 0.38) * limit
        moment += stay
    return np.clip(out + lean, -limit, limit)


def _look(head: HeadModel, expression: np.ndarray, gaze: np.ndarray) -> None:
    """Half of the gaze as eyeLook expressions, which move the lids too (full: some 30 degrees)."""
    right, up = gaze[0] / 30, gaze[1] / 25  # positive yaw looks to the person's left
    for name, values in (
        ("eyeLookOutLeft", right), ("eyeLookInRight", right),
        ("eyeLookInLeft", -right), ("eyeLookOutRight", -right),
        ("eyeLookDownLeft", up), ("eyeLookDownRight", up),
        ("eyeLookUpLeft", -up), ("eyeLookUpRight", -up),
    ):  # fmt: skip
        _add(head, expression, name, 0.55 * np.clip(values, 0, 1))
