"""`pav doctor`."""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import json
import os
import platform

SUMMARY = "Show what this machine offers, and what to install where something is missing."
EXAMPLE = "pav doctor"

NEEDED = ("numpy", "torch", "numba", "safetensors", "scipy", "OpenImageIO")
OPTIONAL = {
    "bpy": "scenes, the studio and rendering through Blender",
    "av": "`pav track`: reading videos",
    "mediapipe": "`pav track`: landmarks and mattes",
    "skimage": "SSIM in reports, and `pav bake`",
    "xatlas": "`pav bake`, and heads without UVs",
    "fast_simplification": "`pav bake`",
    "trimesh": "`pav bake`",
    "PIL": "`pav bake`",
    "stlpips_pytorch": "`pav eval`: ST-LPIPS",
    "torchvision": "`pav eval`: LPIPS, DISTS and FID",
    "lpips": "`pav eval`: LPIPS",
    "DISTS_pytorch": "`pav eval`: DISTS",
    "pytorch_fid": "`pav eval`: FID",
}
_DISTRIBUTIONS = {
    "skimage": "scikit-image",
    "fast_simplification": "fast-simplification",
    "PIL": "pillow",
    "stlpips_pytorch": "stlpips-pytorch",
    "DISTS_pytorch": "DISTS-pytorch",
    "pytorch_fid": "pytorch-fid",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--compile", action="store_true", help="compile the kernels now instead of on first use"
    )
    parser.add_argument(
        "--json",
        action="store_true",
        help="all of it, and torch's devices, as one line; ends with code 0 whatever is missing",
    )


def run(args: argparse.Namespace) -> int:
    if args.compile:
        print(f"kernels are compiled: {_compile():.0f} s")
        return 0
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if args.json:
        found = {"machine": machine(), "versions": versions(), "devices": devices()}
        print(json.dumps({"environment": found | {"missing": missing}}), flush=True)
        return 0
    print(json.dumps({"machine": machine(), "versions": versions()}, indent=1))
    for name, use in OPTIONAL.items():
        if importlib.util.find_spec(name) is None:
            print(f"{name} is not installed: needed for {use}")
    if missing:
        print(f"missing: {', '.join(missing)}; `pip install {' '.join(missing)}`")
    return 1 if missing else 0


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that are there."""
    found = {"python": platform.python_version()}
    for name in (*NEEDED, *OPTIONAL):
        try:
            found[name] = importlib.metadata.version(_DISTRIBUTIONS.get(name, name))
        except importlib.metadata.PackageNotFoundError:
            if importlib.util.find_spec(name) is not None:
                found[name] = "present"
    return found


def devices() -> list[str]:
    """What torch can compute on, by name; empty where torch is missing or does not load."""
    try:
        import torch
    except (ImportError, OSError):
        return []
    found = ["cpu"]
    for index in range(torch.cuda.device_count()):
        found.append(f"cuda:{index} {torch.cuda.get_device_name(index)}")
    if torch.backends.mps.is_available():
        found.append("mps")
    return found


def machine() -> dict[str, object]:
    """Processor, system and cores in use."""
    from ..core.cores import threads

    return {
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cores": os.cpu_count() or 1,
        "threads": threads(),
    }


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as stream:
            for line in stream:
                if line.startswith("model name"):
                    return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"


def _compile() -> float:
    """Trains and renders next to nothing, so that every kernel is compiled; seconds."""
    import time

    import numpy as np

    from ..core.collection import read_collection
    from ..core.config import Config
    from ..core.kernels.cpu.threads import torch_alone
    from ..core.rendering.render import RenderSettings, render
    from ..core.training.frames import load_frames
    from ..core.training.prepare import new_avatar
    from ..core.training.trainer import Trainer
    from ..studio import DEFAULT_COLLECTION

    started = time.monotonic()
    collection = read_collection(DEFAULT_COLLECTION)
    frames = [f for c in collection.clips for f in load_frames(collection, c, np.arange(2))]
    trainer = Trainer(new_avatar(collection, frames, Config()), frames)
    with torch_alone():
        for _ in range(3):
            trainer.iterate()
    trainer.visibility.prune()
    frame, name = frames[0], collection.appearances[0]
    for quality in ("preview", "reference"):
        camera = frame.camera.resized(16, 16)
        settings = RenderSettings.preset(quality)
        render(trainer.avatar, frame.vertices, camera, name, settings)
    return time.monotonic() - started
