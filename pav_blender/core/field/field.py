"""The appearance-conditioned canonical field (paper, Learned Appearance Embedding and
Appearance Conditioned NeRF).

    F_density: (phi(x_c), e)      -> log-density, geometry features
    F_offset:  (Z^x, e)           -> offset of the log-density
    F_color:   (Z^x, d, features) -> colour

Densities are per millimetre and add before the exponential, so that their sum cannot be negative.
They start from the tracked mesh, opaque on it and near nothing away from it (`start_on_mesh`): a
field that starts as fog spends minutes finding out where the head is, and thins what is solid
while it clears the rest, since opaque samples have no gradient that would resist.
What is constant over a frame (e) or a ray (d) enters a network's first layer as a bias computed
once a frame or ray: the same numbers, for far fewer operations.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import nn

from .. import kernels
from ..config import Config
from ..kernels.reference.encoding import FEATURES, Layout
from . import directions


@dataclass
class Samples:
    """N points to evaluate, packed; see the module's conventions for indices.

    canonical [N, 3] in the field's unit box; still [N, 3] there too, but carried along with the
    shoulders (`deformation.rigid.Stance`); triangle [N] int32; barycentric [N, 3];
    distance [N], metres from the posed mesh;
    appearance [N] int32, frame [N] int32, ray [N] int32 (rows of what follows);
    condition [frames, E] (see `condition`); direction [rays, 3], unit, in the head's own axes.
    """

    canonical: torch.Tensor
    still: torch.Tensor
    triangle: torch.Tensor
    barycentric: torch.Tensor
    distance: torch.Tensor
    appearance: torch.Tensor
    frame: torch.Tensor
    ray: torch.Tensor
    condition: torch.Tensor
    direction: torch.Tensor

    def to(self, device: torch.device) -> Samples:
        return Samples(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})


TURN = 3


def condition(
    config: Config,
    expression: np.ndarray | torch.Tensor,
    turn: np.ndarray,
    person: torch.Tensor | None = None,
) -> torch.Tensor:
    """What the density depends on besides the place: of the expression [E] and the head's turn [3]
    (`deformation.rigid.Stance`) what the settings let it see; person: of several, whose head it is
    (`identities.code`)."""
    seen = torch.as_tensor(expression).float() if config.sees_expression else torch.empty(0)
    if config.sees_turn:
        seen = torch.cat([seen, torch.from_numpy(turn)])
    return seen if person is None else torch.cat([seen, person])


@dataclass
class Worn:
    """What an appearance looks up: latent features [A, ...] and a code [A, C or 0]."""

    latent: torch.Tensor
    code: torch.Tensor


def _normal(values: torch.Tensor, deviation: float) -> torch.Tensor:
    """Fills with normal noise, in place; but what has no values stays as it is, since torch would
    load its compiler for that: a second before an avatar's first picture."""
    return values if values.is_meta else nn.init.normal_(values, 0, deviation)


class Mlp(nn.Module):
    """Weights of a ReLU network whose first layer also sees inputs constant over a group."""

    def __init__(
        self, inputs: int, group_inputs: int, hidden: int, layers: int, outputs: int
    ) -> None:
        super().__init__()
        sizes = [inputs, *[hidden] * layers, outputs]
        self.weights = nn.ParameterList(
            nn.Parameter(torch.empty(o, i)) for i, o in itertools.pairwise(sizes)
        )
        self.biases = nn.ParameterList(nn.Parameter(torch.zeros(o)) for o in sizes[1:])
        self.group_weight = nn.Parameter(torch.zeros(hidden, group_inputs))
        for weight in self.weights:
            bound = math.sqrt(6 / weight.shape[1])  # He, uniform
            nn.init.uniform_(weight, -bound, bound)

    def forward(
        self, x: torch.Tensor, group_input: torch.Tensor, group: torch.Tensor
    ) -> torch.Tensor:
        """x [N, inputs], group_input [G, group_inputs], group [N] int32 -> [N, outputs]."""
        ops = kernels.select(x.device)
        bias = group_input @ self.group_weight.T
        return ops.mlp.mlp(x, list(self.weights), list(self.biases), bias, group)

    def network(self, compiled: Any, group_input: torch.Tensor) -> Any:
        """As the compiled kernels take it."""
        bias = group_input @ self.group_weight.T
        return compiled.Network(list(self.weights), list(self.biases), bias)


class Field(nn.Module):
    """The networks and tables of one avatar; its `state_dict` is what a `.pav` holds.

    triangles [T, 3] int32 and corner_uvs [T, 3, 2] (UV at each triangle's corners) are the mesh's
    and not learned. people: how many identities it tells apart, 0 for one.
    """

    triangles: torch.Tensor
    corner_uvs: torch.Tensor

    def __init__(
        self,
        config: Config,
        appearances: int,
        expressions: int,
        triangles: torch.Tensor,
        corner_uvs: torch.Tensor,
        vertices: int,
        people: int = 0,
    ) -> None:
        super().__init__()
        self.config = config
        self.layout = Layout(
            config.levels, config.log2_entries, config.base_resolution, config.finest_resolution
        )
        self.register_buffer("triangles", triangles.int().contiguous(), persistent=False)
        self.register_buffer("corner_uvs", corner_uvs.float().contiguous(), persistent=False)
        tables = torch.empty(self.layout.entries, FEATURES)
        self.tables = nn.Parameter(nn.init.uniform_(tables, -1e-4, 1e-4))
        # what rests on the shoulders has features of its own, where a turning head moves nothing
        self.still_layout: Layout | None = None
        if config.shoulder_levels:
            self.still_layout = Layout(
                config.shoulder_levels,
                config.log2_entries,
                config.base_resolution,
                config.finest_resolution,
            )
            tables = torch.empty(self.still_layout.entries, FEATURES)
            self.still_tables = nn.Parameter(nn.init.uniform_(tables, -1e-4, 1e-4))
        shape = {
            "vertex": (appearances, vertices, config.latent_channels),
            "surface": (
                appearances,
                config.latent_size,
                config.latent_size,
                config.latent_channels,
            ),
            "global": (appearances, config.global_channels),
            "none": (appearances, 0),
        }[config.appearance]
        self.latent = nn.Parameter(_normal(torch.empty(shape), 0.1))
        # what an appearance's features have in common: every sample teaches it, so that
        # appearances part company long before each vertex was seen often
        mapped = config.appearance in ("vertex", "surface")
        codes = config.latent_channels if config.appearance_code and mapped else 0
        self.code = nn.Parameter(_normal(torch.empty(appearances, codes), 0.5))
        embedding, geometry = config.embedding_channels, config.geometry_channels
        conditions = config.sees_expression * expressions + config.sees_turn * TURN + people
        self.density = Mlp(
            self.encoded_width, conditions, config.hidden, config.density_layers, geometry
        )
        self.offset: Mlp | None = None
        if config.density_offset and embedding:
            seen = geometry - 1 if config.offset_sees_geometry else 0
            self.offset = Mlp(embedding + seen, conditions, config.hidden, config.offset_layers, 1)
            # starts as next to no offset: the shared density comes first
            _normal(self.offset.weights[-1], 1e-2)
        self.colour = Mlp(
            geometry + embedding, directions.CHANNELS, config.hidden, config.colour_layers, 3
        )

    def embedding(self, samples: Samples, worn: Worn) -> torch.Tensor:
        """Z^x [N, C]: the appearance's latent features at the nearest surface point."""
        ops = kernels.select(self.tables.device)
        if self.config.appearance == "vertex":
            latent = worn.latent
            if worn.code.shape[1]:  # shares of vertices add up to 1
                latent = latent + worn.code[:, None]
            return ops.encoding.read_vertices(
                latent, samples.appearance, self.triangles, samples.triangle, samples.barycentric
            )
        if self.config.appearance == "surface":
            corners = self.corner_uvs[samples.triangle.long()]
            uv = (corners * samples.barycentric[:, :, None]).sum(1)
            features = ops.encoding.read_texture(worn.latent, samples.appearance, uv)
            return (
                features + worn.code[samples.appearance.long()] if worn.code.numel() else features
            )
        return worn.latent[samples.appearance.long()]

    @property
    def encoded_width(self) -> int:
        """Features of an encoded sample."""
        return self.layout.width + (self.still_layout.width if self.still_layout else 0)

    def encode(self, samples: Samples) -> torch.Tensor:
        """phi(x_c), and that of the place that rests with the shoulders, [N, encoded_width]."""
        grids = [(samples.canonical, self.tables, self.layout)]
        if self.still_layout is not None:
            grids.append((samples.still, self.still_tables, self.still_layout))
        return kernels.select(self.tables.device).encoding.encode_all(grids)

    def geometry(
        self, samples: Samples, worn: Worn | None = None, encoded: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Density [N] per metre, and what the colour depends on besides the view [N, C].

        `worn` stands in for the learned appearances, e.g. some of them; `encoded` for phi(x_c),
        where it is at hand.
        """
        if encoded is None:
            encoded = self.encode(samples)
        geometry = self.density(encoded, samples.condition, samples.frame)
        raw, features = geometry[:, :1], geometry[:, 1:]
        embedding = self.embedding(samples, worn or self.worn)
        if self.offset is not None:
            sees = self.config.offset_sees_geometry
            seen = torch.cat([embedding, features], 1) if sees else embedding
            raw = raw + self.offset(seen, samples.condition, samples.frame)
        inputs = torch.cat([embedding, raw, features], 1)
        return self._density(raw, samples.distance), inputs

    def shade(
        self, inputs: torch.Tensor, direction: torch.Tensor, ray: torch.Tensor
    ) -> torch.Tensor:
        """Colour [N, 3], sRGB in [0, 1]: inputs [N, C] from `geometry`, unit directions [R, 3] in
        the head's axes and each sample's row of them [N] int32."""
        view = directions.spherical_harmonics(direction)
        return torch.sigmoid(self.colour(inputs, view, ray))

    def untrained(self, distance: torch.Tensor) -> torch.Tensor:
        """Log-density a millimetre of an untrained field, metres from the mesh."""
        config = self.config
        if not config.start_on_mesh:
            return torch.full_like(distance, config.density_bias)
        near = 1 - (distance / config.mesh_falloff - config.mesh_skin).clamp(0, 1)
        return config.density_bias + near * (config.mesh_density - config.density_bias)

    def _density(self, raw: torch.Tensor, distance: torch.Tensor) -> torch.Tensor:
        config = self.config
        log_density = raw[:, 0] + self.untrained(distance)
        # the clamp also stops the gradient there, so that weights do not run away
        return torch.exp(torch.clamp(log_density, max=config.log_density_limit)) * 1e3

    def forward(
        self, samples: Samples, worn: Worn | None = None, encoded: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Density [N] per metre and colour [N, 3], sRGB in [0, 1]; arguments as `geometry`."""
        compiled = getattr(kernels.select(self.device), "networks", None)
        if compiled is None:
            density, inputs = self.geometry(samples, worn, encoded)
            return density, self.shade(inputs, samples.direction, samples.ray)
        config, offset = self.config, None
        view = directions.spherical_harmonics(samples.direction)
        if self.offset is not None:
            offset = self.offset.network(compiled, samples.condition)
            offset.weights[0] = self.spread(offset.weights[0])
        return compiled.evaluate(
            self.encode(samples) if encoded is None else encoded,
            self.embedding(samples, worn or self.worn),
            samples.distance,
            samples.frame,
            samples.ray,
            self.density.network(compiled, samples.condition),
            offset,
            self.colour.network(compiled, view),
            self.untrained_numbers,
            config.log_density_limit,
        )

    def spread(self, weight: torch.Tensor) -> torch.Tensor:
        """The offset's first weight [hidden, C] as one of the embedding and the whole geometry: the
        log-density is not seen."""
        config = self.config
        own, rest = config.embedding_channels, config.geometry_channels
        if config.offset_sees_geometry:
            return torch.cat(
                [weight[:, :own], weight.new_zeros(len(weight), 1), weight[:, own:]], 1
            )
        return torch.nn.functional.pad(weight, (0, rest))

    @property
    def untrained_numbers(self) -> tuple[float, float, float, float]:
        """What `untrained` is made of, as `structures.Frozen` has it."""
        config = self.config
        rise = config.mesh_density - config.density_bias if config.start_on_mesh else 0.0
        return config.density_bias, rise, config.mesh_falloff, config.mesh_skin

    @property
    def device(self) -> torch.device:
        """Where the networks and tables are."""
        return self.tables.device

    @property
    def worn(self) -> Worn:
        """The learned appearances themselves."""
        return Worn(self.latent, self.code)

    def wearing(self, rows: list[int]) -> Worn:
        """The appearances in `rows` alone."""
        return Worn(self.latent.detach()[rows], self.code.detach()[rows])
