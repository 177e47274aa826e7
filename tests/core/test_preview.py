"""What is shown of a training while it runs, and the time it says is left."""

from __future__ import annotations

import io
import json
from types import SimpleNamespace

import numpy as np
import pytest

from pav_blender.core import progress as progress_module
from pav_blender.core.progress import Progress
from pav_blender.core.training import preview
from pav_blender.core.training.places import COLUMNS, CURVE, read_curve
from pav_blender.core.training.preview import SIDE, _on_grey, _sight, _square
from pav_blender.core.training.trainer import Status


def test_a_held_out_frame_is_shown_of_each_appearance(toy):
    for name in toy.appearances:
        frame = _sight(toy, name)
        clip, _, number = frame.name.partition("/")
        rows = toy.clip(clip)
        assert rows.appearance == name
        assert rows.split[list(rows.frame_id).index(int(number))] == "test"


def test_a_square_about_the_person_sees_the_same(toy):
    frame = _sight(toy, toy.appearances[0])
    whole = frame.camera
    frame.rgba = np.pad(frame.rgba, ((0, 0), (0, 40), (0, 0)))
    frame.camera = whole.window(0, 0, whole.width + 40, whole.height)
    point = frame.vertices[:1]
    before, _ = frame.camera.project(point)
    columns = np.nonzero(frame.rgba[..., 3] > 127)[1]
    square = _square(frame)
    assert square.rgba.shape[0] == square.rgba.shape[1] == square.camera.width
    left = before[0, 0] - square.camera.project(point)[0][0, 0]
    assert 0 <= left <= max(0, columns.mean() - square.camera.width / 2) + 1
    kept = np.nonzero(square.rgba[..., 3] > 127)[1]
    assert len(kept) == len(columns)  # all of the person


def test_pictures_take_a_hundredth_of_the_time_however_long_the_first_took(
    toy, tmp_path, monkeypatch
):
    """The first waits for the compiler."""
    clock, takes = [1000.0], iter([30.0, *[0.25] * 10])

    def draw(self, frame):
        if frame is self._frames[0]:
            clock[0] += next(takes)
        return self._truth[0]

    monkeypatch.setattr(preview.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(preview.Preview, "_draw", draw)
    status = Status(iteration=1, loss=1.0, psnr=20.0)
    shown = preview.Preview(tmp_path / "shown", toy, SimpleNamespace(status=status))
    drawn = []
    for _ in range(140):
        if shown(status):
            drawn.append(clock[0] - 1000)
        status.iteration += 1
        clock[0] += 1
    assert drawn == [30.0, 50.25, 75.5, 100.75, 126.0, 151.25]
    rows = read_curve(tmp_path / "shown")
    assert len(rows) > 40  # more points than pictures
    assert [row[0] for row in rows] == sorted({row[0] for row in rows})
    resumed = SimpleNamespace(status=Status(iteration=int(rows[5][0])))
    again = preview.Preview(tmp_path / "shown", toy, resumed)
    assert again._points == rows[:6]  # what came after the checkpoint is learned again


def test_transparent_pictures_are_laid_over_grey():
    rgba = np.zeros((2 * SIDE, 2 * SIDE, 4), np.float32)
    rgba[:SIDE] = (1, 0, 0, 1)
    laid = _on_grey(rgba)
    assert laid.shape == (SIDE, SIDE, 4)
    np.testing.assert_allclose(laid[10, 10], (1, 0, 0, 1), atol=1e-3)
    np.testing.assert_allclose(laid[-10, 10], (0.5, 0.5, 0.5, 1), atol=1e-3)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"rows": 3}', '{"rows": [["x", 1, 2, 3]]}', '{"rows": [[1, 2]]}']
)
def test_a_damaged_curve_is_none(tmp_path, text):
    assert read_curve(tmp_path) == []
    (tmp_path / CURVE).write_text(text)
    assert read_curve(tmp_path) == []


def test_rows_of_a_curve_that_are_no_numbers_are_left_out(tmp_path):
    rows = [[1, 0.5, 2.0, 10.0], [2, 0.9, float("nan"), 11.0]]
    (tmp_path / CURVE).write_text(json.dumps({"columns": COLUMNS, "rows": rows}))
    assert read_curve(tmp_path) == [(1.0, 0.5, 2.0, 10.0)]


@pytest.mark.parametrize(
    ("calls", "left"),
    [
        ([(10.0, 0.5)], 10.0),  # from the start: half took 10 s
        ([(1.0, 0.01), (10.0, 0.5)], 10.0),
        ([(1.0, 0.6), (3.0, 0.8)], 2.0),  # resumed at 60 %: a fifth took 2 s
        ([(1.0, 0.6)], None),
        ([(1.0, 0.6), (3.0, 1.0)], 0.0),
        ([(1.0, 1.0)], 0.0),
        ([(100.0, 1.0), (100.0, 0.0), (110.0, 0.5)], 10.0),  # other work after the first
    ],
)
def test_the_time_left_goes_by_the_pace_of_this_run(monkeypatch, calls, left):
    now = [0.0]
    monkeypatch.setattr(progress_module.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    report = Progress("train", as_json=True, stream=stream)
    if len(calls) == 1 and calls[0][1] == 0.5:
        report(0.0)
    for at, fraction in calls:
        now[0] = at
        report(fraction)
    assert json.loads(stream.getvalue().splitlines()[-1])["seconds_left"] == left
