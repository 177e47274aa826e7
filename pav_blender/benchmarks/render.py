"""Run time against error: every setting of a picture, the dense picture, plain torch, Cycles."""

from __future__ import annotations

import copy
import dataclasses
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..core.collection import Collection
from ..core.errors import PavError
from ..core.evaluation.heldout import chosen_frames
from ..core.evaluation.metrics import over, psnr
from ..core.evaluation.report import Claim
from ..core.field.avatar import Avatar
from ..core.kernels.cpu.threads import torch_alone
from ..core.progress import Report
from ..core.rendering.render import Picture, RenderSettings, pose_scene, render, render_scene
from ..core.training.frames import Frame
from ..studio import DEFAULT_COLLECTION
from .measure import Options, a_frame, best, plot, show, subject
from .plain import dense

_BANDS = (0.02, 0.06)  # metres from the mesh; the avatar's own is 0.13
_PLAIN_PIXELS = 6  # every sample is held against every triangle: minutes
_DETAILED = 256  # pixels a side at which every setting is tried
_FINAL = RenderSettings.preset("final")
_PREVIEW = RenderSettings.preset("preview")
# for fewer places than "preview" looks at
COARSE = {
    "preview": _PREVIEW,
    "preview, step 3.5 mm": dataclasses.replace(_PREVIEW, step=3.5e-3),
    "preview, agreement 0.3": dataclasses.replace(_PREVIEW, agreement=0.3),
}
# switch, what is changed to turn it off
SKIPS = {
    "voxels and their guide": {"skip": False},
    "runs looked at in their middle": {"probe": 1},
    "runs and thin places taken together": {"probe": 1, "longest": 1},
    "opaque rays": {"transmittance": 0.0},
    "colours that hardly show": {"negligible": 0.0},
    "pixels between four that agree": {"agreement": 0.0},
}


def run(options: Options, progress: Report | None = None) -> tuple[dict[str, Any], list[Claim]]:
    avatar, collection = subject(options, progress)
    frame = a_frame(collection)
    points, skips = [], []
    exact = {}
    for size in (256, 512):
        truth = _picture(avatar, frame, size, RenderSettings.preset("reference"))
        exact[size] = truth
        points += _timed(avatar, frame, size, truth, _variants(size), options.repeats)
        if size == _DETAILED:
            skips = _skips(avatar, frame, size, truth, options.repeats)
            points += _altered(avatar, frame, size, truth, options.repeats)
    parts = _parts(avatar, frame, options.repeats)
    looks = _looks(avatar, collection)
    show(points)
    show(parts)
    show(skips)
    show(looks)
    agreement = _against_plain(avatar, frame, exact[frame.camera.width])
    print(f"reference preset against plain torch, {_PLAIN_PIXELS} pixels: {agreement:.1f} dB")
    path = options.out / "subject.pav"
    cold = {
        "cached": min(_cold_start(path, True) for _ in range(options.repeats)),
        "compiled": _cold_start(path, False),
    }
    named = {(p["size"], p["name"]): p for p in points}
    final, preview = named[512, "final"], named[256, "preview"]
    cycles = _cycles(512)
    plot(
        options.out / "render.svg",
        lambda axes: _draw(axes, points, cycles),
        "Run time against error (PSNR to the dense picture)",
        "seconds a picture",
        "dB",
    )
    fields = {
        "points": points,
        "skips": skips,
        "parts": parts,
        "looks": looks,
        "plain_torch_psnr": round(agreement, 2),
        "cold_start_seconds": cold,
        "cycles_seconds": cycles,
    }
    claims = [
        Claim.at_most("512 final: time", final["seconds"], 0.40, "s"),
        Claim.at_least("512 final: to the dense picture", final["psnr"], 50, "dB"),
        Claim.at_most("256 preview: time", preview["seconds"], 0.06, "s"),
        Claim.at_least("256 preview: to the dense picture", preview["psnr"], 40, "dB"),
        Claim.at_least("dense picture: to plain torch", agreement, 50, "dB"),
        Claim.at_most("density evaluations a pixel, 512 final", final["evaluations"], 6, ""),
        Claim.at_least("faster than Cycles, 512", cycles / final["seconds"], 12, "x"),
        Claim.at_most("first picture, kernels cached", cold["cached"], 3, "s"),
        Claim.at_most("first picture, kernels not cached", cold["compiled"], 30, "s"),
    ]
    return fields, claims


def _picture(avatar: Avatar, frame: Frame, size: int, settings: RenderSettings) -> Picture:
    camera = frame.camera.resized(size, size)
    name = avatar.appearances[frame.appearance]
    return render(avatar, frame.vertices, camera, name, settings, expression=frame.expression)


def _variants(size: int) -> dict[str, RenderSettings]:
    change = dataclasses.replace
    found = {"preview": _PREVIEW, "final": _FINAL}
    for step in (0.75, 1.0, 1.5, 2.0, 3.0):
        found[f"step {step:g} mm"] = change(_FINAL, step=step * 1e-3)
    if size != _DETAILED:
        return found
    found |= COARSE
    for left in (1e-4, 1e-3, 2e-2):
        found[f"transmittance {left:g}"] = change(_FINAL, transmittance=left)
    for share in (0.0, 0.05, 0.1):
        found[f"share {share:g}"] = change(_FINAL, share=share)
    for tolerance in (0.05, 0.1, 0.4):
        found[f"tolerance {tolerance:g}"] = change(_FINAL, tolerance=tolerance)
    for agreement in (0.0, 0.03, 0.1):
        found[f"agreement {agreement:g}"] = change(_FINAL, agreement=agreement)
    found["networks in float32"] = change(_FINAL, brief=False)
    for probe in (1, 2, 4):
        found[f"runs of {probe}"] = change(_FINAL, probe=probe)
    return found


def _point(
    avatar: Avatar, frame: Frame, size: int, settings: RenderSettings, truth: Picture, name: str
) -> dict[str, Any]:
    picture = _picture(avatar, frame, size, settings)
    return {
        "name": name,
        "size": size,
        "seconds": 0.0,
        "psnr": round(psnr(over(picture.rgba, 1.0), over(truth.rgba, 1.0)), 2),
        "evaluations": round(picture.evaluations / size**2, 2),
    }


def _timed(
    avatar: Avatar,
    frame: Frame,
    size: int,
    truth: Picture,
    variants: dict[str, RenderSettings],
    repeats: int,
) -> list[dict[str, Any]]:
    rows = [_point(avatar, frame, size, s, truth, n) for n, s in variants.items()]
    calls = {n: partial(_picture, avatar, frame, size, s) for n, s in variants.items()}
    seconds = best(calls, repeats)
    for row in rows:
        row["seconds"] = round(seconds[row["name"]], 4)
    return rows


def _altered(
    avatar: Avatar, frame: Frame, size: int, truth: Picture, repeats: int
) -> list[dict[str, Any]]:
    """The final preset of the avatar with its numbers stored in two bytes each (computed with in
    four, as ever), and with a narrower band about the mesh."""
    rows = []
    for kind in (torch.float16, torch.bfloat16):
        other = copy.deepcopy(avatar)
        for value in other.field.state_dict().values():
            value.copy_(value.to(kind))
        name = f"stored in {str(kind).split('.')[1]}"
        rows += _timed(other, frame, size, truth, {name: _FINAL}, repeats)
    for band in _BANDS:
        other = copy.deepcopy(avatar)
        other.config = dataclasses.replace(avatar.config, reach=band)
        rows += _timed(other, frame, size, truth, {f"band {band * 1e3:g} mm": _FINAL}, repeats)
    return rows


def _skips(
    avatar: Avatar, frame: Frame, size: int, truth: Picture, repeats: int
) -> list[dict[str, Any]]:
    """The final preset, and with each skip off."""
    variants = {"final": _FINAL}
    for name, change in SKIPS.items():
        variants[f"without: {name}"] = dataclasses.replace(_FINAL, **change)  # type: ignore[arg-type]
    return _timed(avatar, frame, size, truth, variants, repeats)


def _parts(avatar: Avatar, frame: Frame, repeats: int) -> list[dict[str, Any]]:
    """Seconds of a picture's two parts: the pose, and the rays of one that is posed."""
    name, rows = avatar.appearances[frame.appearance], []
    pose = partial(pose_scene, avatar, frame.vertices, name, frame.expression)
    scene = pose()
    for preset, size in (("preview", 256), ("final", 512)):
        camera = frame.camera.resized(size, size)
        rays = partial(render_scene, scene, camera, RenderSettings.preset(preset))
        with torch.inference_mode(), torch_alone():
            seconds = best({"pose": pose, "rays": rays}, repeats)
        rows.append({"name": preset, "size": size} | {k: round(v, 4) for k, v in seconds.items()})
    return rows


def _looks(avatar: Avatar, collection: Collection) -> list[dict[str, Any]]:
    """Every appearance in a held-out pose of its own, by the presets and by coarser ones than
    "preview", and by "final" in one of another's, which no frame has shown it in."""
    frames = chosen_frames(collection, ("test",), None)
    rows = []
    for row, name in enumerate(avatar.appearances):
        own = [f for f in frames if f.appearance == row]
        others = [f for f in frames if f.appearance == (row + 1) % len(avatar.appearances)]
        for motion, frame in (("own", own[len(own) // 2]), ("another's", others[1])):
            worn = dataclasses.replace(frame, appearance=row)
            truth = _picture(avatar, worn, _DETAILED, RenderSettings.preset("reference"))
            for label, settings in (
                {"final": _FINAL} | (COARSE if motion == "own" else {})
            ).items():
                point = _point(avatar, worn, _DETAILED, settings, truth, label)
                del point["seconds"]
                rows.append({"appearance": name, "motion": motion} | point)
    return rows


def _against_plain(avatar: Avatar, frame: Frame, exact: Picture) -> float:
    """PSNR of the reference preset to plain torch over pixels of the person."""
    inside = np.flatnonzero(frame.rgba[..., 3].reshape(-1) > 127)
    pixels = np.random.default_rng(0).choice(inside, _PLAIN_PIXELS, replace=False)
    ours = over(exact.rgba, 1.0).reshape(-1, 3)[pixels]
    return psnr(ours, dense(avatar, frame, pixels))


_FIRST_PICTURE = """
import sys
from pav_blender.core.collection import read_collection
from pav_blender.core.field.avatar import Avatar
from pav_blender.core.evaluation.heldout import chosen_frames
from pav_blender.core.rendering.render import RenderSettings, render
avatar, collection = Avatar.load(sys.argv[1]), read_collection(sys.argv[2])
frame = chosen_frames(collection, ("test",), 1)[0]
settings = RenderSettings.preset("preview")
render(avatar, frame.vertices, frame.camera, avatar.appearances[0], settings)
print("rendered", flush=True)
"""


def _cold_start(avatar: Path, cached: bool) -> float:
    """Seconds from the start of a process to its first picture of 256 pixels, reading included."""
    package = str(Path(__file__).parents[2])
    with tempfile.TemporaryDirectory() as empty:
        environment = os.environ | {"PYTHONPATH": package}
        if not cached:
            environment["NUMBA_CACHE_DIR"] = empty
        command = [sys.executable, "-c", _FIRST_PICTURE, str(avatar), str(DEFAULT_COLLECTION)]
        started = time.perf_counter()
        with subprocess.Popen(
            command,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as process:
            assert process.stdout is not None
            told = process.stdout.readline()
            seconds = time.perf_counter() - started
            _, errors = process.communicate()
        if told != "rendered\n":
            raise PavError(f"a first picture failed: {errors.strip().splitlines()[-1]}")
        return round(seconds, 2)


def _cycles(size: int) -> float:
    """Seconds of one picture of the studio's own scene in Cycles: 64 samples, denoised."""
    from ..core.head import builtin_head
    from ..studio.appearances import APPEARANCES, build_scene
    from ..studio.identity import identity
    from ..studio.passes import NOISE, Passes
    from ..studio.person import build_person
    from ..studio.render import plan, quiet

    head = builtin_head()
    person = build_person(head, identity(head, 0))
    look = APPEARANCES[0]
    shot = plan(person, look, 6, size, (0, 0))[0]
    scene = build_scene(person, look, 0)
    passes = Passes(scene.scene, size)
    passes.expose(64)
    passes.noise = NOISE  # a pixel that is clean sooner may stop: Cycles at its quickest
    try:
        scene.pose(shot.expression, shot.pose, shot.translation)
        scene.aim(shot.intrinsics, shot.camera_to_world, size)
        with quiet():
            return round(best({"cycles": passes.colour}, 1)["cycles"], 2)
    finally:
        passes.close()
        scene.close()


def _draw(axes: Any, points: list[dict[str, Any]], cycles: float) -> None:
    for size, marker in ((256, "o"), (512, "s")):
        own = [p for p in points if p["size"] == size]
        axes.scatter([p["seconds"] for p in own], [p["psnr"] for p in own], s=22, marker=marker,
                     label=f"{size} x {size}")  # fmt: skip
        front = sorted(_front(own), key=lambda p: p["seconds"])
        axes.plot([p["seconds"] for p in front], [p["psnr"] for p in front], linewidth=0.8)
        for p in own:
            if p["name"] in ("preview", "final"):
                axes.annotate(p["name"], (p["seconds"], p["psnr"]), xytext=(4, -10),
                              textcoords="offset points", fontsize=8)  # fmt: skip
    axes.axvline(cycles, color="grey", linestyle="--", label="Cycles, 512 x 512")
    axes.set_xscale("log")
    axes.legend()


def _front(points: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Those that no other beats in both time and error."""
    return [
        p
        for p in points
        if not any(q["seconds"] < p["seconds"] and q["psnr"] > p["psnr"] for q in points)
    ]
