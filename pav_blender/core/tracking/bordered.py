"""Least squares in which frames meet only their neighbours and a few shared unknowns.

The normal equations of a clip are a band (frames and their next two) with a border (what all frames
share). Banded Cholesky and a Schur complement solve them exactly, in time linear in the frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded

from ..kernels.cpu.threads import each


@dataclass(eq=False)
class Normal:
    """One clip's normal equations, F frames of n unknowns and S shared ones.

    own [F,n,n]; border [F,n,S]; shared [S,S]; gradient [F,n]; shared_gradient [S];
    couplings: for a distance of 1 and 2 frames the diagonal [F,n] of the block that joins frame i
    to frame i + distance.
    """

    own: np.ndarray
    border: np.ndarray
    shared: np.ndarray
    gradient: np.ndarray
    shared_gradient: np.ndarray
    couplings: tuple[np.ndarray, np.ndarray]


def solve(clips: list[Normal], damping: float) -> tuple[list[np.ndarray], np.ndarray]:
    """Steps that minimise the clips' summed quadratics: per clip [F,n], and the shared [S].

    damping: Levenberg-Marquardt's factor on the diagonals. Raises numpy.linalg.LinAlgError where
    the equations are not positive definite.
    """
    total = sum(clip.shared for clip in clips)
    total = total + damping * np.diag(np.diag(total))
    right = sum(clip.shared_gradient for clip in clips)
    partial = each(lambda index: _alone(clips[index], damping), len(clips))
    for clip, solved in zip(clips, partial, strict=True):
        border = clip.border.reshape(len(solved), -1)
        total = total - border.T @ solved[:, 1:]
        right = right - border.T @ solved[:, 0]
    shared_step = -cho_solve(cho_factor(total), right)
    steps = [
        (-solved[:, 0] - solved[:, 1:] @ shared_step).reshape(clip.gradient.shape)
        for solved, clip in zip(partial, clips, strict=True)
    ]
    return steps, shared_step


def _alone(clip: Normal, damping: float) -> np.ndarray:
    """The frames' equations solved for the gradient and for the border, [F n, 1 + S]."""
    frames, size, shared = clip.border.shape
    factor = cholesky_banded(_band(clip, damping), lower=True, overwrite_ab=True)
    both = np.concatenate([clip.gradient[..., None], clip.border], axis=2)
    return cho_solve_banded((factor, True), both.reshape(frames * size, shared + 1))


def _band(clip: Normal, damping: float) -> np.ndarray:
    """The lower band of the frames' equations as scipy stores it: row d holds the d-th diagonal."""
    frames, size = clip.gradient.shape
    reach = 2 * size + 1 if frames > 2 else size + 1 if frames > 1 else size
    band = np.zeros((reach, frames, size))
    for column in range(size):
        depth = size - column
        band[:depth, :, column] = clip.own[:, column:, column].T
    band[0] += damping * np.diagonal(clip.own, axis1=1, axis2=2)
    for distance, coupling in enumerate(clip.couplings, start=1):
        if frames > distance:
            band[distance * size] = coupling
    return band.reshape(reach, frames * size)
