"""Adam (Kingma and Ba 2015) in place, in plain torch: oracle, and path off the CPU."""

from __future__ import annotations

import torch
from torch import Tensor

from ...errors import InputError


@torch.no_grad()
def adam_step(
    param: Tensor,
    grad: Tensor,
    m: Tensor,
    v: Tensor,
    *,
    step: int,
    lr: float,
    beta1: float = 0.9,
    beta2: float = 0.99,
    eps: float = 1e-15,
    weight_decay: float = 0.0,
    zero_grad: bool = True,
) -> None:
    """One step on all of param; m and v are its moments, step counts from 1. As torch.optim.Adam.

    All four tensors have one shape and are changed in place; grad is zeroed if zero_grad.
    """
    check_adam(param, grad, m, v, step)
    slope = grad + weight_decay * param if weight_decay else grad
    m.lerp_(slope, 1 - beta1)
    v.mul_(beta2).addcmul_(slope, slope, value=1 - beta2)
    denominator = (v / (1 - beta2**step)).sqrt_().add_(eps)
    param.addcdiv_(m, denominator, value=-lr / (1 - beta1**step))
    if zero_grad:
        grad.zero_()


@torch.no_grad()
def sparse_adam_step(
    param: Tensor,
    grad: Tensor,
    m: Tensor,
    v: Tensor,
    rows: Tensor | None = None,
    *,
    step: int,
    lr: float,
    beta1: float = 0.9,
    beta2: float = 0.99,
    eps: float = 1e-15,
    weight_decay: float = 0.0,
    zero_grad: bool = True,
) -> None:
    """One step on the given rows of param [R,C]; other rows and their moments stay as they are.

    rows holds indices without repeats; None takes every row whose gradient is not all zero.
    """
    check_adam(param, grad, m, v, step)
    rows = touched_rows(param, grad, rows)
    tensors = (param, grad, m, v)
    parts = [tensor[rows] for tensor in tensors]
    adam_step(
        *parts,
        step=step,
        lr=lr,
        beta1=beta1,
        beta2=beta2,
        eps=eps,
        weight_decay=weight_decay,
        zero_grad=zero_grad,
    )
    for tensor, part in zip(tensors, parts, strict=True):
        tensor[rows] = part


def touched_rows(param: Tensor, grad: Tensor, rows: Tensor | None) -> Tensor:
    """The rows a sparse step changes, checked, as int64."""
    if param.ndim != 2:
        raise InputError(f"sparse_adam_step: param has shape {tuple(param.shape)}, need [R,C]")
    if rows is None:
        return (grad != 0).any(1).nonzero().squeeze(1)
    if rows.ndim != 1:
        raise InputError(f"sparse_adam_step: rows has shape {tuple(rows.shape)}, need [K]")
    if len(rows) and (int(rows.min()) < 0 or int(rows.max()) >= len(param)):
        raise InputError(
            f"sparse_adam_step: rows hold {int(rows.min())} to {int(rows.max())}, "
            f"need 0 to {len(param) - 1}"
        )
    return rows.long()


def check_adam(param: Tensor, grad: Tensor, m: Tensor, v: Tensor, step: int) -> None:
    """Raise InputError unless all four have one shape and the step is at least 1."""
    shapes = [tuple(tensor.shape) for tensor in (param, grad, m, v)]
    if len(set(shapes)) != 1:
        raise InputError(f"adam_step: param, grad, m and v have shapes {shapes}, need one")
    if step < 1:
        raise InputError(f"adam_step: step is {step}, steps count from 1")
