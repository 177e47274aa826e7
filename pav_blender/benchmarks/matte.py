"""`pav bench matte`: mattes that MediaPipe's wheel offers, against a truth that is known.

The studio's pictures carry their exact alpha. Laid over backgrounds they are what a camera would
have seen. In a band about the person's edge each matte is compared with that alpha; and, laid over
other backgrounds, the cut-out picture with the true one: what is left there is a halo.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy import ndimage

from ..core.collection import Collection
from ..core.evaluation.report import Claim
from ..core.images import read_rgba, write_rgba
from ..core.progress import Report
from ..core.tracking import matte
from ..core.tracking.crop import resize
from ..core.tracking.detectors import load_mediapipe, quiet
from .measure import Options, collection_of, plot, show

_FRAMES = 6  # a clip
_BAND = 8  # pixels about the edge, of 256
_BACKGROUNDS = ("plain wall", "dark room", "busy room")
_ALPHA_TARGET, _HALO_TARGET = 0.05, 0.025
OURS = "pav track"

# picture float32 [S, S, 3] -> straight RGBA [S, S, 4]
CutOut = Callable[[np.ndarray], np.ndarray]


def run(options: Options, _progress: Report) -> tuple[dict[str, Any], list[Claim]]:
    """Measures; writes matte.svg and matte.png (picture, true alpha, each matte)."""
    collection = collection_of(options)
    mattes, close = _mattes()
    rows: list[dict[str, Any]] = []
    pictures: list[np.ndarray] = []
    try:
        for index, (background, picture, truth) in enumerate(_filmed(collection)):
            found = {name: call(picture) for name, call in mattes.items()}
            rows += [
                {"matte": name, "background": background, **_errors(rgba, truth)}
                for name, rgba in found.items()
            ]
            if index % 7 == 0 and len(pictures) < 6:
                alphas = [rgba[..., 3] for rgba in (truth, *found.values())]
                greys = [np.repeat(alpha[..., None], 3, axis=2) for alpha in alphas]
                pictures.append(np.concatenate([picture, *greys], axis=1))
    finally:
        close()
    sheet = np.concatenate(pictures)
    write_rgba(options.out / "matte.png", np.dstack([sheet, np.ones(sheet.shape[:2], np.float32)]))
    table = [_summary(name, [row for row in rows if row["matte"] == name]) for name in mattes]
    show(table)
    plot(
        options.out / "matte.svg",
        lambda axes: _bars(axes, table),
        "Error in the edge band",
        "mean absolute error, of 1",
        "",
    )
    of = {row["matte"]: row for row in table}
    best = min(row["halo"] for name, row in of.items() if name != OURS)
    claims = [
        Claim.at_most("alpha error of pav track", of[OURS]["alpha"], _ALPHA_TARGET, ""),
        Claim.at_most("halo of pav track", of[OURS]["halo"], _HALO_TARGET, ""),
        Claim.at_least("halo of the best other, of ours", best / of[OURS]["halo"], 1.1, "x"),
    ]
    return {"band_pixels": _BAND, "mattes": table}, claims


def _errors(rgba: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """In the edge band: mean absolute error of alpha, and of the picture over black and white."""
    band = _band(truth[..., 3])
    halo = [
        np.abs(_over(rgba, behind) - _over(truth, behind))[band].mean() for behind in (0.0, 1.0)
    ]
    alpha = np.abs(rgba[..., 3] - truth[..., 3])[band].mean()
    return {"alpha": float(alpha), "halo": float(np.mean(halo))}


def _over(rgba: np.ndarray, behind: float | np.ndarray) -> np.ndarray:
    return rgba[..., :3] * rgba[..., 3:] + behind * (1 - rgba[..., 3:])


def _summary(name: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    means = {
        background: float(np.mean([r["alpha"] for r in rows if r["background"] == background]))
        for background in _BACKGROUNDS
    }
    alpha, halo = (float(np.mean([row[key] for row in rows])) for key in ("alpha", "halo"))
    return {"matte": name, **means, "alpha": alpha, "halo": halo}


def _bars(axes: Any, table: list[dict[str, Any]]) -> None:
    places = np.arange(len(table))[::-1]
    axes.barh(places + 0.2, [row["alpha"] for row in table], 0.38, label="alpha")
    axes.barh(places - 0.2, [row["halo"] for row in table], 0.38, label="halo")
    axes.set_yticks(places, [row["matte"] for row in table])
    axes.legend()


def _mattes() -> tuple[dict[str, CutOut], Callable[[], None]]:
    """Each way to cut a person out, by name; and what ends their networks."""
    segmenter = matte.Segmenter()  # first: it says what to install where it cannot be made
    solutions = load_mediapipe().solutions
    with quiet():
        selfie = [
            solutions.selfie_segmentation.SelfieSegmentation(model_selection=model)
            for model in (0, 1)
        ]
        pose = solutions.pose.Pose(
            static_image_mode=True, enable_segmentation=True, smooth_segmentation=False
        )

    def network(which: Any) -> Callable[[np.ndarray], np.ndarray]:
        def call(picture: np.ndarray) -> np.ndarray:
            with quiet():
                mask = which.process((picture * 255 + 0.5).astype(np.uint8)).segmentation_mask
            side = picture.shape[0]
            return np.zeros((side, side), np.float32) if mask is None else np.array(mask)

        return call

    def close() -> None:
        with quiet():
            for each in (*selfie, pose):
                each.close()
        segmenter.close()

    general, landscape, body = network(selfie[0]), network(selfie[1]), network(pose)
    return {
        "selfie, general": lambda p: np.dstack([p, general(p)]),
        "selfie, landscape": lambda p: np.dstack([p, landscape(p)]),
        "pose": lambda p: np.dstack([p, body(p)]),
        "selfie + guided filter": lambda p: np.dstack([p, _guided(p, general(p))]),
        OURS: lambda p: matte.cut_out(p, segmenter(p)),
    }, close


def _guided(
    picture: np.ndarray, mask: np.ndarray, radius: int = 6, eps: float = 1e-3
) -> np.ndarray:
    """The guided filter (He et al. 2010) with the picture's grey as its guide."""
    guide = picture.mean(axis=2)

    def mean(values: np.ndarray) -> np.ndarray:
        return ndimage.uniform_filter(values, 2 * radius + 1, mode="nearest")

    centre, average = mean(guide), mean(mask)
    slope = (mean(guide * mask) - centre * average) / (mean(guide**2) - centre**2 + eps)
    offset = average - slope * centre
    return (mean(slope) * guide + mean(offset)).clip(0, 1)


def _filmed(collection: Collection) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Background's name, picture float32 [S, S, 3], the true RGBA [S, S, 4]."""
    for number, clip in enumerate(collection.clips):
        rows = clip.indices("train", "test")
        for row in rows[np.linspace(0, len(rows) - 1, _FRAMES).astype(int)]:
            truth = read_rgba(collection.image_path(clip, int(row))).astype(np.float32) / 255
            for name in _BACKGROUNDS:
                yield name, _over(truth, _background(name, len(truth), number)), truth


def _background(name: str, side: int, seed: int) -> np.ndarray:
    """[S, S, 3] in [0, 1]."""
    random = np.random.default_rng(seed)
    low, high, coarse = {
        "plain wall": (0.55, 0.8, 2),
        "dark room": (0.02, 0.25, 5),
        "busy room": (0.05, 0.9, 24),
    }[name]
    grid = random.uniform(low, high, (coarse, coarse, 3)).astype(np.float32)
    return resize(grid, side).clip(0, 1)


def _band(alpha: np.ndarray) -> np.ndarray:
    """bool [S, S]: within _BAND pixels of where the alpha is neither 0 nor 1, or jumps."""
    solid = alpha > 0.5
    edge = (alpha > 0.02) & (alpha < 0.98)
    edge |= solid ^ ndimage.binary_erosion(solid, border_value=1)
    reach = round(_BAND * len(alpha) / 256)
    return ndimage.distance_transform_edt(~edge) <= reach
