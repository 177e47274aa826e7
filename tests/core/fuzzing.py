"""Reads damaged files in a process of its own whose memory is limited, and tells what went wrong.

`fuzz` starts it and is what tests call; `READERS` says how each kind of file is read.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
MORE = 10 if os.environ.get("PAV_SLOW") else 1  # examples of property tests in `make test-all`
ROOM = 1200  # MiB that damaged files may take beyond what a whole one takes
SECONDS = 20.0  # of the processor, for one file


def picture(path: Path) -> None:
    from pav_blender.core import images

    images.read_metadata(path)
    images.read_rgba(path)
    images.read_gray(path)
    images.check(path)


def linear(path: Path) -> None:
    from pav_blender.core.images import check, read_scene_linear

    check(path)
    read_scene_linear(path)


def collection(path: Path) -> None:
    """path: any file of the collection."""
    from pav_blender.core.collection import read_collection

    root = next(p for p in path.parents if (p / "collection.json").exists())
    found = read_collection(root)
    found.posed(found.clips[0], found.clips[0].indices("train", "test", "view")[:1])


def source(path: Path) -> None:
    """path: any file of another program's folder, which is called `source`."""
    from pav_blender.core.collection.importers import read_sources

    root = next(p for p in path.parents if p.name == "source")
    read_sources([str(root)], (root.parent / "format.txt").read_text())


def head(path: Path) -> None:
    from pav_blender.core.head import load_head

    load_head(path)


def flame(path: Path) -> None:
    from pav_blender.core.head.flame import find_flame, read_flame

    read_flame(find_flame(path, "2020"))


def flame_masks(path: Path) -> None:
    from pav_blender.core.head.flame_parts import masks_of

    masks_of(path, 5023)


def eyelid(path: Path) -> None:
    from pav_blender.core.head.flame_parts import read_eyelids

    read_eyelids(path, 5023)


def embedding(path: Path) -> None:
    from pav_blender.core.head import builtin_head
    from pav_blender.core.head.flame_parts import read_landmarks

    read_landmarks(path, builtin_head())


def uvs(path: Path) -> None:
    import numpy as np

    from pav_blender.core.head.flame_parts import read_uvs

    read_uvs(path, np.zeros((3, 3)), np.array([[0, 1, 2]]))


def pickled(path: Path) -> None:
    from pav_blender.core.pickles import read_pickle

    read_pickle(path)


def avatar(path: Path) -> None:
    from pav_blender.core.field.avatar import Avatar

    Avatar.load(path)


@cache
def _trainer(root: Path) -> tuple[Any, str]:
    from pav_blender.core.collection import read_collection
    from pav_blender.core.field.avatar import Avatar
    from pav_blender.core.training.prepare import load_training_frames
    from pav_blender.core.training.train import fingerprint
    from pav_blender.core.training.trainer import Trainer

    known = read_collection(root / "collection")
    made = Avatar.load(root / "begun.pav")
    return Trainer(made, load_training_frames(known)), fingerprint(known)


def checkpoint(path: Path) -> None:
    from pav_blender.core.training.checkpoint import load_checkpoint

    trainer, known = _trainer(path.parent)
    load_checkpoint(path, trainer, known)


def recording(path: Path) -> None:
    from pav_blender.core.head.livelink import read_take, resample

    resample(read_take(path), 30)


def curve(path: Path) -> None:
    from pav_blender.core.training.places import read_curve

    assert all(len(row) == 4 for row in read_curve(path.parent))


def preferences(path: Path) -> None:
    from pav_blender.core.head import remembered_head

    os.environ["PAV_CONFIG"] = str(path.parent)
    remembered_head("2020")


def note(path: Path) -> None:
    from pav_blender.bridge.training import read_note

    read_note(path.parent / "new.pav")


def steps(path: Path) -> None:
    from pav_blender.verbs.demo import Steps

    Steps(path)


def tracked(path: Path) -> None:
    from pav_blender.core.tracking.cache import Cache

    Cache(path.parent.parent).load(path.parent.name, path.stem, ["a", "b"])


def task(path: Path) -> None:
    from pav_blender.core.tracking.detectors import read_task

    read_task(path)


def video(path: Path) -> None:
    from pav_blender.core.tracking.pictures import open_source

    found = open_source(path)
    for _ in found.frames():
        pass


READERS: dict[str, Callable[[Path], None]] = {
    reader.__name__: reader
    for reader in (
        picture, linear, collection, source, head, flame, flame_masks, eyelid, embedding, uvs,
        pickled, avatar, checkpoint, recording, curve, preferences, note, steps, tracked, task,
        video,
    )
}  # fmt: skip


# ---- in the process that reads


def peak() -> int:
    """MiB that this process held at most."""
    try:
        import resource
    except ImportError:  # Windows
        return 0
    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return size >> (20 if sys.platform == "darwin" else 10)


def limit(room: int) -> None:
    """No more than `room` MiB beyond what is mapped now: what asks for more fails, not the
    machine."""
    if not sys.platform.startswith("linux"):
        return
    import resource

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + (room << 20)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


def names_below(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def work(wanted: dict[str, Any]) -> None:
    """Reads each damaged file in place of the whole one; a line of JSON for each that went wrong,
    and one at the end."""
    from damage import damaged

    from pav_blender.core.errors import PavError

    read, path = READERS[wanted["reader"]], Path(wanted["path"])
    whole, outside = path.read_bytes(), Path(wanted["path"]).parent
    read(path)
    before, usual = names_below(outside), peak()
    limit(4 * ROOM)
    done = refused = 0
    for number, content in enumerate(
        damaged(wanted["kind"], whole, wanted["count"], wanted["seed"])
    ):
        path.write_bytes(content)
        print(json.dumps({"begun": number}), flush=True)
        started, wrong = time.process_time(), ""
        try:
            read(path)
        except PavError as error:
            refused += 1
            if "\n" in str(error) or len(str(error)) > 2000:
                wrong = f"not one line: {str(error)[:300]!r}"
            elif wanted["named"] and path.name not in str(error) and path.stem not in str(error):
                wrong = f"the file is not named: {error}"
        except BaseException:
            wrong = "".join(traceback.format_exc().splitlines(keepends=True)[-8:])
        took, held = time.process_time() - started, peak() - usual
        if took > SECONDS:
            wrong = wrong or f"it took {took:.0f} s"
        if held > ROOM:
            wrong, usual = wrong or f"{held} MiB more than the whole file", peak()
        done += 1
        if wrong:
            path.with_name(path.name + f".wrong{number}").write_bytes(content)
            before.add(path.name + f".wrong{number}")
            print(json.dumps({"number": number, "wrong": wrong}), flush=True)
    path.write_bytes(whole)
    left = sorted(names_below(outside) ^ before) + sorted(os.listdir("."))
    print(json.dumps({"done": done, "refused": refused, "left": left}), flush=True)


# ---- in the test


def fuzz(
    path: Path,
    reader: str,
    kind: str,
    count: int,
    place: Path,
    *,
    seed: int = 0,
    named: bool = True,
) -> dict[str, Any]:
    """Damages the file at `path` in `count` ways and reads each; what went wrong fails the test.
    place: an empty folder to work in; named: errors are of this one file, and must say so."""
    wanted = {
        "path": str(path), "reader": reader, "kind": kind, "count": count, "seed": seed,
        "named": named,
    }  # fmt: skip
    place.mkdir()
    code = f"import json, sys, fuzzing; fuzzing.work(json.loads({json.dumps(wanted)!r}))"
    roots = [str(HERE), str(HERE.parents[1])]
    ended = subprocess.run(
        [sys.executable, "-c", code],
        cwd=place,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(roots), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=3000,
    )
    said = [json.loads(line) for line in ended.stdout.splitlines() if line.startswith("{")]
    wrong = [line for line in said if "wrong" in line]
    told = "\n".join(f"{line['number']}: {line['wrong']}" for line in wrong[:5])
    assert not wrong, f"{len(wrong)} of {count} damaged files:\n{told}"
    last = said[-1] if said else {}
    died = f"the process ended with {ended.returncode} at {last}\n{ended.stderr[-3000:]}"
    assert "done" in last, died
    assert last["left"] == []
    return last
