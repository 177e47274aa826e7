"""Every setting of the method, in one frozen dataclass that is saved with the avatar."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Literal

from .errors import InputError

APPEARANCE_MODES = ("vertex", "surface", "global", "none")
FRAME_MODES = ("smooth", "affine", "rigid")
# from, to: what a file of settings may ask for before anything is made of that size
_LIMITS = {
    "levels": (1, 64),
    "log2_entries": (3, 24),
    "base_resolution": (1, 1 << 16),
    "finest_resolution": (1, 1 << 16),
    "shoulder_levels": (0, 64),
    "latent_channels": (0, 1024),
    "latent_size": (1, 8192),
    "global_channels": (0, 1 << 16),
    "hidden": (1, 4096),
    "geometry_channels": (1, 4096),
    "density_layers": (0, 64),
    "offset_layers": (0, 64),
    "colour_layers": (0, 64),
    "occupancy_resolution": (1, 1024),
    "iterations": (1, 1 << 40),
    "rays": (1, 1 << 24),
    "frames_per_batch": (1, 1 << 16),
    "seed": (0, (1 << 63) - 1),
}


@dataclass(frozen=True)
class Config:
    """Defaults are what measured best here; `Config.paper()` is the paper's own."""

    # multi-resolution hash encoding of the canonical point (Instant-NGP; paper, Implementation)
    levels: int = 12
    log2_entries: int = 18
    base_resolution: int = 16
    finest_resolution: int = 512
    # as many more levels for the place that rests with the shoulders: collars and hair that lies
    # on them do not turn with the skin they are nearest to
    shoulder_levels: int = 6

    # appearance embedding (paper, Learned Appearance Embedding)
    appearance: Literal["vertex", "surface", "global", "none"] = "vertex"
    latent_channels: int = 16
    latent_size: int = 512  # side of the texture, "surface" only
    appearance_code: bool = True  # one more vector an appearance, added to all its features
    global_channels: int = 512  # length of the one vector a clip, "global" only

    # networks (paper, Appearance Conditioned NeRF)
    hidden: int = 64
    geometry_channels: int = 16  # the first is the log-density
    density_layers: int = 1
    offset_layers: int = 1
    colour_layers: int = 1
    density_offset: bool = True
    # the density sees how the head is turned: collars and long hair do not move with the skin
    # they are nearest to
    sees_turn: bool = True
    # the paper's sees the expression too; some fifty values tell the filmed frames apart, and what
    # is learned by that does not hold for others
    sees_expression: bool = False
    # the paper's offset sees the embedding and the expression; seeing the point's geometry
    # features too lets one appearance fill space that another leaves empty
    offset_sees_geometry: bool = True
    # log-densities a millimetre of an untrained field: away from the mesh, and on it
    density_bias: float = -7.0
    log_density_limit: float = 6.0
    start_on_mesh: bool = True
    mesh_density: float = 1.0
    mesh_falloff: float = 0.008  # metres; solid to a fifth of it, then falling to density_bias
    mesh_skin: float = 0.2

    # deformation (paper, Personalized Deformable NeRF)
    frames: Literal["smooth", "affine", "rigid"] = "smooth"
    occupancy_resolution: int = 128
    reach: float = 0.13  # metres from the mesh that the field may fill

    # optimisation (paper, Optimization and Implementation)
    colour_weight: float = 50.0
    depth_weight: float = 10.0
    distortion_weight: float = 0.5  # against fog: fewer samples show the same
    # the paper's rates (2.5e-3, the offset's 2.5e-4) are for 15,000 iterations
    learning_rate: float = 5e-3
    offset_learning_rate: float = 5e-3
    table_learning_rate: float = 1e-2  # of the hash encoding
    latent_learning_rate: float = 1.5e-2  # of the appearances' features
    beta1: float = 0.9
    beta2: float = 0.99
    epsilon: float = 1e-15
    iterations: int = 15_000
    rays: int = 4096
    frames_per_batch: int = 4
    step: float = 1e-3  # metres between samples
    decay_from: float = 0.4  # part of the schedule after which the rates fall
    final_learning_rate: float = 0.03  # as a part of the first, at the end of the schedule
    seed: int = 0
    refine_poses: bool = False  # correct the track of frames while learning from them

    def __post_init__(self) -> None:
        if self.appearance not in APPEARANCE_MODES:
            raise InputError(f"appearance {self.appearance!r}: one of {APPEARANCE_MODES}")
        if self.frames not in FRAME_MODES:
            raise InputError(f"frames {self.frames!r}: one of {FRAME_MODES}")
        for name, (low, high) in _LIMITS.items():
            if not low <= getattr(self, name) <= high:
                raise InputError(f"{name} {getattr(self, name)}: from {low} to {high}")
        for setting in dataclasses.fields(self):
            value = getattr(self, setting.name)
            if isinstance(value, float) and not math.isfinite(value):
                raise InputError(f"{setting.name} must be a finite number, not {value}")
        if self.finest_resolution < self.base_resolution:
            raise InputError(
                f"finest_resolution {self.finest_resolution}: not below base_resolution "
                f"{self.base_resolution}"
            )
        for name in ("step", "reach"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} {getattr(self, name)}: metres, above 0")

    @classmethod
    def paper(cls) -> Config:
        """The settings of the paper; where it is silent, INSTA's (reference in docs)."""
        return cls(
            levels=16,
            finest_resolution=2048,
            shoulder_levels=0,
            density_layers=2,
            colour_layers=2,
            frames="rigid",
            appearance_code=False,
            start_on_mesh=False,
            density_bias=-4.5,
            offset_sees_geometry=False,
            sees_turn=False,
            sees_expression=True,
            distortion_weight=0.0,
            learning_rate=2.5e-3,
            offset_learning_rate=2.5e-4,
            table_learning_rate=2.5e-3,
            latent_learning_rate=2.5e-3,
            final_learning_rate=1.0,
        )

    @classmethod
    def preset(cls, name: str) -> Config:
        """ "default" or "paper"."""
        if name not in ("default", "paper"):
            raise InputError(f"preset {name!r}: one of default, paper")
        return cls.paper() if name == "paper" else cls()

    @property
    def embedding_channels(self) -> int:
        """Length of Z^x, what the networks see of the appearance."""
        sizes = {"none": 0, "global": self.global_channels}
        return sizes.get(self.appearance, self.latent_channels)

    @property
    def one_geometry(self) -> bool:
        """Whether all appearances have one density, and so fill the same space: INSTA, and the
        paper's ablation without an offset."""
        return not (self.density_offset and self.embedding_channels)

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Config:
        """The reverse of to_json; InputError for a setting this program does not know."""
        if not isinstance(values, dict):
            raise InputError("the settings are missing")
        known = {f.name: type(f.default) for f in dataclasses.fields(cls)}
        for name, value in values.items():
            if name not in known:
                raise InputError(
                    f"unknown setting {name[:80]!r}; was it written by a newer version?"
                )
            if known[name] is not type(value) and not (known[name] is float and type(value) is int):
                raise InputError(
                    f"setting {name!r} is {value!r:.80}; expected {known[name].__name__}"
                )
        return cls(**values)
