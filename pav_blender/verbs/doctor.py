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
    "skimage": "SSIM in reports",
}
_DISTRIBUTIONS = {"skimage": "scikit-image", "OpenImageIO": "OpenImageIO"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    pass


def run(args: argparse.Namespace) -> int:
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
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


def machine() -> dict[str, object]:
    """Processor, system and cores in use."""
    from ..core.kernels.cpu.threads import threads

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
