"""The training loop: rays of a few frames, a step of Adam, and less and less empty space."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch

from .. import kernels
from ..config import Config
from ..deformation import Deformer
from ..field.avatar import Avatar
from ..field.field import Samples, condition
from ..field.identities import codes
from ..field.limits import overflowing
from ..rendering.render import Scene
from ..rendering.wearing import Wearing
from .attention import Attention
from .batches import KEPT_POSES, Poses, draw_pixels, pick_samples
from .frames import Frame, halved
from .losses import Loss, distortion, losses
from .occupancy import Visibility
from .watch import Watch

_FIRST_STEP = 8.0  # the first samples are this many times as far apart as the last
_LOOKS_A_RAY = 40  # the step is as fine as this many looks a ray allow
_SAMPLES = 1 << 14  # samples a batch, by the number of its rays
_MANY_SAMPLES = 1 << 18  # the same off the CPU, where few take as long as many
# Space is emptied at parts of the schedule, not at iterations: each time a few cells go that only
# poses not drawn of late show, so a training ten times as long would have ten times the holes.
_PRUNE_FROM = 0.15
_PRUNE_EVERY = 1 / 60
_CARVED = 0.5  # part of the schedule after which there is less to empty
_PRUNE_LATER = 1 / 15
_LEAST_BATCHES = 50  # iterations between two times
_WARM_UP = 20
# parts of the schedule until which pictures are a half and a quarter as large: there are more
# pixels than an avatar's minutes have rays, and small ones tell the most each
_COARSE = (0.4, 0.15)
_ENDED = 0.01  # transmittance at which a ray may be ended
_RENEWED = 1 / 16  # chance that a frame drawn is one that was not in use
_SMALL_ERROR = 1e-3  # mean squared error of a batch that is never a spike: 30 dB


@dataclass
class Status:
    """Where training stands: smoothed loss and PSNR of the batches, samples a ray, part of the
    space that is left, the next batch's step (metres) and rays, and the iteration after which
    space was last emptied."""

    iteration: int = 0
    seconds: float = 0.0
    loss: float = 0.0
    psnr: float = 0.0
    samples_per_ray: float = 0.0
    filled: float = 1.0
    step: float = 1e-3
    rays: int = 1
    pruned: int = 0


class Refines(Protocol):
    """Corrects frames; is told before each batch which part of the schedule is done. `state` is
    what an interrupted training must keep."""

    def advance(self, done: float) -> None: ...

    def __call__(self, frame: Frame) -> Frame: ...

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]: ...

    def restore(self, tensors: dict[str, torch.Tensor], header: dict[str, Any]) -> None: ...


class Trainer:
    """Holds what changes while an avatar learns. `minutes` plans the schedule by the clock."""

    def __init__(
        self,
        avatar: Avatar,
        frames: list[Frame],
        *,
        minutes: float | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.avatar = avatar
        self.device = torch.device(device)
        self.minutes = minutes
        self.config: Config = avatar.config
        self.status = Status(step=_FIRST_STEP * self.config.step, rays=self.config.rays // 8)
        self.random = np.random.default_rng(self.config.seed)
        self.generator = torch.Generator().manual_seed(self.config.seed)
        deformer = Deformer(avatar.canonical_vertices, avatar.triangles, self.config.frames)
        self.visibility = Visibility(avatar, deformer)
        self._codes = codes(avatar)
        self._poses = Poses(deformer, avatar.canonical_vertices, avatar.rigid_weights)
        self.attention = Attention()
        self._pyramid = [_by_appearance(frames, len(avatar.appearances))]
        for _ in _COARSE:
            frames = [halved(frame) for frame in frames]
            self._pyramid.append(_by_appearance(frames, len(avatar.appearances)))
        avatar.field.to(self.device)
        self.moments = {
            name: (torch.zeros_like(p), torch.zeros_like(p))
            for name, p in avatar.field.named_parameters()
        }
        # the tables' gradient never lies anywhere as a whole: see `encode_adam_step`
        for name, parameter in avatar.field.named_parameters():
            if name in ("tables", "still_tables"):
                parameter.requires_grad_(False)
        self.pools: dict[int, list[int]] = {}
        # what makes of frames drawn from whole pictures those that are learned from
        self.refiner: Refines | None = None
        self._mse = math.nan
        self.watch = Watch(floor=self.config.colour_weight * _SMALL_ERROR)

    @property
    def done(self) -> float:
        """Part of the schedule that lies behind, in [0, 1]."""
        if self.minutes is not None:
            return min(1.0, self.status.seconds / (60 * self.minutes))
        return min(1.0, self.status.iteration / self.config.iterations)

    def iterate(self) -> Status:
        """One iteration: batch, loss, backward, Adam; the occupancy now and then."""
        started = time.monotonic()
        config, status, field = self.config, self.status, self.avatar.field
        if self.refiner is not None:
            self.refiner.advance(self.done)
        frames = self._choose_frames()
        if self.refiner is not None:
            frames = [self.refiner(frame) for frame in frames]
        pixels = draw_pixels(frames, status.rays, self.random, self.attention)
        count = len(pixels.rays)
        with torch.no_grad():
            picked = pick_samples(
                self._poses,
                pixels,
                self.visibility,
                config,
                status.step,
                self.generator,
                self._codes,
            )
            samples = picked.samples.to(self.device)
            encoded = field.encode(samples)
        pixels, t = pixels.to(self.device), picked.t.to(self.device)
        sigma, rgb = field(samples, encoded=encoded.requires_grad_())
        colour, opacity, depth, weights = kernels.select(self.device).marching.composite(
            sigma, rgb, t, picked.width.to(self.device), samples.ray, count
        )
        background = torch.rand(count, 3, generator=self.generator).to(self.device)
        # what lies behind where a ray was ended by mistake must not be laid to what is before it
        counted = ~picked.ended.to(self.device) | (opacity.detach() > 1 - _ENDED)
        loss = losses(config, pixels, background, colour, opacity, depth, counted)
        total = loss.total + config.distortion_weight * distortion(weights, t, samples.ray, count)
        takes = self.watch.takes(float(total.detach()))
        if takes:
            total.backward()
            self._adam(samples, encoded)
            squared = loss.squared.mean(1).cpu().numpy()
            self.attention.note(pixels.frames, pixels.starts, pixels.tile, squared)
            density, seen = sigma.detach().cpu(), weights.detach().cpu()
            self.visibility.watch(picked.cells, density, seen, picked.width)
        status.iteration += 1
        if self._prunes_now():
            status.filled = self.visibility.prune()
            status.pruned = status.iteration
        if takes:
            self._note(loss, len(picked.t) / max(count, 1))
        self._plan(picked.looks / max(count, 1))
        status.seconds += time.monotonic() - started
        return status

    def sound(self) -> bool:
        """Whether the weights can be drawn and learned from, and the loss is not far above what it
        was."""
        if self.watch.astray or overflowing(self.avatar.field) is not None:
            return False
        moments = (values for pair in self.moments.values() for values in pair)
        return all(bool(torch.isfinite(values).all()) for values in moments)

    def other_batches(self, which: int) -> None:
        """Goes on from here with other random numbers: the same ones led astray."""
        self.random = np.random.default_rng([self.config.seed, which])
        self.generator.manual_seed(self.config.seed + which)
        self.watch.begin_anew()

    def check_restored(self) -> None:
        """ValueError where what a checkpoint said of frames is not of these."""
        for groups in self._pyramid:
            for frame in (frame for group in groups for frame in group):
                errors = self.attention.of(frame)
                if errors.dtype != np.float32 or errors.shape != (len(frame.tiles),):
                    raise ValueError(f"errors of {frame.name}")
        for group, pool in self.pools.items():
            fits = 0 <= group < len(self._pyramid[0])
            known = range(len(self._pyramid[0][group])) if fits else range(0)
            if not all(type(number) is int and number in known for number in pool):
                raise ValueError(f"frames in use of group {group}")

    def learn_from(self, frames: list[Frame]) -> None:
        """Takes in more frames of appearances that are there, once pictures are whole."""
        for group in self._pyramid[0]:
            group += [frame for frame in frames if frame.appearance == group[0].appearance]

    def scene(self, frame: Frame) -> Scene:
        """The avatar as it is now in a frame's pose, to be rendered."""
        row, field = frame.appearance, self.avatar.field
        space, version = self.visibility.spaces[row], self.visibility.version
        posed = self._poses(frame, space, version, self.config.reach)
        with torch.no_grad():
            worn = field.wearing([row])
            person = self._codes[row]
            seen = condition(self.config, frame.expression, posed.stance.turn, person)
        wearing = Wearing(worn, None, space, self.visibility.guide[row], person)
        return Scene(
            self.avatar, posed.mesh, posed.voxels, posed.stance, seen, wearing, changing=True
        )

    def _choose_frames(self) -> list[Frame]:
        """Frames of a batch: appearances in turn, frames at random; small pictures come first."""
        groups = self._pyramid[sum(self.done < until for until in _COARSE)]
        offset = int(self.random.integers(len(groups)))
        chosen = []
        for i in range(self.config.frames_per_batch):
            which = (offset + i) % len(groups)
            chosen.append(groups[which][self._draw(which, len(groups[which]))])
        return chosen

    def _draw(self, group: int, count: int) -> int:
        """A frame of `count`. Of a long clip only some are in use at a time, and new ones take
        their place little by little: to pose a frame takes as long as to learn from it."""
        # the rest is for those whose place was just taken, until they are forgotten
        size = max(1, KEPT_POSES * 3 // 4 // len(self._pyramid[0]))
        if count <= size:
            return int(self.random.integers(count))
        pool = self.pools.setdefault(group, [])
        if len(pool) < size:
            pool += self.random.integers(count, size=size).tolist()
        slot = int(self.random.integers(size))
        if self.random.random() < _RENEWED:
            pool[slot] = int(self.random.integers(count))
        return pool[slot]

    def _plan(self, looks: float) -> None:
        """Sets the next batch's step and size from what the last one looked at, a ray.

        While nothing is known of where the head ends, a ray passes much fog: few rays of few
        samples find out as well, and far sooner.
        """
        status, config = self.status, self.config
        wanted = status.step / config.step * (max(looks, 1.0) / _LOOKS_A_RAY) ** 0.2
        status.step = config.step * min(max(wanted, 1.0), _FIRST_STEP)
        wanted = _SAMPLES if self.device.type == "cpu" else _MANY_SAMPLES
        rays = wanted / max(status.samples_per_ray, 1.0)
        status.rays = int(min(max(rays, config.rays / 8), config.rays))

    def _prunes_now(self) -> bool:
        done, iteration = self.done, self.status.iteration
        since = iteration - self.status.pruned
        if done <= _PRUNE_FROM or since < _LEAST_BATCHES:
            return False
        return since >= round((_PRUNE_EVERY if done < _CARVED else _PRUNE_LATER) * iteration / done)

    def _adam(self, samples: Samples, encoded: torch.Tensor) -> None:
        config, field = self.config, self.avatar.field
        ops = kernels.select(self.device)
        step = self.status.iteration + 1
        late = max(0.0, self.done - config.decay_from) / (1 - config.decay_from)
        decay = config.final_learning_rate**late * min(1.0, step / _WARM_UP)
        rates = {
            "offset": config.offset_learning_rate,
            "latent": config.latent_learning_rate,
            "code": config.latent_learning_rate,
        }
        settings: dict[str, Any] = {
            "step": step,
            "beta1": config.beta1,
            "beta2": config.beta2,
            "eps": config.epsilon,
        }
        kept = {**settings, "zero_grad": False}
        for name, parameter in field.named_parameters():
            grad = parameter.grad
            if grad is None or parameter.numel() == 0:
                continue
            m, v = self.moments[name]
            lr = rates.get(name.partition(".")[0], config.learning_rate) * decay
            if name == "latent" and config.appearance == "surface":
                values = (parameter.data, grad, m, v)
                rows = [x.view(-1, x.shape[-1]) for x in values]
                ops.optimiser.sparse_adam_step(*rows, **kept, lr=lr)
            else:
                ops.optimiser.adam_step(parameter.data, grad, m, v, **kept, lr=lr)
            parameter.grad = None
        if encoded.grad is None:
            return
        own = field.layout.width
        grids = [(samples.canonical, encoded.grad[:, :own], "tables", field.layout)]
        if field.still_layout is not None:
            grids.append((samples.still, encoded.grad[:, own:], "still_tables", field.still_layout))
        ops.encoding.encode_adam_steps(
            [
                (points, grad, getattr(field, name).data, *self.moments[name], layout)
                for points, grad, name, layout in grids
            ],
            **settings,
            lr=config.table_learning_rate * decay,
        )

    def _note(self, loss: Loss, samples: float) -> None:
        status = self.status
        fresh = math.isnan(self._mse)
        keep = 0.0 if fresh else 0.98
        self._mse = loss.mse if fresh else keep * self._mse + (1 - keep) * loss.mse
        status.loss = keep * status.loss + (1 - keep) * float(loss.total.detach())
        status.samples_per_ray = keep * status.samples_per_ray + (1 - keep) * samples
        status.psnr = -10 * math.log10(max(self._mse, 1e-10))


def _by_appearance(frames: list[Frame], appearances: int) -> list[list[Frame]]:
    groups = ([f for f in frames if f.appearance == a] for a in range(appearances))
    return [group for group in groups if group]
