"""A picture of an avatar: rays marched in waves, front to back, until they are opaque."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

from .. import kernels
from ..deformation import Clearance, PosedMesh, Thrift, Voxels, voxels
from ..deformation.rigid import Stance, stance
from ..errors import Cancelled, InputError
from ..field.avatar import Avatar
from ..field.field import Samples, condition
from ..field.frozen import freeze
from ..field.mixture import geometry
from ..kernels.cpu.threads import run_chunks, torch_alone
from ..kernels.structures import Frozen, Known, Picks, Probing, Traced, Wave
from .cameras import Camera
from .footprint import footprint
from .rays import RayBatch, camera_rays, pack, samples_of, tiled
from .sparing import passes
from .wearing import Appearance, Wearing, deformer_of, short_tables_of, wearing_of

_LEAST_CHUNK = 1 << 9  # rays a thread takes at a time, at least
_FAR_WAVE = 24  # samples a ray between two looks, where every look waits for a device
_FINEST, _COARSEST = 1e-5, 0.1  # metres between places
# float32 counts micrometres up to some metres: what is far off is brought near, by whole strides so
# that nothing changes where nothing is far
_SHIFT = 64.0  # metres, of a mesh that is away from the origin
_STRIDE = 16.0  # metres, of rays that come from afar
_SMALLEST, _LARGEST = 1 / 8, 4.0  # times the canonical mesh: what a posed one may measure
_MOST = 1e3  # the largest value of an expression; filmed ones are from 0 to 1


@dataclass(frozen=True)
class RenderSettings:
    """step: metres between places; transmittance: a ray ends when less of it is left.

    skip: pass over voxels known to be empty, look only at the middle of `probe` places that follow
    one another, or of `longest` that add no more than `share` to a pixel by what is known of the
    density there (`guide`), and at those beside it only where that adds more than `tolerance`;
    negligible: weight a metre below which a sample's colour is not asked for; agreement: a pixel
    between four that differ by less is their mean (`sparing`; 0: every pixel is traced); brief:
    tables and networks in bfloat16 where the processor multiplies it; wave: samples a ray between
    two looks at its transmittance; chunk: rays that a thread takes at a time, at most.
    """

    step: float = 1e-3
    transmittance: float = 1e-2
    skip: bool = True
    share: float = 0.02
    longest: int = 4
    probe: int = 3
    tolerance: float = 0.2
    negligible: float = 1.0
    agreement: float = 0.06
    brief: bool = True
    wave: int = 3
    chunk: int = 1 << 13

    def __post_init__(self) -> None:
        if not _FINEST <= self.step <= _COARSEST:
            raise InputError(f"step {self.step}: metres, from {_FINEST:g} to {_COARSEST:g}")
        for name in ("transmittance", "share", "tolerance", "negligible", "agreement"):
            value = getattr(self, name)
            if not 0 <= value < np.inf:
                raise InputError(f"{name} {value}: a finite number, 0 or more")
        for name in ("longest", "probe", "wave", "chunk"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} {getattr(self, name)}: at least 1")

    @classmethod
    def preset(cls, name: str) -> RenderSettings:
        """ "preview" (fast), "final", "reference" (every sample, to the end of the ray)."""
        presets = {
            "preview": cls(
                step=2.5e-3,
                probe=2,
                tolerance=0.4,
                share=0.05,
                transmittance=2e-2,
                negligible=2.0,
                agreement=0.1,
            ),
            "final": cls(),
            "reference": cls(
                step=3.9e-4,
                transmittance=0.0,
                skip=False,
                negligible=0.0,
                agreement=0.0,
                brief=False,
                wave=64,
            ),
        }
        if name not in presets:
            raise InputError(f"quality {name!r}: one of {', '.join(presets)}")
        return presets[name]


@dataclass(eq=False)
class Picture:
    """rgba [H, W, 4] float32, straight sRGB; depth [H, W] float32, metres along z, inf if empty;
    evaluations: densities that were evaluated for it."""

    rgba: np.ndarray
    depth: np.ndarray
    evaluations: int


@dataclass(eq=False)
class Scene:
    """An avatar in a pose, wearing something: what all rays of a picture share. `origin` [3]
    metres: where in the world the scene's own coordinates begin; changing: nothing of the avatar is
    kept for other scenes, since it is being trained."""

    avatar: Avatar
    mesh: PosedMesh
    voxels: Voxels
    stance: Stance
    condition: torch.Tensor
    wearing: Wearing
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    changing: bool = False

    @property
    def clearance(self) -> Clearance:
        """Where anything may be, in canonical space."""
        return self.wearing.space

    @cached_property
    def known(self) -> Known:
        """What the guide knows of the density in each voxel."""
        return kernels.select("cpu").tracing.known_density(self.voxels, self.wearing.guide)

    @cached_property
    def frozen(self) -> Frozen:
        """The field held still."""
        return freeze(self.avatar.field, self.condition, self.wearing.worn, self.wearing.mixture)

    @cached_property
    def packed(self) -> tuple[Any, ...]:
        """The same as compiled functions take it, in bfloat16 where the processor allows."""
        tracing = kernels.select("cpu").tracing
        if self.changing:
            return tracing.arrays_of(self.frozen, tracing.short_tables(self.frozen))
        return tracing.arrays_of(self.frozen, short_tables_of(self.avatar, self.frozen))

    @cached_property
    def packed_exactly(self) -> tuple[Any, ...]:
        """The same in float32."""
        return kernels.select("cpu").tracing.arrays_of(self.frozen)


def pose_scene(
    avatar: Avatar,
    vertices: np.ndarray,
    appearance: Appearance,
    expression: np.ndarray | None = None,
) -> Scene:
    """vertices [V, 3] metres, expression [E] (zeros if None). InputError for what does not fit.

    float64 vertices may be as far from the world's origin as one likes.
    """
    vertices = np.asarray(vertices)
    if vertices.shape != avatar.canonical_vertices.shape:
        raise InputError(
            f"the mesh has {len(vertices)} vertices; this avatar was trained on a head with "
            f"{len(avatar.canonical_vertices)}"
        )
    if not np.isfinite(vertices).all():
        bad = np.flatnonzero(~np.isfinite(vertices).all(1))
        raise InputError(
            f"the mesh has {len(bad)} vertices that are not finite, the first is number {bad[0]}"
        )
    count = len(avatar.expression_names)
    values = np.zeros(count, np.float32) if expression is None else np.asarray(expression)
    if values.shape != (count,):
        raise InputError(f"expression: {values.shape} values; the avatar takes {count}")
    for name, value in zip(avatar.expression_names, values, strict=True):
        if not abs(value) <= _MOST:
            raise InputError(f"expression {name!r} is {value}: from {-_MOST:g} to {_MOST:g}")
    deformer = deformer_of(avatar)
    used = deformer.referenced.numpy()
    canonical = avatar.canonical_vertices[used]
    _check_size(canonical, vertices[used])
    origin = np.round(vertices[used].mean(0, dtype=np.float64) / _SHIFT) * _SHIFT
    vertices = np.ascontiguousarray(vertices - origin, np.float32)
    wearing = wearing_of(avatar, appearance)
    stands = stance(canonical, vertices[used], avatar.rigid_weights[used])
    mesh = deformer.pose(vertices)
    filled = voxels(mesh, wearing.space, avatar.config.reach)
    seen = condition(avatar.config, values.astype(np.float32), stands.turn, wearing.person)
    return Scene(avatar, mesh, filled, stands, seen, wearing, origin)


def _check_size(canonical: np.ndarray, posed: np.ndarray) -> None:
    """InputError unless a posed mesh is about as large as the canonical one: what a step along a
    ray is, and how much memory a pose takes, goes by metres."""
    size, usual = (float(np.ptp(vertices, 0).max()) for vertices in (posed, canonical))
    if not _SMALLEST * usual <= size <= _LARGEST * usual:
        raise InputError(
            f"the posed mesh is {size:.3g} m across, the avatar's head {usual:.3g} m; from "
            f"{_SMALLEST:g} to {_LARGEST:g} times as much can be drawn: vertices are metres"
        )


def render(
    avatar: Avatar,
    vertices: np.ndarray,
    camera: Camera,
    appearance: Appearance,
    settings: RenderSettings | None = None,
    *,
    expression: np.ndarray | None = None,
    region: tuple[int, int, int, int] | None = None,
    progress: Callable[[float], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Picture:
    """Renders the avatar on a posed mesh [V, 3]; the paper's Eq. 2 as a quadrature.

    appearance: a name, or weights by name, each a number or one a vertex. region: only the pixels
    (x0, y0, x1, y1), top-left origin. Raises InputError for input that does not fit and Cancelled
    when `should_stop()`.
    """
    if region is not None:
        camera = camera.window(*region)
    with torch.inference_mode(), torch_alone():
        scene = pose_scene(avatar, vertices, appearance, expression)
    return render_scene(scene, camera, settings, progress=progress, should_stop=should_stop)


def render_scene(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings | None = None,
    *,
    limit: np.ndarray | None = None,
    progress: Callable[[float], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Picture:
    """Renders an avatar that `pose_scene` posed, as often as one likes.

    limit [H, W]: how far each pixel sees, metres along the camera's axis: what lies behind is
    neither looked at nor shown. Raises Cancelled when `should_stop()`, InputError for a limit that
    does not fit.
    """
    settings = settings or RenderSettings()
    if limit is not None and np.shape(limit) != (camera.height, camera.width):
        raise InputError(
            f"limit: {np.shape(limit)}; the picture is {(camera.height, camera.width)}"
        )
    if limit is not None and np.isnan(limit).any():
        raise InputError("limit: some pixels see as far as what is not a number")
    camera = camera.moved(-scene.origin)
    before = _before(scene, camera)
    caller, done, evaluations = threading.get_ident(), 0, 0
    counting = threading.Lock()
    limits = None if limit is None else np.asarray(limit, np.float32).reshape(-1)
    with torch.inference_mode(), torch_alone():
        if _compiled(scene, settings):
            scene.known, _field(scene, settings)
        order = tiled(camera.width, camera.height)
        count = len(order)
        rgba = np.zeros((count, 4), np.float32)
        depth = np.full(count, np.inf, np.float32)

        def trace(start: int, stop: int, order: np.ndarray) -> None:
            nonlocal done, evaluations
            # who asked for the picture may not be asked from another thread: Blender's is one
            ours = threading.get_ident() == caller
            if ours and should_stop is not None and should_stop():
                raise Cancelled("rendering was cancelled")
            pixels = order[start:stop]
            far = None if limits is None else limits[pixels]
            rows, columns = np.divmod(pixels, camera.width)
            rays = camera_rays(camera, columns, rows, far, before)
            if where is not None:
                rays = rays.within(*where.between(rows, columns))
            with torch.inference_mode():
                rgba[pixels], depth[pixels], evaluated = _trace(scene, rays, settings)
            with counting:
                done, evaluations = done + stop - start, evaluations + evaluated
            if ours and progress is not None:
                progress(min(1.0, done / expected))

        shape = (camera.height, camera.width)
        picture = Picture(rgba.reshape(*shape, 4), depth.reshape(shape), 0)
        where = footprint(scene.voxels, camera, before) if settings.skip else None
        shown = np.ones(shape, bool) if where is None else where.covered(*shape)
        expected = max(int(shown.sum()), 1)
        for wanted in passes(picture.rgba, picture.depth, limit, settings.agreement):
            wanted &= shown
            pixels = order[wanted.reshape(-1)[order]]
            run_chunks(trace, len(pixels), settings.chunk, pixels, least=_LEAST_CHUNK)
        if progress is not None:
            progress(1.0)
    return replace(picture, evaluations=evaluations)


def trace_rays(
    scene: Scene, rays: RayBatch, settings: RenderSettings | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Straight sRGB with alpha [R, 4] and depth along the cosine's axis [R] (inf if empty) of any
    rays, on all threads."""
    chosen = settings or RenderSettings()
    if scene.origin.any():
        rays = replace(rays, origins=rays.origins - torch.from_numpy(scene.origin).float())
    rgba, depth = np.zeros((len(rays), 4), np.float32), np.full(len(rays), np.inf, np.float32)

    def trace(start: int, stop: int) -> None:
        with torch.inference_mode():
            part = rays.pick(torch.arange(start, stop))
            rgba[start:stop], depth[start:stop], _ = _trace(scene, part, chosen)

    with torch.inference_mode(), torch_alone():
        run_chunks(trace, len(rays), chosen.chunk)
    return rgba, depth


def _before(scene: Scene, camera: Camera) -> float:
    """How far along every ray of a camera there is nothing yet, in whole strides."""
    box = scene.mesh.vertices.numpy().astype(np.float64)
    low, high = box.min(0), box.max(0)
    radius = np.linalg.norm(high - low) / 2 + scene.avatar.config.reach * np.sqrt(3)
    towards = (low + high) / 2 - camera.origin
    distance = towards @ camera.camera_to_world[:3, 2]
    if not camera.parallel:
        distance = np.linalg.norm(towards)
    return _STRIDE * max(0.0, np.floor((distance - radius) / _STRIDE))


def _trace(
    scene: Scene, rays: RayBatch, settings: RenderSettings
) -> tuple[np.ndarray, np.ndarray, int]:
    """Straight RGBA [R, 4], depth along the camera's axis [R], and how many densities it took."""
    run = _whole if _compiled(scene, settings) else _by_waves
    *found, evaluations = run(scene, rays, settings)
    colour, depth, left = (values.cpu() for values in found)
    opacity = 1 - left
    seen = (opacity > 1e-4) & (colour[:, 3] > 0)
    safe = torch.where(seen, opacity, 1.0)[:, None]
    straight = (colour[:, :3] / torch.where(seen, colour[:, 3], 1.0)[:, None]).clamp(0, 1)
    # a ray that was ended early is opaque: what is left of it would be seen through nothing
    alpha = torch.where(left <= settings.transmittance, 1.0, opacity).clamp(0, 1)
    rgba = torch.where(seen[:, None], torch.cat([straight, alpha[:, None]], 1), 0.0)
    along = torch.where(seen, (depth / safe[:, 0] + rays.start) * rays.cosine, torch.inf)
    return rgba.numpy(), along.numpy(), evaluations


def _compiled(scene: Scene, settings: RenderSettings) -> bool:
    return settings.skip and scene.avatar.field.device.type == "cpu"


def _field(scene: Scene, settings: RenderSettings) -> tuple[Any, ...]:
    return scene.packed if settings.brief else scene.packed_exactly


def _whole(scene: Scene, rays: RayBatch, settings: RenderSettings) -> Traced:
    """The rays in one compiled pass."""
    ops, stance, count = kernels.select("cpu").tracing, scene.stance, len(rays)
    begin = torch.zeros(count) if rays.begin is None else rays.begin
    end = torch.full((count,), torch.inf) if rays.end is None else rays.end
    first, last = ops.enter(
        scene.voxels, scene.known, rays.origins, rays.directions, begin, end, settings.step
    )
    still = np.concatenate([stance.shoulders.T, stance.offset[:, None]], 1)
    return ops.trace(
        scene.mesh,
        scene.voxels,
        scene.known,
        _field(scene, settings),
        rays.origins,
        rays.directions,
        first,
        last,
        settings.step,
        clearance=scene.clearance,
        band=scene.avatar.config.reach,
        still=torch.from_numpy(still),
        rotation=torch.from_numpy(stance.rotation),
        view=scene.frozen.view,
        probing=Probing(
            settings.wave,
            settings.share,
            settings.longest,
            settings.probe,
            settings.tolerance,
            settings.transmittance,
            settings.negligible,
        ),
    )


def _by_waves(scene: Scene, rays: RayBatch, settings: RenderSettings) -> Traced:
    """The same step by step, with the field as it is."""
    count, evaluations = len(rays), 0
    # the colours of what was worth a look, and how much of the ray that was
    field, reach = scene.avatar.field, scene.avatar.config.reach
    device = field.device
    colour = torch.zeros(count, 4, device=device)
    depth, left = torch.zeros(count, device=device), torch.ones(count, device=device)
    ops, there = kernels.select("cpu"), kernels.select(device)
    jitter = torch.full((count,), 0.5)
    around = (scene.voxels.box, 0.0) if settings.skip else (scene.mesh.vertices, reach)
    near, far = ops.marching.bounds(*around, rays.origins, rays.directions)
    first, last = ops.marching.lattice(near, _ended(far, rays), jitter, settings.step)
    alive = (last >= first).nonzero()[:, 0]
    while len(alive):
        part = rays.pick(alive)
        wave = _wave(scene, part, first[alive], last[alive], left.cpu()[alive], settings)
        packed, slots = pack(wave, jitter[alive], settings.step)
        if len(packed):
            samples = samples_of(packed, scene.clearance, 0, scene.condition, part, scene.stance)
            samples = samples.to(device)
            sigma, layers = _geometry(scene, samples)
            evaluations += len(sigma)
            ray = alive[packed.ray.long()].to(device)
            width = torch.full_like(sigma, settings.step)
            if isinstance(wave, Picks):
                width *= wave.steps.view(-1)[slots].to(device)
            weights = there.marching.weigh(sigma, width, ray.int(), left)
            depth.index_add_(0, ray, weights * packed.t.to(device))
            shown = (weights > settings.negligible * width).nonzero()[:, 0]
            for seen, portion in layers:
                rgb = field.shade(seen[shown], samples.direction, samples.ray[shown])
                weight = (weights * portion)[shown, None]
                colour.index_add_(0, ray[shown], torch.cat([weight * rgb, weight], 1))
        first[alive] = wave.next
        going = (wave.next <= last[alive]) & (left.cpu()[alive] > settings.transmittance)
        alive = alive[going]
    return Traced(colour, depth, left, evaluations)


def _geometry(
    scene: Scene, samples: Samples
) -> tuple[torch.Tensor, list[tuple[torch.Tensor, torch.Tensor | float]]]:
    """Densities [N] per metre; of each appearance what its colour depends on [N, C], and its part
    in the colour ([N], or 1 where there is no other)."""
    field, wearing = scene.avatar.field, scene.wearing
    if wearing.mixture is None:
        sigma, inputs = field.geometry(samples, wearing.worn)
        return sigma, [(inputs, 1.0)]
    sigma, parts, seen = geometry(field, wearing.mixture, wearing.worn, samples)
    return sigma, list(zip(seen, parts.T, strict=True))


def _ended(far: torch.Tensor, rays: RayBatch) -> torch.Tensor:
    return far if rays.end is None else torch.minimum(far, rays.end)


def _wave(
    scene: Scene,
    rays: RayBatch,
    first: torch.Tensor,
    last: torch.Tensor,
    left: torch.Tensor,
    settings: RenderSettings,
) -> Picks | Wave:
    """The next samples of rays [R] that are to look at lattice indices first..last [R]."""
    ops = kernels.select("cpu")
    far = scene.avatar.field.device.type != "cpu"
    width = max(settings.wave, _FAR_WAVE) if far else settings.wave
    middle = torch.full((len(rays),), 0.5)
    lattice = rays.origins, rays.directions, first, last, middle
    space, reach = scene.clearance, scene.avatar.config.reach
    if not settings.skip:
        options = {"clearance": space, "band": reach, "leap_limit": 0.0}
        return ops.marching.march(scene.mesh, *lattice, settings.step, wave=width, **options)
    return ops.picking.pick(
        scene.mesh,
        scene.voxels,
        scene.wearing.guide,
        *lattice,
        middle,
        left,
        settings.step,
        clearance=space,
        band=reach,
        thrift=Thrift(width, settings.share, settings.longest),
    )
