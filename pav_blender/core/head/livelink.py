"""Recordings of the app Live Link Face: a CSV of ARKit's blend shapes, a row a frame.

The file (seen in recordings): `Timecode,BlendShapeCount,EyeBlinkLeft,...`, 52 shapes in CamelCase,
then yaw, pitch and roll of the head, the left and the right eye in radians. A timecode is
HH:MM:SS:FF.sub, its frames counted at 60 a second even where every second one is kept; frames are
missing where the phone dropped them.

In the recordings the angles are the mirror image of the shapes beside them: while EyeLookOutLeft
and EyeLookInRight rise (the eyes go to the person's left), LeftEyeYaw and RightEyeYaw fall; pitch
rises as the eyes go down; the roll has the sign that goes with a mirrored yaw. So a rotation is
R = Ry(-yaw) . Rx(pitch) . Rz(-roll) in the core's axes, and the eyes change sides. For the head,
whose angles no shape confirms, the same convention is taken.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..reading import MIB, file_size, first_line

_SIDED = [
    "browDown", "browOuterUp", "cheekSquint", "eyeBlink", "eyeLookDown", "eyeLookIn",
    "eyeLookOut", "eyeLookUp", "eyeSquint", "eyeWide", "mouthDimple", "mouthFrown",
    "mouthLowerDown", "mouthPress", "mouthSmile", "mouthStretch", "mouthUpperUp", "noseSneer",
]  # fmt: skip
_SINGLE = [
    "browInnerUp", "cheekPuff", "jawForward", "jawLeft", "jawOpen", "jawRight", "mouthClose",
    "mouthFunnel", "mouthLeft", "mouthPucker", "mouthRight", "mouthRollLower", "mouthRollUpper",
    "mouthShrugLower", "mouthShrugUpper", "tongueOut",
]  # fmt: skip
ARKIT_NAMES = tuple(sorted([n + s for n in _SIDED for s in ("Left", "Right")] + _SINGLE))
_OPTIONAL = "tongueOut"  # the app's first versions had none
_ROTATED = ("Head", "LeftEye", "RightEye")
_ANGLES = ("Yaw", "Pitch", "Roll")
_TIMECODE = re.compile(r"(\d{1,2}):(\d{1,2}):(\d{1,2})[:;](\d{1,3}(?:\.\d+)?)")
_RATES = (24, 25, 30, 48, 50, 60)
_DAY = 24 * 3600.0
_LONGEST = 1_000_000  # frames
_LARGEST, _MOST_COLUMNS = 512 * MIB, 1000


@dataclass(frozen=True, eq=False)
class Take:
    """F recorded frames: seconds [F] from the first, rising; shapes: [F] by ARKit's name; angles:
    yaw, pitch, roll [F, 3] in radians, as recorded, of "Head", "LeftEye" and "RightEye", or
    nothing where the file has none."""

    seconds: np.ndarray
    shapes: dict[str, np.ndarray]
    angles: dict[str, np.ndarray]


def read_take(path: Path | str, timecode_rate: float = 0.0) -> Take:
    """Reads a recording. timecode_rate: frames a second of its timecodes, 0: told from them.

    Raises InputError naming the file, the line and the fault.
    """
    path = Path(path)
    lines = _lines(path)
    header = next(lines, None)
    if header is None:
        raise InputError(f"{path}: the file is empty")
    columns = _columns(path, header)
    stamps, values = [], []
    for number, cells in enumerate(lines, start=2):
        row = _row(f"{path}, line {number}", cells, columns)
        if row is not None:
            stamps.append((number, row[0], row[1]))
            values.append(np.array(row[2]))
    if not values:
        raise InputError(f"{path}: no frame in it holds a face")
    table = np.array(values).reshape(len(values), len(columns))
    by_name = dict(zip(columns, table.T, strict=True))
    shapes = {name: by_name[name] for name in ARKIT_NAMES if name in by_name}
    angles = {
        part: np.stack([by_name[part + angle] for angle in _ANGLES], 1)
        for part in _ROTATED
        if part + _ANGLES[0] in by_name
    }
    return Take(_seconds(path, stamps, timecode_rate), shapes, angles)


def resample(take: Take, fps: float) -> Take:
    """The take at `fps` frames a second from its first frame on; in between, and where frames were
    dropped, values go straight."""
    if not fps > 0:
        raise InputError(f"a frame rate of {fps}: above 0")
    count = int(np.floor(take.seconds[-1] * fps + 1e-6)) + 1
    if count > _LONGEST:
        raise InputError(f"the recording would be {count} frames long; at most {_LONGEST}")
    at = np.arange(count) / fps
    shapes = {name: np.interp(at, take.seconds, row) for name, row in take.shapes.items()}
    angles = {}
    for part, row in take.angles.items():
        unwrapped = np.unwrap(row, axis=0)
        angles[part] = np.stack([np.interp(at, take.seconds, a) for a in unwrapped.T], 1)
    return Take(at, shapes, angles)


def expression_of(take: Take, names: tuple[str, ...]) -> np.ndarray:
    """Coefficients [F, E] of a head's expressions; those that the take lacks are 0. InputError
    where the head has none of ARKit's."""
    if not set(names) & set(take.shapes):
        raise InputError(
            "the head has none of ARKit's expressions (jawOpen, eyeBlinkLeft, ...), which a Live "
            "Link Face recording moves; use a head that has them, as the built-in one, or a track"
        )
    still = np.zeros(len(take.seconds))
    return np.stack([take.shapes.get(name, still) for name in names], 1)


def pose_of(take: Take, names: tuple[str, ...], joints: tuple[str, ...]) -> np.ndarray:
    """Axis-angle [F, J, 3] of a head's joints: the head's turn goes to "neck", the eyes' to
    "left_eye" and "right_eye", but where one of the expressions `names` turns them already."""
    pose = np.zeros((len(take.seconds), len(joints), 3))
    sources = {"neck": "Head"}
    if not any(name.startswith("eyeLook") for name in names):
        sources |= {"left_eye": "RightEye", "right_eye": "LeftEye"}  # the mirror changes sides
    for joint, part in sources.items():
        if joint in joints and part in take.angles:
            pose[:, joints.index(joint)] = _turns(take.angles[part])
    return pose


def _turns(angles: np.ndarray) -> np.ndarray:
    """Recorded yaw, pitch, roll [F, 3] -> axis-angle [F, 3]; see the module's head."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("YXZ", angles * (-1, 1, -1)).as_rotvec()


def _lines(path: Path) -> Iterator[list[str]]:
    """The cells of each line in turn; InputError where there is no such file, or no text in it."""
    file_size(path, _LARGEST)
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            yield from csv.reader(stream, strict=True)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not readable as a CSV file ({error})") from error


def _columns(path: Path, header: list[str]) -> list[str]:
    """Names of the columns after the first two: ARKit's spelling, and that of the angles."""
    if len(header) > _MOST_COLUMNS:
        raise InputError(f"{path}: {len(header)} columns, which no such recording has")
    names = [name.strip() for name in header]
    if [name.lower() for name in names[:2]] != ["timecode", "blendshapecount"]:
        raise InputError(
            f"{path}: not a recording of Live Link Face: its first line begins with "
            f"{','.join(names[:2])!r:.80}, not 'Timecode,BlendShapeCount'"
        )
    known = {name.lower(): name for name in ARKIT_NAMES}
    known |= {(part + a).lower(): part + a for part in _ROTATED for a in _ANGLES}
    columns = [known.get(name.lower(), name) for name in names[2:]]
    twice = next((name for name in columns if columns.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"{path}: the column {twice!r:.80} is there twice")
    lacking = [n for n in ARKIT_NAMES if n not in columns and n != _OPTIONAL]
    for part in _ROTATED:
        there = [part + angle in columns for angle in _ANGLES]
        if any(there) and not all(there):
            lacking.append(part + _ANGLES[there.index(False)])
    if lacking:
        raise InputError(f"{path}: the column {lacking[0]!r} is missing")
    return columns


def _row(
    where: str, cells: list[str], columns: list[str]
) -> tuple[float, float, list[float]] | None:
    """Seconds, frames, and the values of a line; None for one without a face."""
    if not any(cell.strip() for cell in cells):
        return None
    match = _TIMECODE.fullmatch(cells[0].strip())
    if match is None or int(match[2]) > 59 or int(match[3]) > 59:
        raise InputError(f"{where}: {cells[0]!r:.80} is no timecode HH:MM:SS:FF")
    if len(cells) > 1 and cells[1].strip() == "0":
        return None
    if len(cells) != len(columns) + 2:
        raise InputError(f"{where}: {len(cells)} values; the first line names {len(columns) + 2}")
    try:
        values = [float(cell) for cell in cells[2:]]
    except ValueError as error:
        raise InputError(f"{where}: {first_line(error)}") from error
    bad = next((n for n, v in zip(columns, values, strict=True) if not np.isfinite(v)), None)
    if bad is not None:
        raise InputError(f"{where}: {bad} is not finite")
    return int(match[1]) * 3600.0 + int(match[2]) * 60 + int(match[3]), float(match[4]), values


def _seconds(path: Path, stamps: list[tuple[int, float, float]], rate: float) -> np.ndarray:
    """Seconds [F] since the first of stamps (line, seconds, frames)."""
    whole = np.array([stamp[1] for stamp in stamps])
    frames = np.array([stamp[2] for stamp in stamps])
    if rate == 0.0:
        rate = _rate_of(path, whole, frames)
    if frames.max() >= rate:
        line = stamps[int(frames.argmax())][0]
        raise InputError(f"{path}, line {line}: frame {frames.max():g} at {rate:g} a second")
    seconds = whole + frames / rate
    # past midnight the clock begins again
    seconds += _DAY * np.cumsum(np.concatenate([[0], np.diff(seconds) < -_DAY / 2]))
    late = np.flatnonzero(np.diff(seconds) <= 0)
    if len(late):
        raise InputError(f"{path}, line {stamps[late[0] + 1][0]}: its timecode does not rise")
    return seconds - seconds[0]


def _rate_of(path: Path, whole: np.ndarray, frames: np.ndarray) -> float:
    """The lowest usual rate that the frames fit; the app's 60 for takes too short to tell."""
    if len(np.unique(whole)) < 3:
        return 60.0
    fitting = [rate for rate in _RATES if frames.max() < rate]
    if not fitting:
        raise InputError(f"{path}: a timecode with frame {frames.max():g}; say its frame rate")
    return float(fitting[0])
