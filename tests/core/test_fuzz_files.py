"""Every kind of file that is read, damaged in many ways: refused in one line, or read."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from pathlib import Path

import formats_fixtures as formats
import numpy as np
import pytest
from damage import zipped
from fuzzing import fuzz
from test_head_pose import SMALL

from pav_blender.core.head import write_head
from pav_blender.core.images import write_exr, write_gray, write_rgba

MANY = bool(os.environ.get("PAV_SLOW"))


def times(few: int) -> int:
    """Ways of damage: some in `make test`, a hundred times as many in `make test-all`."""
    return few * 100 if MANY else few


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


@pytest.fixture
def place(tmp_path):
    return tmp_path / "work"


# ---- pictures


@pytest.mark.parametrize(
    "ending",
    ["png", pytest.param("jpg", marks=pytest.mark.slow), "exr"]
    + [
        pytest.param(ending, marks=pytest.mark.slow)
        for ending in ("tif", "tga", "bmp", "webp", "hdr", "ppm")
    ],
)
def test_pictures(ending, folder, place):
    import OpenImageIO as oiio

    rng = np.random.default_rng(0)
    path = folder / f"picture.{ending}"
    if ending == "exr":
        write_exr(path, rng.random((20, 24, 4)), rng.random((20, 24)), {"pav:inputs": "x"})
    elif ending == "png":
        write_rgba(path, rng.integers(0, 255, (20, 24, 4), np.uint8), metadata={"a": "b"})
    else:
        sink = oiio.ImageOutput.create(str(path))
        kind = "float" if ending == "hdr" else "uint8"
        assert sink.open(str(path), oiio.ImageSpec(24, 20, 3, kind))
        assert sink.write_image(rng.random((20, 24, 3), np.float32))
        sink.close()
    linear = ending in ("exr", "hdr")
    fuzz(path, "linear" if linear else "picture", "bytes", times(40), place)


# ---- collections


@pytest.fixture(scope="module")
def collection(toy_path, folder):
    root = shutil.copytree(toy_path, folder / "toy")
    meta = json.loads((root / "collection.json").read_text())
    meta["head"]["offset"] = True
    meta["extra"] = {"tracking": {"clips": [{"name": "plain", "left_out": [1]}]}}
    (root / "collection.json").write_text(json.dumps(meta))
    from pav_blender.core.head import builtin_head

    np.savez_compressed(root / "head_offset.npz", offset=builtin_head().template * 0)
    return root


@pytest.mark.parametrize(
    ("file", "kind", "few"),
    [
        ("collection.json", "json", 60),
        ("clips/plain/frames.npz", "npz", 60),
        pytest.param("head_offset.npz", "npz", 30, marks=pytest.mark.slow),
    ],
)
def test_collections(file, kind, few, collection, place):
    fuzz(collection / file, "collection", kind, times(few), place, named=False)


# ---- heads


def test_head_files(folder, place):
    path = folder / "head.npz"
    write_head(path, SMALL, step=2e-6)
    fuzz(path, "head", "npz", times(60), place)


def test_pickles(folder, place):
    from scipy import sparse

    content = {
        "a": np.arange(12.0).reshape(3, 4),
        "b": sparse.eye(5, format="csc"),
        "c": [1, "x", (2.5, None)],
        "d": np.array(["x", {}], object),
        "e": b"bytes",
    }
    for protocol in (2, 5):
        path = folder / f"small{protocol}.pkl"
        path.write_bytes(pickle.dumps(content, protocol=protocol))
        fuzz(path, "pickled", "bytes", times(150), place.with_name(f"p{protocol}"))


@pytest.mark.slow
def test_flame_and_what_lies_beside_it(models, folder, place):
    root = shutil.copytree(models / "2020", folder / "flame")
    with np.errstate(all="ignore"):
        fuzz(root / "generic_model.pkl", "flame", "bytes", 40, place.with_name("a"))
    fuzz(root / "FLAME_masks.pkl", "flame_masks", "bytes", times(10), place.with_name("b"))
    fuzz(root / "l_eyelid.npy", "eyelid", "npy", times(10), place.with_name("c"))
    small = folder / "uvs.obj"
    small.write_text("v 0 0 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    fuzz(small, "uvs", "bytes", times(10), place.with_name("d"))
    landmarks = folder / "embedding.npz"
    rng = np.random.default_rng(0)
    np.savez(
        landmarks,
        lmk_face_idx=rng.permutation(900)[:105],
        lmk_b_coords=np.full((105, 3), 1 / 3),
        landmark_indices=np.arange(105),
    )
    fuzz(landmarks, "embedding", "npz", times(3), place.with_name("e"))


# ---- avatars and trainings


def test_avatars(toy_avatar, folder, place):
    import dataclasses

    from pav_blender.core.field.avatar import Avatar

    small = dataclasses.replace(
        toy_avatar.config, log2_entries=6, levels=2, shoulder_levels=1, hidden=8,
        finest_resolution=16, occupancy_resolution=8, latent_channels=2, global_channels=4,
    )  # fmt: skip
    path = folder / "small.pav"
    Avatar.create(
        small, ["plain", "bushy"], SMALL.template, SMALL.triangles, SMALL.uvs, SMALL.uv_triangles,
        SMALL.expression_names, record={"collection": "x"},
        head_offset=np.zeros_like(SMALL.template),
    ).save(path)  # fmt: skip
    fuzz(path, "avatar", "tensors", times(100), place)


@pytest.mark.slow
def test_checkpoints(toy_path, toy, small_config, folder, place):
    from pav_blender.core.training.checkpoint import save_checkpoint
    from pav_blender.core.training.prepare import load_training_frames, new_avatar
    from pav_blender.core.training.train import fingerprint
    from pav_blender.core.training.trainer import Trainer

    root = folder / "training"
    shutil.copytree(toy_path, root / "collection")
    frames = load_training_frames(toy)
    avatar = new_avatar(toy, frames, small_config)
    avatar.save(root / "begun.pav")
    trainer = Trainer(avatar, frames)
    trainer.iterate()
    save_checkpoint(root / "new.checkpoint", trainer, fingerprint(toy))
    fuzz(root / "new.checkpoint", "checkpoint", "tensors", 400, place)


# ---- other programs' folders

WRITERS = {
    "insta": (formats.write_insta, ("transforms.json", "json"), ("flame/exp/00001.txt", "bytes"),
              ("canonical.obj", "bytes")),
    "metrical": (formats.write_metrical, ("checkpoint/00001.frame", "zip"),
                 ("mesh/00001.ply", "bytes")),
    "flashavatar": (formats.write_flashavatar, ("checkpoint/00001.frame", "zip")),
    "vhap": (formats.write_vhap, ("transforms.json", "json"), ("flame_param/00001.npz", "npz")),
    "vhap-track": (formats.write_vhap_track, ("run/tracked_flame_params_30.npz", "npz")),
    "imavatar": (formats.write_imavatar, ("flame_params.json", "json")),
}  # fmt: skip


OFTEN = {("vhap", "npz"), ("imavatar", "json"), ("metrical", "zip")}


@pytest.mark.parametrize(
    ("name", "file", "kind"),
    [
        pytest.param(
            name, *which,
            marks=() if (name, which[1]) in OFTEN else pytest.mark.slow,
        )
        for name, (_, *files) in WRITERS.items()
        for which in files
    ],
)  # fmt: skip
def test_other_programs_folders(name, file, kind, folder, place, make):
    root = folder / f"{name}-{Path(file).name}" / "source"
    make(WRITERS[name][0], root)
    (root.parent / "format.txt").write_text(name)
    fuzz(root / file, "source", kind, 400 if MANY else 12, place, named=False)


# ---- small files


def small_files(folder: Path) -> dict[str, tuple[Path, str]]:
    from test_livelink import row, write

    from pav_blender.bridge.training import FORMAT, note_of

    (folder / "config").mkdir()
    entry = {"head": str(folder / "head.npz"), "version": "2020"}
    write_head(folder / "head.npz", SMALL)
    (folder / "a.mp4").touch()
    contents: dict[Path, dict] = {
        folder / "curve.json": {"columns": ["a"], "rows": [[1, 2.0, 3.0, 4.0], [2, 2, 2, 2]]},
        folder / "config/preferences.json": {"heads": {SMALL.fingerprint: entry}, "b": {}},
        note_of(folder / "new.pav"): {
            "format": FORMAT, "output": "new.pav", "collection": None, "minutes": 8.0,
            "options": "", "clips": [[str(folder / "a.mp4"), "a"]],
        },
        folder / "steps.json": {"train": 1.5, "scene": 20},
    }  # fmt: skip
    for path, content in contents.items():
        path.write_text(json.dumps(content))
    write(folder / "take.csv", *(row(f"0:0:0:{n}", JawOpen=n / 9) for n in range(9)))
    (folder / "cache/key").mkdir(parents=True)
    (folder / "cache/pav-track-cache.txt").write_text("x")
    np.savez(folder / "cache/key/part.npz", a=np.arange(5), b=np.zeros((2, 3)))
    (folder / "face.task").write_bytes(zipped({"a.tflite": bytes(range(256)), "b.tflite": b"x"}))
    curve, config, note, steps = contents
    return {
        "curve": (curve, "json"),
        "note": (note, "json"),
        "steps": (steps, "json"),
        "recording": (folder / "take.csv", "bytes"),
        "tracked": (folder / "cache/key/part.npz", "npz"),
        "task": (folder / "face.task", "zip"),
        "preferences": (config, "json"),
    }


@pytest.mark.parametrize(
    "reader", ["curve", "note", "steps", "recording", "tracked", "task", "preferences"]
)
def test_small_files(reader, tmp_path, place):
    path, kind = small_files(tmp_path)[reader]
    fuzz(path, reader, kind, times(60), place, named=False)


@pytest.mark.slow
def test_videos(folder, place):
    pytest.importorskip("av")
    from filmed import film

    rng = np.random.default_rng(0)
    pictures = [
        np.kron(rng.integers(0, 255, (4, 5, 3), np.uint8), np.ones((16, 16, 1), np.uint8))
    ] * 5
    for ending in ("mp4", "avi", "mkv"):
        path = film(folder / f"clip.{ending}", pictures)
        fuzz(path, "video", "bytes", 600, place.with_name(ending), named=False)


def test_labels(folder, place):
    path = folder / "labels.png"
    write_gray(path, np.arange(88, dtype=np.uint8).reshape(8, 11) % 11)
    fuzz(path, "picture", "bytes", times(20), place)
