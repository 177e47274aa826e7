"""Metrics between pictures [H, W, 3], colours in [0, 1]; those that need networks: `learned`."""

from __future__ import annotations

import math

import numpy as np

LARGEST_PSNR = 100.0  # what equal pictures score: reports hold no infinities
SSIM_WINDOW = 11  # pixels: the Gaussian's side, and the smallest picture's
_MARGIN = 0.02  # of the longer side: what lies nearer to the matte's edge is neither in nor out
_EMPTY, _FULL = 8, 247  # mattes up to and from which a pixel is taken to be all out, all in


def psnr(picture: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB, over all pixels or those where mask [H, W] is true.

    nan where the mask is empty.
    """
    error = (np.asarray(picture, np.float64) - np.asarray(truth, np.float64)) ** 2
    if mask is not None:
        error = error[mask]
    if error.size == 0:
        return math.nan
    return decibels(float(error.mean()))


def decibels(error: float) -> float:
    """The PSNR of a mean squared error, of colours in [0, 1]; at most LARGEST_PSNR."""
    return min(LARGEST_PSNR, -10 * math.log10(max(error, 1e-12)))


def ssim(picture: np.ndarray, truth: np.ndarray) -> float:
    """Structural similarity (Wang et al. 2004) as the field computes it: Gaussian window of 11x11,
    sigma 1.5, each colour channel, mean over them and the places where the window fits."""
    from skimage.metrics import structural_similarity

    return float(
        structural_similarity(
            np.asarray(picture, np.float64),
            np.asarray(truth, np.float64),
            data_range=1.0,
            channel_axis=2,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
        )
    )


def over(rgba: np.ndarray, background: float | np.ndarray) -> np.ndarray:
    """Straight-alpha [H, W, 4] in [0, 1] over a background colour -> [H, W, 3]."""
    alpha = rgba[..., 3:4]
    return rgba[..., :3] * alpha + np.asarray(background) * (1 - alpha)


def fog(opacity: np.ndarray, matte: np.ndarray) -> float:
    """Mean opacity [H, W] outside the matte (uint8 [H, W]), 2 % of the picture's longer side away
    from it; nan where nothing is that far outside."""
    return _mean_far_from(opacity, matte > _EMPTY)


def holes(opacity: np.ndarray, matte: np.ndarray) -> float:
    """Mean of what shows through (1 - opacity) inside the matte, as far from its edge as `fog`."""
    return _mean_far_from(1 - opacity, matte < _FULL)


def _mean_far_from(values: np.ndarray, area: np.ndarray) -> float:
    from scipy import ndimage

    if not area.any():
        return float(values.mean(dtype=np.float64))
    far = ndimage.distance_transform_edt(~area) > max(2.0, _MARGIN * max(area.shape))
    return float(values[far].mean(dtype=np.float64)) if far.any() else math.nan


def frechet(ours: np.ndarray, truth: np.ndarray) -> float:
    """Frechet distance of the Gaussians fitted to features [N, D] and [M, D] (Heusel et al. 2017):
    |m1 - m2|^2 + Tr(C1 + C2 - 2 (C1 C2)^1/2). At least two of each.

    The last trace is the sum of the singular values of the centred features' products, which needs
    no root of a DxD matrix and holds for fewer pictures than features too.
    """
    means, centred = [], []
    for features in (np.asarray(ours, np.float64), np.asarray(truth, np.float64)):
        means.append(features.mean(0))
        centred.append((features - means[-1]) / math.sqrt(len(features) - 1))
    spread = sum(float((part**2).sum()) for part in centred)
    shared = np.linalg.svd(centred[0] @ centred[1].T, compute_uv=False).sum()
    return max(0.0, float(((means[0] - means[1]) ** 2).sum() + spread - 2 * shared))
