"""Every approximation of a picture switched on alone: its error against its bound, and its worth.

`BOUNDS` were written down before these were measured. A largest difference is given where one can
be derived; where a skip goes by what a guide knows, which proves nothing, a PSNR is aimed at.
"""

from __future__ import annotations

import dataclasses
import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...core.evaluation.metrics import over
from ...core.evaluation.report import Claim
from ...core.field.avatar import Avatar
from ...core.images import read_rgba, read_scene_linear
from ...core.rendering.colour import linear_to_srgb
from ...core.rendering.frames import EXR, PNG8, PNG16, Format, write_frame
from ...core.rendering.render import Picture, RenderSettings, pose_scene, render_scene
from ...core.training.frames import Frame
from ..measure import best
from .exact import Exact, some_rays
from .steps import differences, every, shown

SIZE, _TILES = 256, 40
_STEP = 1e-3  # metres, `final`'s: so that an approximation is seen apart from the step


@dataclass(frozen=True)
class Bound:
    """psnr (dB, at least) and largest difference (at most) that are claimed, and why."""

    psnr: float | None
    largest: float | None
    why: str


# A ray that ends with T left is taken as opaque: what lay behind has a colour in [0, 1] and T of
# the weight, and so has what is shown in its place: off by at most T.
# Colours below a weight of 1 a metre are left out: over at most 0.4 m of ray 0.4 of its weight.
# A voxel is left out where no filled cell can be: nothing but what the affine map in a brick errs.
# PNG: half a step of colour and half one of alpha. EXR: halves have 11 bits, and sRGB's slope over
# its value is at most 1 of the linear's: 2^-11, and as much for alpha.
BOUNDS = {
    "rays end at transmittance 0.01": Bound(None, 1e-2, "what is left"),
    "rays end at 0.02 (preview)": Bound(None, 2e-2, "what is left"),
    "no colour below 1 a metre": Bound(55, 0.4, "weight left out"),
    "no colour below 2 a metre (preview)": Bound(50, 0.8, "weight left out"),
    "voxels": Bound(65, None, "only what is empty"),
    "thin places together": Bound(50, None, "goes by a guide"),
    "runs of 3, taken apart from 0.2": Bound(50, None, "goes by a guide"),
    "runs of 2, from 0.4 (preview)": Bound(50, None, "goes by a guide"),
    "pixels between those that agree to 0.06": Bound(50, None, "as their neighbours are"),
    "to 0.1 (preview)": Bound(45, None, "as their neighbours are"),
    "networks in bfloat16": Bound(55, None, "8 bits of each number"),
    "all of final": Bound(50, None, "docs/performance.md"),
    "all of preview, its step of 2.5 mm too": Bound(40, None, "docs/performance.md"),
    "float32 for float64": Bound(70, 1e-3, "rounding"),
    "stored in halves": Bound(50, None, "docs/performance.md"),
    "8-bit PNG": Bound(55, 1 / 255, "half a step, twice"),
    "16-bit PNG": Bound(100, 1 / 65535, "half a step, twice"),
    "half EXR": Bound(60, 2**-10, "11 bits, twice"),
}
_DENSE = every(_STEP)
# one by one on the way that skips, which has voxels in any case
_VOXELS = dataclasses.replace(_DENSE, skip=True, probe=1, longest=1, share=0.0, tolerance=0.0)
_FINAL, _PREVIEW = RenderSettings.preset("final"), RenderSettings.preset("preview")


def _changed(base: RenderSettings, like: RenderSettings, *names: str) -> RenderSettings:
    return dataclasses.replace(base, **{name: getattr(like, name) for name in names})


# what is switched on: settings with it, settings without
_SWITCHES = {
    "rays end at transmittance 0.01": (_changed(_DENSE, _FINAL, "transmittance"), _DENSE),
    "rays end at 0.02 (preview)": (_changed(_DENSE, _PREVIEW, "transmittance"), _DENSE),
    "no colour below 1 a metre": (_changed(_DENSE, _FINAL, "negligible"), _DENSE),
    "no colour below 2 a metre (preview)": (_changed(_DENSE, _PREVIEW, "negligible"), _DENSE),
    "voxels": (_VOXELS, _DENSE),
    "thin places together": (_changed(_VOXELS, _FINAL, "share", "longest"), _VOXELS),
    "runs of 3, taken apart from 0.2": (_changed(_VOXELS, _FINAL, "probe", "tolerance"), _VOXELS),
    "runs of 2, from 0.4 (preview)": (_changed(_VOXELS, _PREVIEW, "probe", "tolerance"), _VOXELS),
    "pixels between those that agree to 0.06": (_changed(_VOXELS, _FINAL, "agreement"), _VOXELS),
    "to 0.1 (preview)": (_changed(_VOXELS, _PREVIEW, "agreement"), _VOXELS),
    "networks in bfloat16": (_changed(_VOXELS, _FINAL, "brief"), _VOXELS),
    "all of final": (_FINAL, _DENSE),
    "all of preview, its step of 2.5 mm too": (_PREVIEW, _DENSE),
}


def measure(
    avatar: Avatar, frame: Frame, repeats: int, size: int = SIZE
) -> tuple[list[dict[str, Any]], list[Claim]]:
    """A row an approximation, and the claims of `BOUNDS`."""
    camera = frame.camera.resized(size, size)
    name = avatar.appearances[frame.appearance]
    scene = pose_scene(avatar, frame.vertices, name, frame.expression)
    known: dict[RenderSettings, Picture] = {}

    def take(settings: RenderSettings) -> None:
        known[settings] = render_scene(scene, camera, settings)

    used = dict.fromkeys(s for pair in _SWITCHES.values() for s in pair)
    calls = {str(index): partial(take, each) for index, each in enumerate(used)}
    seconds = dict(zip(used, best(calls, repeats).values(), strict=True))
    rows = []
    for what, (on, off) in _SWITCHES.items():
        difference = differences(over(known[on].rgba, 1.0), over(known[off].rgba, 1.0))
        rows.append(_row(what, difference, seconds[on], seconds[off]))
    dense = known[_DENSE]
    rows.append(_row("float32 for float64", _rounded(avatar, frame, size)))
    rows.append(_row("stored in halves", _halved(avatar, frame, dense, size)))
    rows += [_row(what, _written(format, dense)) for what, format in _FORMATS.items()]
    return rows, _claims(rows)


_FORMATS = {"8-bit PNG": PNG8, "16-bit PNG": PNG16, "half EXR": EXR}


def _row(
    what: str, difference: dict[str, float], seconds: float = np.nan, without: float = np.nan
) -> dict[str, Any]:
    bound = BOUNDS[what]
    row = {"switched on alone": what, "psnr": difference["psnr"], "max": difference["max"]}
    row |= {"bound_psnr": bound.psnr or np.nan, "bound_max": bound.largest or np.nan}
    return row | {"why": bound.why, "seconds": seconds, "seconds_without": without}


def _rounded(avatar: Avatar, frame: Frame, size: int) -> dict[str, float]:
    """The same places of the same rays, in the product's arithmetic and in float64."""
    rays = some_rays(frame, size, _TILES)
    name = avatar.appearances[frame.appearance]
    scene = pose_scene(avatar, frame.vertices, name, frame.expression)
    truth = Exact.of(avatar, frame).shown(rays, _STEP)
    return differences(shown(scene, rays, _DENSE), truth)


def _halved(avatar: Avatar, frame: Frame, dense: Picture, size: int) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        avatar.save(Path(folder) / "half.pav", half=True)
        small = Avatar.load(Path(folder) / "half.pav")
    name = avatar.appearances[frame.appearance]
    scene = pose_scene(small, frame.vertices, name, frame.expression)
    picture = render_scene(scene, frame.camera.resized(size, size), _DENSE)
    return differences(over(picture.rgba, 1.0), over(dense.rgba, 1.0))


def _written(format: Format, picture: Picture) -> dict[str, float]:
    """What a file gives back."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"picture{format.suffix}"
        write_frame(path, format, picture.rgba, None, picture.depth, {})
        back = over(_straight(path, format), 1.0)
    return differences(back, over(picture.rgba, 1.0))


def _straight(path: Path, format: Format) -> np.ndarray:
    if format.suffix == ".exr":
        linear = read_scene_linear(path)
        alpha = linear[..., 3:]
        colour = linear_to_srgb(linear[..., :3] / np.maximum(alpha, 1e-6))
        return np.concatenate([colour, alpha], -1)
    # the other reader gives values as they are stored, 16 bits of them too
    return read_rgba(path) / 255 if format.bits == 8 else read_scene_linear(path)


def _claims(rows: list[dict[str, Any]]) -> list[Claim]:
    claims = []
    for row in rows:
        what, bound = row["switched on alone"], BOUNDS[row["switched on alone"]]
        if bound.psnr is not None:
            claims.append(Claim.at_least(f"{what}: PSNR", row["psnr"], bound.psnr, "dB"))
        if bound.largest is not None:
            # in thousandths: a claim's value has three decimals
            largest, most = row["max"] * 1e3, bound.largest * 1e3
            claims.append(Claim.at_most(f"{what}: largest", largest, most, "1e-3"))
    return claims
