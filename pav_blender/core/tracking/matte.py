"""The person cut out of the background, with soft edges and the background's colour taken out.

The segmentation network's own soft edge is kept: on real clips a guided filter smeared it, and
placing pixels between the person's and the background's local colours cut dark hair off dark
backgrounds. What is added is a second, mirrored look, steadiness over time and clean colours under
the edge, so that an avatar does not learn the background as a fringe. `pav bench matte` measures
this against what else MediaPipe's wheel carries.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch.nn import functional

from ..errors import InputError
from ..kernels.cpu.threads import each, run_chunks
from .detectors import INSTALL, load_mediapipe, quiet

MASK_SIDE = 256
_FLOOR = 0.1  # the network's edge is softer than hair is, and never quite sure
_STILL = 4.0  # mask pixels that a head may move between frames whose masks are averaged
_VOTERS = 24
_UNHEARD = 0.01  # of the loudest voter's say
_ALIKE = 0.08  # radians between turns of the head at which outlines still compare
_HAIR = 12  # pixels of a mask that short hair may stand off the scalp
_MISLAID = 1
_SAFETY = 3  # pixels of a mask that a fitted head may be wrong by


class Segmenter:
    """MediaPipe's selfie segmentation, whose model lies in the 0.10 wheel.

    Raises InputError where this MediaPipe carries no model.
    """

    def __init__(self) -> None:
        mediapipe = load_mediapipe()
        if getattr(mediapipe, "solutions", None) is None:
            raise InputError(
                f"mediapipe {mediapipe.__version__} carries no segmentation model for the matte: "
                f"{INSTALL}, or track with --matte none for clips without a background"
            )
        with quiet():
            make = mediapipe.solutions.selfie_segmentation.SelfieSegmentation
            # one for each look, so that both can be taken at once
            self._networks: list[Any] = [make(model_selection=0), make(model_selection=0)]
            for network in self._networks:
                network.process(np.zeros((64, 64, 3), np.uint8))

    def __call__(self, rgb: np.ndarray) -> np.ndarray:
        """float32 [S,S,3] in [0,1] -> uint8 [256,256], 255 = person.

        The mean of the picture's mask and its mirror image's: their mistakes differ.
        """
        pixels = (rgb * 255 + 0.5).astype(np.uint8)
        looks = (pixels, np.ascontiguousarray(pixels[:, ::-1]))
        plain, mirrored = each(lambda look: self._mask(look, looks[look]), 2)
        mask = 0.5 * (plain + mirrored[:, ::-1])
        small = _resized(torch.from_numpy(mask)[None, None], MASK_SIDE)
        return (small[0, 0].clip(0, 1) * 255 + 0.5).to(torch.uint8).numpy()

    def _mask(self, look: int, pixels: np.ndarray) -> np.ndarray:
        with quiet():
            return np.array(self._networks[look].process(pixels).segmentation_mask, np.float32)

    def close(self) -> None:
        with quiet():
            for network in self._networks:
                network.close()


def segmenter_name() -> str:
    """Tells this segmenter's masks apart from others'."""
    return f"selfie general twice, mediapipe {getattr(load_mediapipe(), '__version__', 'unknown')}"


def steadied(masks: np.ndarray, places: np.ndarray, apart: np.ndarray) -> np.ndarray:
    """uint8 [F,256,256] -> each averaged with its two neighbours (1, 2, 1), uint8.

    places [F,N,2]: points of the head in mask pixels; apart [F-1]: frames between neighbours. One
    that is not the very next frame, or shows the head elsewhere, would leave a ghost: it counts as
    like this one.
    """
    moved = np.linalg.norm(np.diff(places, axis=0), axis=2).mean(axis=1)
    near = (moved <= _STILL) & (apart <= max(1, int(apart.min(initial=1))))
    near = near[:, None, None]
    wide = masks.astype(np.uint16)
    before, after = wide.copy(), wide.copy()
    before[1:] = np.where(near, wide[:-1], wide[1:])
    after[:-1] = np.where(near, wide[1:], wide[:-1])
    return ((before + 2 * wide + after + 2) // 4).astype(np.uint8)


def agreed(
    masks: np.ndarray, poses: np.ndarray, points: np.ndarray, scalps: np.ndarray
) -> np.ndarray:
    """Gives hair back that the network lost in some frames: uint8 [F,256,256].

    poses [F,3]: the head's turn, axis-angle; points [F,N,2]: places that move with the skull, in
    mask pixels; scalps uint8 [F,256,256]: where the fitted scalp is seen. Frames in which the head
    is turned alike are laid over one another; what most of them call person close to the scalp is
    raised to what they agree on. Long hair, which swings, is out of reach.
    """
    spread = np.linspace(0, len(masks) - 1, min(len(masks), _VOTERS)).astype(int)
    voters = torch.from_numpy(masks[spread].astype(np.float32) / 255)[:, None]
    out = masks.copy()

    def vote(start: int, stop: int) -> None:
        for row in range(start, stop):
            away = np.linalg.norm(poses[spread] - poses[row], axis=1)
            weights = np.exp(-0.5 * (away / _ALIKE) ** 2) + 1e-6
            # most look elsewhere, and have no say
            heard = np.flatnonzero(weights > _UNHEARD * weights.max())
            weights = weights[heard]
            maps = np.stack([_similarity(points[row], points[spread[voter]]) for voter in heard])
            grid = functional.affine_grid(
                torch.from_numpy(maps.astype(np.float32)),
                [len(heard), 1, *voters.shape[2:]],
                align_corners=False,
            )
            votes = functional.grid_sample(
                voters[heard], grid, padding_mode="border", align_corners=False
            )
            share = torch.from_numpy((weights / weights.sum()).astype(np.float32))
            mean = (votes[:, 0] * share[:, None, None]).sum(0, keepdim=True)
            # outlines laid over one another miss by some pixels: only what lies within all the same
            agreed_on = -_widest(-mean, _MISLAID)[0].numpy()
            scalp = torch.from_numpy(scalps[row].astype(np.float32) / 255)[None]
            near = _widest(scalp, _HAIR)[0].numpy() > 0
            sure = ((agreed_on - 0.45) / 0.4).clip(0, 1)
            raised = np.maximum(out[row], (sure * 255 + 0.5).astype(np.uint8))
            out[row] = np.where(near, raised, out[row])

    run_chunks(vote, len(masks), 4)
    return out


def _similarity(to: np.ndarray, of: np.ndarray) -> np.ndarray:
    """[2,3]: from places about `to` [N,2] to those about `of`, in a sampling grid's units."""
    centre = MASK_SIDE / 2
    a, b = (to - centre) / centre, (of - centre) / centre
    middle_a, middle_b = a.mean(axis=0), b.mean(axis=0)
    p = (a - middle_a) @ [1, 1j]
    q = (b - middle_b) @ [1, 1j]
    factor = (p.conj() @ q) / max(float((np.abs(p) ** 2).sum()), 1e-12)
    linear = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
    return np.concatenate([linear, (middle_b - linear @ middle_a)[:, None]], axis=1)


def eroded(solid: np.ndarray) -> np.ndarray:
    """bool [256,256] -> uint8, 255 where the surroundings are solid too."""
    inner = -_widest(-torch.from_numpy(solid.astype(np.float32))[None], _SAFETY)
    return (inner[0] * 255).to(torch.uint8).numpy()


def cut_out(rgb: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Colour float32 [S,S,3] and mask uint8 [256,256] -> straight RGBA float32 [S,S,4]."""
    colour = torch.from_numpy(rgb).permute(2, 0, 1).contiguous()
    side = colour.shape[1]
    rough = torch.from_numpy(mask.astype(np.float32) / 255)[None, None]
    alpha = ((_resized(rough, side)[0] - _FLOOR) / (1 - 2 * _FLOOR)).clip(0, 1)
    reach = max(1, side // 150)
    inside = (-_widest(-alpha, reach) > 0.9).float()
    outside = (_widest(alpha, reach) < 0.1).float()
    person = _spread_out(colour, inside)
    behind = _spread_out(colour, outside)
    # the colour that, laid over the background, gives the picture; nearest to the person's
    rest = colour - alpha * person - (1 - alpha) * behind
    clean = (person + rest * alpha / (alpha * alpha + 0.02)).clip(0, 1)
    clean = torch.where(alpha > 0.98, colour, clean)
    return torch.cat([clean, alpha]).permute(1, 2, 0).contiguous().numpy()


def shrink(rgba: np.ndarray, size: int) -> np.ndarray:
    """Straight RGBA [S,S,4] -> [size,size,4]; colours weighted by alpha."""
    if rgba.shape[0] == size:
        return rgba
    picture = torch.from_numpy(rgba).permute(2, 0, 1)[None]
    alpha = picture[:, 3:]
    weighted = torch.cat([picture[:, :3] * alpha, alpha], 1)
    small = _resized(weighted, size)
    alpha = small[:, 3:].clip(0, 1)
    plain = _resized(picture[:, :3], size)
    straight = torch.where(alpha > 1e-3, small[:, :3] / alpha.clip(1e-3), plain)
    return torch.cat([straight, alpha], 1)[0].permute(1, 2, 0).clip(0, 1).contiguous().numpy()


def _resized(picture: torch.Tensor, side: int) -> torch.Tensor:
    return functional.interpolate(
        picture, (side, side), mode="bilinear", antialias=True, align_corners=False
    )


def _widest(picture: torch.Tensor, reach: int) -> torch.Tensor:
    """Largest value within `reach` pixels, [1,S,S]; rows then columns."""
    size = 2 * reach + 1
    rows = functional.max_pool2d(picture[None], (size, 1), 1, (reach, 0))
    return functional.max_pool2d(rows, (1, size), 1, (0, reach))[0]


def _spread_out(colour: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Local mean of colour [3,S,S] where weight [1,S,S] is, carried on to where it is not.

    A pyramid of weighted means, each level leaning on the coarser one where it has seen little.
    """
    levels = [torch.cat([colour * weight, weight])[None]]
    while levels[-1].shape[-1] > 4:
        levels.append(functional.avg_pool2d(levels[-1], 2, ceil_mode=True, count_include_pad=False))
    top = levels[-1]
    filled = top[:, :3].sum((2, 3), keepdim=True) / top[:, 3:].sum((2, 3), keepdim=True).clip(1e-6)
    for level in reversed(levels[1:]):
        coarse = functional.interpolate(
            filled, level.shape[-2:], mode="bilinear", align_corners=False
        )
        filled = (level[:, :3] + 0.05 * coarse) / (level[:, 3:] + 0.05)
    return functional.interpolate(filled, colour.shape[-2:], mode="bilinear", align_corners=False)[
        0
    ]
