"""Between the avatar's display-referred sRGB and Blender's scene-linear, premultiplied colours."""

from __future__ import annotations

import numpy as np


def srgb_to_linear(values: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, elementwise."""
    values = np.asarray(values, np.float32)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4).astype(
        np.float32
    )


def linear_to_srgb(values: np.ndarray) -> np.ndarray:
    """The reverse of srgb_to_linear; negative values read 0."""
    values = np.maximum(np.asarray(values, np.float32), 0)
    return np.where(
        values <= 0.0031308, values * 12.92, 1.055 * values ** (1 / 2.4) - 0.055
    ).astype(np.float32)


def linear_premultiplied(rgba: np.ndarray) -> np.ndarray:
    """Straight sRGB [..., 4] -> premultiplied scene-linear [..., 4]."""
    alpha = rgba[..., 3:4]
    return np.concatenate([srgb_to_linear(rgba[..., :3]) * alpha, alpha], -1).astype(np.float32)
