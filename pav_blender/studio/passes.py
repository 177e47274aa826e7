"""The renders of one frame: colour, matte, and labels with depth."""

from __future__ import annotations

import os
import tempfile
from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np
import OpenImageIO as oiio
from scipy import ndimage

from ..core.errors import PavError
from .nodes import new_material

COLOUR_SAMPLES = 16
MATTE_SAMPLES = 32
NOISE = 0.05  # at which a pixel gets no more samples


def configure(scene, size: int) -> None:
    """Cycles settings that hold for every pass (see each pass for its own)."""
    scene.render.engine = "CYCLES"
    render, cycles = scene.render, scene.cycles
    render.resolution_x = render.resolution_y = size
    render.resolution_percentage = 100
    render.film_transparent = True
    render.dither_intensity = 0.0
    render.use_compositing = render.use_sequencer = False
    if hasattr(render.image_settings, "media_type"):  # Blender 5: formats depend on it
        render.image_settings.media_type = "MULTI_LAYER_IMAGE"
    render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
    if hasattr(render.image_settings, "use_exr_interleave"):  # Blender 5: all layers in one part
        render.image_settings.use_exr_interleave = True
    render.image_settings.color_depth = "32"
    render.image_settings.exr_codec = "NONE"
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    scene.view_layers[0].use_pass_z = True
    cycles.device = "CPU"
    if os.environ.get("PAV_THREADS"):
        render.threads_mode, render.threads = "FIXED", int(os.environ["PAV_THREADS"])
    cycles.seed = 0
    cycles.max_bounces = 3
    cycles.diffuse_bounces = 2
    cycles.glossy_bounces = 2
    cycles.transparent_max_bounces = 4
    cycles.sample_clamp_indirect = 3.0
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.use_light_tree = False
    scene.cycles_curves.shape = "RIBBONS"
    scene.cycles_curves.subdivisions = 1


def _cycles():
    import _cycles  # only there once Blender has registered Cycles

    return _cycles


class Passes:
    """Renders a studio scene to arrays; holds the override material and a scratch folder."""

    def __init__(self, scene, size: int):
        self.scene, self.size = scene, size
        configure(scene, size)
        self.expose(None)
        # Debian's Blender has no denoiser: more samples take its place
        self.denoise = bool(getattr(_cycles(), "with_openimagedenoise", False))
        if self.denoise:
            scene.cycles.denoiser = "OPENIMAGEDENOISE"
            scene.cycles.denoising_prefilter = "FAST"
        self.flat, graph = new_material("studio flat")
        graph.surface(
            graph.add("Emission", Color=graph.attribute("label").outputs[0], Strength=1.0)
        )
        self.scratch = tempfile.TemporaryDirectory(prefix="pav_studio_")

    def expose(self, samples: int | None) -> None:
        """How many samples a pixel gets at most (None: 16, above 320 pixels 24). Where they are
        more than that, mattes get as many times more too."""
        usual = COLOUR_SAMPLES if self.size <= 320 else 24
        self.samples = samples or usual
        more = max(1.0, self.samples / usual)
        self.matte_samples = round(MATTE_SAMPLES * more)
        self.noise = NOISE / more**0.5

    def close(self) -> None:
        bpy.data.materials.remove(self.flat)
        self.scratch.cleanup()

    def colour(self) -> np.ndarray:
        """Premultiplied scene-linear RGBA [H,W,4]."""
        cycles = self.scene.cycles
        cycles.samples = self.samples if self.denoise else 8 * self.samples
        cycles.use_denoising = self.denoise
        cycles.use_adaptive_sampling = True
        cycles.adaptive_threshold = self.noise if self.denoise else 0.3 * self.noise
        cycles.filter_width = 1.5
        return self._render()["Combined"]

    def matte(self) -> np.ndarray:
        """Coverage [H,W] from many samples of plain emission."""
        with self._flattened(self.matte_samples, 1.5):
            return self._render()["Combined"][..., 3]

    def labels_and_depth(self) -> tuple[np.ndarray, np.ndarray]:
        """Label numbers uint8 [H,W] and camera z [H,W] (inf: nothing) through the pixel centres."""
        with self._flattened(1, 0.01):
            layers = self._render()
        labels = np.round(layers["Combined"][..., 0]).astype(np.uint8)
        depth = layers["Depth"][..., 0]
        empty = layers["Combined"][..., 3] < 0.5
        return np.where(empty, 0, labels), np.where(empty, np.inf, depth).astype(np.float32)

    @contextmanager
    def _flattened(self, samples: int, filter_width: float):
        cycles, layer = self.scene.cycles, self.scene.view_layers[0]
        world = self.scene.world
        bounces = cycles.max_bounces
        layer.material_override = self.flat
        self.scene.world, cycles.max_bounces = None, 0
        cycles.samples, cycles.filter_width = samples, filter_width
        cycles.use_denoising = cycles.use_adaptive_sampling = False
        try:
            yield
        finally:
            layer.material_override = None
            self.scene.world, cycles.max_bounces = world, bounces

    def _render(self) -> dict[str, np.ndarray]:
        path = Path(self.scratch.name) / "frame.exr"
        self.scene.render.filepath = str(path)
        bpy.ops.render.render(write_still=True, scene=self.scene.name)
        picture = oiio.ImageInput.open(str(path))
        if picture is None:
            raise PavError(f"Cycles wrote no picture to {path}: {oiio.geterror()}")
        spec = picture.spec()
        pixels = np.asarray(picture.read_image(0, 0, 0, spec.nchannels, "float"))
        picture.close()
        layers: dict[str, list[int]] = {}
        for k, name in enumerate(spec.channelnames):  # "ViewLayer.Combined.R"
            layers.setdefault(name.split(".")[-2], []).append(k)
        order = {"R": 0, "G": 1, "B": 2, "A": 3}
        return {
            name: pixels[..., sorted(ks, key=lambda k: order.get(spec.channelnames[k][-1], 0))]
            for name, ks in layers.items()
        }


def straight_colour(premultiplied: np.ndarray) -> np.ndarray:
    """Straight sRGB [H,W,3] from premultiplied linear RGBA; thin coverage borrows colour.

    Dividing by a small alpha amplifies noise, so the quotient of two blurred images takes over
    where the coverage is thin: a colour that comes from the foreground only.
    """
    rgb, alpha = premultiplied[..., :3], premultiplied[..., 3]
    colour = rgb / np.maximum(alpha, 1e-4)[..., None]
    for sigma, needed in ((1.0, 0.7), (3.0, 0.15), (8.0, 0.02)):
        weight = ndimage.gaussian_filter(alpha, sigma)
        spread = (
            np.stack([ndimage.gaussian_filter(rgb[..., k], sigma) for k in range(3)], axis=-1)
            / np.maximum(weight, 1e-5)[..., None]
        )
        trust = np.clip(alpha / needed, 0.0, 1.0)[..., None]
        colour = trust * colour + (1.0 - trust) * spread
    return to_srgb(np.clip(colour, 0.0, 1.0))


def to_srgb(linear: np.ndarray) -> np.ndarray:
    low = 12.92 * linear
    high = 1.055 * np.maximum(linear, 1e-8) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, low, high)


def clean_labels(labels: np.ndarray, matte: np.ndarray, hair: tuple[int, ...]) -> np.ndarray:
    """Background where the matte is thin; a vote of 3x3 where strands make salt and pepper."""
    votes = np.stack(
        [ndimage.uniform_filter((labels == k).astype(np.float32), 3) for k in range(11)]
    )
    votes[0] = 0.0
    winner = votes.argmax(0).astype(np.uint8)
    near_hair = votes[list(hair)].sum(0) > 0.2
    empty = (labels == 0) & (votes.sum(0) > 0)
    out = np.where(near_hair | empty, winner, labels)
    return np.where(matte < 0.5, 0, out).astype(np.uint8)
