"""Metrics between pictures [H, W, 3], colours in [0, 1]."""

from __future__ import annotations

import math

import numpy as np

LARGEST_PSNR = 100.0  # what equal pictures score: reports hold no infinities


def psnr(picture: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB, over all pixels or those where mask [H, W] is true.

    nan where the mask is empty.
    """
    error = (np.asarray(picture, np.float64) - np.asarray(truth, np.float64)) ** 2
    if mask is not None:
        error = error[mask]
    if error.size == 0:
        return math.nan
    return min(LARGEST_PSNR, -10 * math.log10(max(float(error.mean()), 1e-12)))


def ssim(picture: np.ndarray, truth: np.ndarray) -> float:
    """Structural similarity (Wang et al. 2004): Gaussian window, sigma 1.5, over the picture."""
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
