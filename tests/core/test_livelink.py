"""Recordings of Live Link Face."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pav_blender.core.errors import InputError
from pav_blender.core.head import builtin_head
from pav_blender.core.head.livelink import (
    ARKIT_NAMES,
    expression_of,
    pose_of,
    read_take,
    resample,
)

ANGLES = [p + a for p in ("Head", "LeftEye", "RightEye") for a in ("Yaw", "Pitch", "Roll")]
COLUMNS = [name[0].upper() + name[1:] for name in ARKIT_NAMES] + ANGLES
HEADER = ",".join(["Timecode", "BlendShapeCount", *COLUMNS])


def row(timecode, values=None, **named):
    table = dict.fromkeys(COLUMNS, 0.0) | named
    cells = [f"{v:.10f}" for v in (table.values() if values is None else values)]
    return ",".join([timecode, str(len(cells)), *cells])


def write(path, *rows, header=HEADER):
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def test_the_names_are_those_of_the_builtin_head():
    assert set(ARKIT_NAMES) == set(builtin_head().expression_names)


def test_reads_shapes_angles_and_times(tmp_path):
    path = write(
        tmp_path / "take.csv",
        row("12:24:59:57.960", JawOpen=0.25, HeadYaw=0.1, HeadPitch=0.2, HeadRoll=0.3),
        row("12:24:59:59.960", JawOpen=0.5),
        "12:25:00:01.960,0",  # no face
        row("12:25:00:05.960", JawOpen=1.0),
    )
    take = read_take(path)
    np.testing.assert_allclose(take.seconds, np.array([0, 2, 8]) / 60, atol=1e-9)
    np.testing.assert_allclose(take.shapes["jawOpen"], [0.25, 0.5, 1])
    np.testing.assert_allclose(take.angles["Head"][0], [0.1, 0.2, 0.3])
    even = resample(take, 30)
    # two dropped frames between the second and the last
    np.testing.assert_allclose(even.shapes["jawOpen"], np.array([0.25, 0.5, 2 / 3, 5 / 6, 1]))


def test_expressions_go_by_name_and_the_angles_are_mirrored(tmp_path):
    path = write(
        tmp_path / "take.csv",
        row("00:00:00:00.0", TongueOut=0.5, HeadYaw=-0.2, LeftEyeYaw=-0.1, RightEyePitch=0.3),
        row("00:00:00:01.0", HeadPitch=0.4),
        row("00:00:00:02.0", HeadRoll=0.4),
    )
    head = builtin_head()
    take = read_take(path)
    expression = expression_of(take, head.expression_names)
    assert expression[0, head.expression_names.index("tongueOut")] == 0.5
    assert expression.sum() == 0.5
    neck, left, right = (head.joint_names.index(n) for n in ("neck", "left_eye", "right_eye"))
    # the built-in head's eyes are turned by its expressions
    pose = pose_of(take, head.expression_names, head.joint_names)
    np.testing.assert_allclose(pose[0, neck], [0, 0.2, 0], atol=1e-12)  # to the person's left
    np.testing.assert_allclose(pose[1, neck], [0.4, 0, 0], atol=1e-12)  # down
    np.testing.assert_allclose(pose[2, neck], [0, 0, -0.4], atol=1e-12)
    assert not pose[:, [left, right]].any()
    pose = pose_of(take, ("jawOpen",), head.joint_names)
    np.testing.assert_allclose(pose[0, right], [0, 0.1, 0], atol=1e-12)  # sides change
    np.testing.assert_allclose(pose[0, left], [0.3, 0, 0], atol=1e-12)


def test_yaw_is_outermost(tmp_path):
    from scipy.spatial.transform import Rotation

    path = write(tmp_path / "take.csv", row("0:0:0:0", HeadYaw=0.5, HeadPitch=-0.3, HeadRoll=0.2))
    pose = pose_of(read_take(path), ("jawOpen",), ("root", "neck"))[0, 1]
    y, x, z = (Rotation.from_rotvec(v) for v in ((0, -0.5, 0), (-0.3, 0, 0), (0, 0, -0.2)))
    np.testing.assert_allclose(pose, (y * x * z).as_rotvec(), atol=1e-12)


def test_a_head_without_arkits_names_is_refused(tmp_path):
    take = read_take(write(tmp_path / "take.csv", row("0:0:0:0")))
    with pytest.raises(InputError, match="none of ARKit's expressions"):
        expression_of(take, ("exp_000", "exp_001"))


def test_midnight_and_the_rate_of_timecodes(tmp_path):
    path = write(tmp_path / "take.csv", row("23:59:59:59"), row("00:00:00:00"))
    np.testing.assert_allclose(read_take(path).seconds, [0, 1 / 60])
    rows = [row(f"00:00:{i // 24:02d}:{i % 24:02d}") for i in range(72)]
    path = write(tmp_path / "slow.csv", *rows)
    np.testing.assert_allclose(read_take(path).seconds, np.arange(72) / 24)
    np.testing.assert_allclose(read_take(path, 48).seconds[:3], np.arange(3) / 48)


def test_angles_may_be_absent_and_the_header_may_begin_with_a_mark(tmp_path):
    shapes = COLUMNS[:52]
    header = "\ufeff" + ",".join(["Timecode", "BlendshapeCount", *shapes])
    path = write(tmp_path / "take.csv", row("0:0:0:0", [0.5] * 52), header=header)
    take = read_take(path)
    assert take.angles == {}
    assert not pose_of(take, ("jawOpen",), ("root", "neck")).any()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], "the file is empty"),
        (["a,b,c", "1,2,3"], "not a recording of Live Link Face"),
        ([HEADER], "no frame in it holds a face"),
        ([HEADER.replace(",JawOpen", ""), ""], "the column 'jawOpen' is missing"),
        ([HEADER.replace(",HeadRoll", ""), ""], "the column 'HeadRoll' is missing"),
        ([HEADER.replace("JawLeft", "JawOpen"), ""], "'jawOpen' is there twice"),
        ([HEADER, row("12:00")], "line 2: '12:00' is no timecode"),
        ([HEADER, row("12:75:00:00")], "no timecode"),
        ([HEADER, row("0:0:0:0")[:-20]], "line 2"),
        ([HEADER, row("0:0:0:0"), row("0:0:0:1", [0.0] * 10)], "line 3: 12 values"),
        ([HEADER, row("0:0:0:0").replace("0.0000000000", "x", 1)], "line 2: could not convert"),
        ([HEADER, row("0:0:0:0", JawOpen=float("nan"))], "jawOpen is not finite"),
        ([HEADER, row("0:0:0:5"), row("0:0:0:4")], "line 3: its timecode does not rise"),
        ([HEADER, row("0:0:0:75")], "line 2: frame 75 at 60 a second"),
    ],
)
def test_damage_is_told_in_one_line(tmp_path, lines, message):
    path = tmp_path / "take.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_take(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_file_and_no_text_are_told(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_take(tmp_path / "gone.csv")
    (tmp_path / "binary.csv").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="not readable as a CSV"):
        read_take(tmp_path / "binary.csv")
    take = read_take(write(tmp_path / "take.csv", row("0:0:0:0")))
    with pytest.raises(InputError, match="above 0"):
        resample(take, 0)


@settings(max_examples=60, deadline=None)
@given(
    gaps=st.lists(st.integers(1, 40), min_size=0, max_size=30),
    start=st.integers(0, 24 * 3600 * 60 - 1),
    values=st.lists(st.floats(-1, 1), min_size=61, max_size=61),
)
def test_what_was_written_is_read(tmp_path_factory, gaps, start, values):
    ticks = start + np.concatenate([[0], np.cumsum(gaps)]).astype(int)

    def timecode(tick):
        second, frame = divmod(int(tick), 60)
        minute, second = divmod(second, 60)
        return f"{minute // 60 % 24:02d}:{minute % 60:02d}:{second:02d}:{frame:02d}.000"

    path = tmp_path_factory.mktemp("take") / "take.csv"
    take = read_take(write(path, *(row(timecode(t), values) for t in ticks)), 60)
    np.testing.assert_allclose(take.seconds, (ticks - start) / 60, atol=1e-7)
    found = [take.shapes[name][0] for name in ARKIT_NAMES]
    np.testing.assert_allclose(found, values[:52], atol=1e-9)
    again = resample(take, 60)
    assert len(again.seconds) == ticks[-1] - start + 1
    np.testing.assert_allclose(again.shapes["jawOpen"], take.shapes["jawOpen"][0], atol=1e-9)


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_any_damage_is_an_input_error_or_harmless(tmp_path_factory, data):
    text = "\n".join([HEADER, row("0:0:0:0"), row("0:0:0:1", JawOpen=0.5)]).encode()
    at = data.draw(st.integers(0, len(text)))
    length = data.draw(st.integers(0, 30))
    text = text[:at] + data.draw(st.binary(max_size=12)) + text[at + length :]
    path = tmp_path_factory.mktemp("torn") / "take.csv"
    path.write_bytes(text)
    try:
        take = read_take(path)
    except InputError as error:
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert (np.diff(take.seconds) > 0).all()
        assert all(np.isfinite(v).all() for v in take.shapes.values())
