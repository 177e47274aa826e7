"""A field held still for one picture, for kernels that run whole rays."""

from __future__ import annotations

import torch

from ..kernels.structures import Frozen, Layers
from .field import Field, Mlp, Worn
from .mixture import EMPTY, FIRMNESS, SOLID, THICK, Mixture


def freeze(
    field: Field, condition: torch.Tensor, worn: Worn, mixture: Mixture | None = None
) -> Frozen:
    """The field under a condition [E] (`field.condition`), for the only appearance in `worn`, or
    for a mixture of those there."""
    config = field.config
    embedding, geometry = config.embedding_channels, config.geometry_channels
    count, latent = len(worn.latent), worn.latent.detach()
    if worn.code.shape[1]:
        latent = latent + worn.code.detach().view(count, *[1] * (latent.dim() - 2), -1)
    nothing = latent.new_zeros(0)
    same = nothing  # an embedding that is the same everywhere
    if latent.dim() == 2 and count == 1:
        same, latent = latent[0], latent.new_zeros(1, 1, 0)
    elif latent.dim() == 2:  # the same at every vertex, but not for every appearance
        vertices = int(field.triangles.max()) + 1
        latent = latent[:, None].expand(-1, vertices, -1)
    one = torch.ones(1, 1, 1, 1)
    colour = _folded(field.colour, nothing, same)
    offset = None
    if field.offset is not None:
        offset = _folded(field.offset, condition, same)
        seen = offset.weights[0]
        split = embedding - len(same)
        full = seen.new_zeros(len(seen), split + geometry)  # the log-density itself is not seen
        full[:, :split] = seen[:, :split]
        if config.offset_sees_geometry:
            full[:, split + 1 :] = seen[:, split:]
        offset.weights[0] = full
    encodings = [(field.tables.detach(), field.layout)]
    if field.still_layout is not None:
        encodings.append((field.still_tables.detach(), field.still_layout))
    rise = config.mesh_density - config.density_bias if config.start_on_mesh else 0.0
    surface = config.appearance == "surface"
    return Frozen(
        tuple(encodings),
        _folded(field.density, condition, nothing),
        offset,
        colour,
        field.colour.group_weight.detach().T.contiguous(),
        latent,
        field.corner_uvs if surface else field.corner_uvs[:0],
        (config.density_bias, rise, config.mesh_falloff, config.mesh_skin),
        config.log_density_limit,
        one if mixture is None else mixture.shares.cpu(),
        one.bool() if mixture is None else mixture.filled.cpu(),
        (EMPTY, SOLID, FIRMNESS, THICK),
    )


def _folded(network: Mlp, group: torch.Tensor, same: torch.Tensor) -> Layers:
    """A network's layers; a group's input and the first of a sample's, that are the same for all,
    go into the first bias."""
    weights = [weight.detach() for weight in network.weights]
    biases = [bias.detach() for bias in network.biases]
    first = weights[0][:, : len(same)] @ same
    if len(group):
        first = first + network.group_weight.detach() @ group
    biases[0] = biases[0] + first
    weights[0] = weights[0][:, len(same) :]
    return Layers(weights, biases)
