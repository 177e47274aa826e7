"""Metrics that compare what networks see in pictures: ST-LPIPS, LPIPS, DISTS and FID's features.

The packages are optional (`pip install pav-blender[eval]`). ST-LPIPS' carries its weights; for the
others they are looked for in a folder or in torch's hub cache, known by name and checksum. What is
missing is said and never fetched, nor is another network taken in its place.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import sys
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

from ..errors import InputError
from ..reading import digest, first_line

Compare = Callable[[np.ndarray, np.ndarray], float]  # pictures [H, W, 3] in [0, 1]
Features = Callable[[np.ndarray], np.ndarray]  # a picture -> [D]

SMALLEST = 32  # pixels a side: what the networks take


@dataclass(frozen=True)
class WeightsFile:
    """A file as it is published: the end of its name is the start of its SHA-256."""

    name: str
    digest: str


ALEXNET = WeightsFile("alexnet-owt-7be5be79.pth", "7be5be79")
VGG16 = WeightsFile("vgg16-397923af.pth", "397923af")
INCEPTION = WeightsFile("pt_inception-2015-12-05-6726825d.pth", "6726825d")


class Absent(Exception):
    """reason: "package absent", "package does not load" or "weights absent"; needs: what to bring,
    or why it does not."""

    def __init__(self, reason: str, needs: str) -> None:
        super().__init__(f"{reason}: {needs}")
        self.reason, self.needs = reason, needs


def st_lpips(folder: Path | None = None) -> Compare:
    """Shift-tolerant LPIPS (Ghildyal and Liu 2022), AlexNet. Raises Absent."""
    with _unused_imports("IPython.embed", "torchsummary.summary", "torchvision.models"):
        module = _package("stlpips_pytorch.stlpips", "stlpips-pytorch")
    network = module.LPIPS(net="alex", variant="shift_tolerant", verbose=False)
    return _compare(lambda a, b: network(a, b, normalize=True))


def lpips(folder: Path | None = None) -> Compare:
    """LPIPS (Zhang et al. 2018), version 0.1, AlexNet. Raises Absent, InputError."""
    state = _weights(ALEXNET, folder, "lpips", "torchvision")
    with _backbone("alexnet", state):
        network = _package("lpips", "lpips").LPIPS(net="alex", verbose=False)
    return _compare(lambda a, b: network(a, b, normalize=True))


def dists(folder: Path | None = None) -> Compare:
    """DISTS (Ding et al. 2020), pictures at their own size. Raises Absent, InputError."""
    state = _weights(VGG16, folder, "DISTS_pytorch", "torchvision")
    with _backbone("vgg16", state):
        module = _package("DISTS_pytorch.DISTS_pt", "DISTS-pytorch")
        network = module.DISTS(load_weights=False)
    # the package looks for its own weights where the interpreter is installed
    own = torch.load(Path(module.__file__).with_name("weights.pt"), weights_only=True)
    network.load_state_dict(own, strict=False)
    return _compare(network.eval())


def inception(folder: Path | None = None) -> Features:
    """The features [2048] that FID compares (Heusel et al. 2017). Raises Absent, InputError."""
    state = _weights(INCEPTION, folder, "pytorch_fid", "torchvision")
    module = _package("pytorch_fid.inception", "pytorch-fid")
    with mock.patch.object(module, "load_state_dict_from_url", return_value=state):
        network = module.InceptionV3().eval()

    def features(picture: np.ndarray) -> np.ndarray:
        with torch.inference_mode():
            return network(_tensor(picture))[0].flatten().numpy()

    return features


def _compare(network: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]) -> Compare:
    def compare(ours: np.ndarray, truth: np.ndarray) -> float:
        with torch.inference_mode():
            return float(network(_tensor(ours), _tensor(truth)))

    return compare


def _tensor(picture: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1)[None], np.float32))


def _weights(file: WeightsFile, folder: Path | None, *packages: str) -> dict[str, torch.Tensor]:
    """The state in a file, where the packages are installed; they are not imported to find out."""
    for name in packages:
        if importlib.util.find_spec(name) is None:
            raise Absent("package absent", f"pip install {name.replace('_', '-')}")
    return read(file, find(file, folder))


def _package(module: str, name: str) -> Any:
    """Imports it; Absent where it, or torchvision beneath it, is missing or does not load."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        other = error.name is not None and not module.startswith(error.name)
        missing = error.name if other else name
        raise Absent("package absent", f"pip install {missing}") from error
    except Exception as error:
        # a torchvision that was built for another torch, as a rule: there is no telling what it
        # raises (a missing operator, attribute or library)
        raise Absent("package does not load", f"{name}: {first_line(error)}") from error


@contextlib.contextmanager
def _unused_imports(*names: str) -> Iterator[None]:
    """Stands empty modules in for those that a package imports and, as it is used here, never
    calls: so they need not be installed."""
    before = {name.partition(".")[0]: sys.modules.get(name.partition(".")[0]) for name in names}
    for name in names:
        module, _, attribute = name.partition(".")
        sys.modules[module] = types.ModuleType(module)
        setattr(sys.modules[module], attribute, None)
    try:
        yield
    finally:
        for module, was in before.items():
            del sys.modules[module]
            if was is not None:
                sys.modules[module] = was


@contextlib.contextmanager
def _backbone(name: str, state: dict[str, torch.Tensor]) -> Iterator[None]:
    """Has torchvision's constructor `name` give the network of `state` instead of fetching one."""
    models = _package("torchvision.models", "torchvision")
    with torch.device("meta"):  # without memory: only the features get any, the file's
        network = getattr(models, name)()
    network.features.load_state_dict(
        {k.removeprefix("features."): v for k, v in state.items() if k.startswith("features.")},
        assign=True,
    )
    with mock.patch.object(models, name, return_value=network):
        yield


def find(file: WeightsFile, folder: Path | None) -> Path:
    """Where it lies: in the folder, its `checkpoints`, or torch's hub cache. Raises Absent."""
    places = [Path(torch.hub.get_dir()) / "checkpoints"]
    if folder is not None:
        places = [folder, folder / "checkpoints", *places]
    for place in places:
        if (place / file.name).is_file():
            return place / file.name
    raise Absent("weights absent", f"{file.name} is not in {' or '.join(map(str, places))}")


def read(file: WeightsFile, path: Path) -> dict[str, torch.Tensor]:
    """The state in a published file. InputError where its checksum is not the file's own."""
    found = digest(path)
    if not found.startswith(file.digest):
        raise InputError(
            f"{path}: damaged or another file: its SHA-256 starts with {found[:8]}, not "
            f"{file.digest}; get it anew"
        )
    return torch.load(path, map_location="cpu", weights_only=True)
