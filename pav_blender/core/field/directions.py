"""Encoding of the view direction: real spherical harmonics to degree 4 (16 values)."""

from __future__ import annotations

import torch

CHANNELS = 16


def spherical_harmonics(directions: torch.Tensor) -> torch.Tensor:
    """Unit directions [N, 3] -> [N, 16], the basis of Instant-NGP's direction encoding."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    xy, yz, xz = x * y, y * z, x * z
    return torch.stack(
        [
            torch.full_like(x, 0.28209479),
            -0.48860251 * y,
            0.48860251 * z,
            -0.48860251 * x,
            1.09254843 * xy,
            -1.09254843 * yz,
            0.94617470 * zz - 0.31539157,
            -1.09254843 * xz,
            0.54627422 * (xx - yy),
            -0.59004359 * y * (3 * xx - yy),
            2.89061144 * xy * z,
            -0.45704580 * y * (5 * zz - 1),
            0.37317633 * z * (5 * zz - 3),
            -0.45704580 * x * (5 * zz - 1),
            1.44530572 * z * (xx - yy),
            -0.59004359 * x * (xx - 3 * yy),
        ],
        dim=-1,
    )
