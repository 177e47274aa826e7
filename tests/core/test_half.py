"""Avatars stored in half precision: `Avatar.save(half=True)`, `pav export --to half`."""

from __future__ import annotations

import json

import numpy as np
import pytest
import safetensors
import safetensors.torch
import torch

from pav_blender.cli import main
from pav_blender.core.errors import InputError
from pav_blender.core.evaluation.heldout import held_out
from pav_blender.core.field.avatar import Avatar, read_header


@pytest.fixture(scope="module")
def half_path(toy_avatar_path, tmp_path_factory):
    path = tmp_path_factory.mktemp("half") / "small.pav"
    assert main(["export", str(toy_avatar_path), "--to", "half", "--out", str(path)]) == 0
    return path


def test_numbers_are_the_nearest_halves_and_the_mesh_stays(toy_avatar, half_path):
    small = Avatar.load(half_path)
    own = toy_avatar.field.state_dict()
    for name, value in small.field.state_dict().items():
        assert value.dtype == torch.float32
        assert torch.equal(value, own[name].half().float()), name
    assert any(not torch.equal(v, own[k]) for k, v in small.field.state_dict().items())
    for name in ("canonical_vertices", "triangles", "uvs", "rigid_weights", "occupied", "box_min"):
        np.testing.assert_array_equal(getattr(small, name), getattr(toy_avatar, name))
    assert small.appearances == toy_avatar.appearances


def test_a_file_is_smaller_by_half_of_its_numbers(toy_avatar, toy_avatar_path, half_path):
    numbers = sum(v.numel() for v in toy_avatar.field.state_dict().values())
    saved = toy_avatar_path.stat().st_size - half_path.stat().st_size
    assert saved == pytest.approx(2 * numbers, rel=1e-3)
    assert read_header(half_path) == read_header(toy_avatar_path)


def test_pictures_lose_nothing_that_shows(toy, toy_avatar, half_path):
    def mean(avatar):
        return np.mean([s.psnr for s in held_out(avatar, toy)])

    assert mean(Avatar.load(half_path)) == pytest.approx(mean(toy_avatar), abs=0.05)


def test_what_no_half_can_hold_stays_whole(toy_avatar_path, tmp_path):
    avatar = Avatar.load(toy_avatar_path)
    with torch.no_grad():
        avatar.field.latent[0, 0, 0] = 65504.5
        avatar.field.tables[0, 0] = -65504.0
    avatar.save(tmp_path / "large.pav", half=True)
    with safetensors.safe_open(tmp_path / "large.pav", framework="pt") as stored:
        kinds = {name: stored.get_tensor(name).dtype for name in stored.keys()}  # noqa: SIM118
    assert kinds["field.latent"] == torch.float32
    assert kinds["field.tables"] == torch.float16
    again = Avatar.load(tmp_path / "large.pav")
    assert again.field.latent[0, 0, 0].item() == 65504.5
    assert again.field.tables[0, 0].item() == -65504.0


def test_saving_again_writes_whole_numbers(half_path, tmp_path):
    Avatar.load(half_path).save(tmp_path / "again.pav")
    again = Avatar.load(tmp_path / "again.pav")
    assert torch.equal(again.field.tables, Avatar.load(half_path).field.tables)
    assert (tmp_path / "again.pav").stat().st_size > 1.5 * half_path.stat().st_size


def test_other_kinds_of_numbers_are_refused(toy_avatar_path, tmp_path):
    with safetensors.safe_open(toy_avatar_path, framework="pt") as stored:
        tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
    tensors["field.tables"] = tensors["field.tables"].double()
    path = tmp_path / "double.pav"
    header = {"pav": json.dumps(read_header(toy_avatar_path))}
    safetensors.torch.save_file(tensors, path, header)
    with pytest.raises(InputError, match=r"'tables' are torch\.float64, not float32 or float16"):
        Avatar.load(path)


@pytest.mark.parametrize(("source", "out"), [("toy", "small.pav"), ("a.pav", "small")])
def test_only_avatar_files_are_halved(source, out, tmp_path, capsys):
    arguments = ["export", str(tmp_path / source), "--to", "half", "--out", str(tmp_path / out)]
    assert main(arguments) == 2
    assert "avatar file" in capsys.readouterr().err
    assert not (tmp_path / out).exists()
