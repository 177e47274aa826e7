"""Shared fixtures: a toy collection and a toy avatar, each made once."""

from __future__ import annotations

import dataclasses
import os
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

# as `pav` does, before numpy is there
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# torch.optim looks for triton, which crashes in a process where Blender 5.2 is loaded
sys.modules.setdefault("triton", None)  # type: ignore[arg-type]

SLOW = bool(os.environ.get("PAV_SLOW"))


def pytest_collection_modifyitems(items):
    skip = pytest.mark.skip(reason="slow: runs in `make test-all`")
    blind = pytest.mark.skip(reason="this MediaPipe carries no models (1.x has none)")
    for item in items:
        if "slow" in item.keywords and not SLOW:
            item.add_marker(skip)
        if "faces" in item.keywords and not _carries_models():
            item.add_marker(blind)


def _carries_models() -> bool:
    try:
        return version("mediapipe").startswith("0.")
    except PackageNotFoundError:
        return True  # what needs it says so itself


@pytest.fixture(scope="session")
def toy_path(tmp_path_factory) -> Path:
    from toy import make_toy

    return make_toy(tmp_path_factory.mktemp("toy") / "collection")


@pytest.fixture(scope="session")
def toy(toy_path):
    from pav_blender.core.collection import read_collection

    return read_collection(toy_path)


@pytest.fixture(scope="session")
def small_config():
    from pav_blender.core.config import Config

    return dataclasses.replace(
        Config(),
        log2_entries=14,
        levels=8,
        finest_resolution=256,
        occupancy_resolution=64,
        rays=1024,
        frames_per_batch=4,
        iterations=250,
        step=2e-3,
    )


@pytest.fixture(scope="session")
def toy_avatar_path(toy, small_config, tmp_path_factory) -> Path:
    """An avatar trained for some seconds on the toy collection."""
    from pav_blender.core.training.train import train

    path = tmp_path_factory.mktemp("avatar") / "toy.pav"
    train(toy, path, small_config)
    return path


@pytest.fixture(scope="session")
def toy_avatar(toy_avatar_path):
    from pav_blender.core.field.avatar import Avatar

    return Avatar.load(toy_avatar_path)
