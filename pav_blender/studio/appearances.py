"""Five appearances of one person, and the building of a scene for each."""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Matrix

from . import accessories, facial, hair, scalp
from .clothes import Outfit, dressed, outfit_objects
from .facial import BeardStyle
from .hair import HairColour
from .lights import AreaLight, Lighting
from .objects import curve_object, move_curves
from .person import Person, Surface
from .scalp import ScalpStyle
from .scene import LABEL, FrameState, StudioScene, add_body, new_scene
from .skin import SkinLook

BROWN = HairColour((0.012, 0.008, 0.006), (0.045, 0.028, 0.018))
AUBURN = HairColour((0.055, 0.018, 0.007), (0.20, 0.075, 0.028), roughness=0.36)
STUBBLE = HairColour((0.05, 0.045, 0.04), (0.14, 0.13, 0.125), 0.4, (0.30, 0.30, 0.30))
GREY = HairColour((0.06, 0.06, 0.063), (0.22, 0.22, 0.225), 0.45, (0.46, 0.46, 0.47), 0.5)
BLACK = HairColour((0.006, 0.005, 0.005), (0.022, 0.017, 0.014))
COPPER = HairColour((0.10, 0.030, 0.010), (0.30, 0.105, 0.030), roughness=0.38)


@dataclass(frozen=True)
class Appearance:
    name: str
    skin: SkinLook
    lighting: Lighting
    outfit: Outfit
    brows: HairColour
    scalp: ScalpStyle | None = None
    beard: BeardStyle | None = None
    brow_count: int = 620
    glasses: tuple[float, float, float] | None = None
    round_glasses: bool = False
    earrings: bool = False
    hat: tuple[float, float, float] | None = None


APPEARANCES = (
    Appearance(
        "crop",
        SkinLook(),
        Lighting(
            (
                AreaLight(-38, 32, 30, 0.55, colour=(1.0, 0.96, 0.91)),
                AreaLight(55, 8, 8, 0.9, colour=(0.88, 0.94, 1.0)),
                AreaLight(150, 25, 16, 0.5),
            ),
            zenith=(0.55, 0.6, 0.66), ground=(0.22, 0.2, 0.19), sky=0.55,
        ),
        Outfit("collar", (0.72, 0.73, 0.75), (0.026, 0.036, 0.075), "cloth", 1.0, 3),
        BROWN,
        ScalpStyle("crop", BROWN, 11000, 6, 0.00030, 0.036, 12, 0.55),
        BeardStyle("full", BROWN, 6200, (0.006, 0.0125), 0.00020),
        glasses=(0.012, 0.011, 0.012),
    ),
    Appearance(
        "long",
        SkinLook(base=(0.55, 0.315, 0.215), lips=(0.47, 0.16, 0.13), redness=1.1,
                 under_hair=(0.06, 0.025, 0.012), freckles=0.35),
        Lighting(
            (
                AreaLight(52, 24, 34, 0.45, colour=(1.0, 0.80, 0.58)),
                AreaLight(-60, 10, 7, 0.9, colour=(0.66, 0.80, 1.0)),
                AreaLight(-150, 18, 13, 0.5, colour=(0.80, 0.88, 1.0)),
            ),
            zenith=(0.34, 0.30, 0.28), ground=(0.12, 0.08, 0.06), sky=0.55,
        ),
        Outfit("crew", (0.40, 0.022, 0.022), None, "knit", 1.0, 5),
        AUBURN,
        ScalpStyle("long", AUBURN, 8000, 18, 0.00036, 0.30, 26, 0.60, wave=0.0045),
        earrings=True,
    ),
    Appearance(
        "grey",
        SkinLook(base=(0.55, 0.34, 0.255), lips=(0.43, 0.195, 0.165), redness=0.95, mottle=1.2,
                 lines=0.6, under_hair=(0.17, 0.15, 0.14), under_beard=(0.36, 0.27, 0.235)),
        Lighting(
            (
                AreaLight(-20, 50, 26, 1.2, colour=(0.93, 0.97, 1.0)),
                AreaLight(40, 0, 9, 1.0, colour=(1.0, 0.98, 0.95)),
                AreaLight(-150, 20, 13, 0.7),
            ),
            zenith=(0.62, 0.70, 0.80), ground=(0.26, 0.25, 0.24), sky=0.75,
        ),
        Outfit("collar", (0.065, 0.13, 0.33), (0.075, 0.07, 0.032), "cloth", 1.3, 8),
        HairColour((0.05, 0.045, 0.04), (0.16, 0.15, 0.14), 0.3, (0.4, 0.4, 0.4)),
        ScalpStyle("fringe", GREY, 9500, 9, 0.00028, 0.092, 12, 0.6, wave=0.0022),
        BeardStyle("stubble", STUBBLE, 3600, (0.0022, 0.0036), 0.00015),
    ),
    Appearance(
        "buzz",
        SkinLook(base=(0.42, 0.225, 0.145), lips=(0.36, 0.135, 0.11), redness=0.7, mottle=0.9,
                 roughness=0.42, under_hair=(0.055, 0.038, 0.03), under_beard=(0.09, 0.055, 0.04)),
        Lighting(
            (
                AreaLight(-62, 18, 30, 0.55, colour=(1.0, 0.93, 0.85)),
                AreaLight(70, 12, 10, 0.7, colour=(0.65, 0.80, 1.0)),
                AreaLight(10, 60, 8, 0.8),
            ),
            zenith=(0.30, 0.34, 0.40), ground=(0.10, 0.09, 0.09), sky=0.6,
        ),
        Outfit("hood", (0.10, 0.115, 0.12), None, "cloth", 1.6, 11),
        BLACK,
        ScalpStyle("buzz", BLACK, 9000, 3, 0.00020, 0.0035, 8, 0.0, recede=0.10),
        BeardStyle("full", BLACK, 8500, (0.016, 0.034), 0.00022),
        brow_count=760,
    ),
    Appearance(
        "hat",
        SkinLook(base=(0.64, 0.41, 0.32), lips=(0.56, 0.20, 0.18), redness=1.35, mottle=1.0,
                 freckles=0.9, under_hair=(0.12, 0.045, 0.02)),
        Lighting(
            (
                AreaLight(28, 38, 30, 0.9, colour=(1.0, 0.98, 0.95)),
                AreaLight(-45, 5, 11, 1.0, colour=(0.95, 0.97, 1.0)),
                AreaLight(170, 30, 20, 0.6, colour=(1.0, 0.92, 0.8)),
            ),
            zenith=(0.75, 0.78, 0.8), ground=(0.35, 0.33, 0.31), sky=0.6,
        ),
        Outfit("roll", (0.42, 0.36, 0.27), None, "knit", 1.2, 13),
        COPPER,
        ScalpStyle("long", COPPER, 13000, 14, 0.00034, 0.17, 22, 0.55, wave=0.006),
        glasses=(0.30, 0.20, 0.10),
        round_glasses=True,
        hat=(0.03, 0.11, 0.115),
    ),
)  # fmt: skip


@dataclass(eq=False)
class RigidActor:
    """Objects in rest space that ride on one joint."""

    items: list
    joint: int

    def follow(self, state: FrameState) -> None:
        for item in self.items:
            item.matrix_world = Matrix(state.transforms[self.joint].tolist())


@dataclass(eq=False)
class HangingHair:
    """Long hair: follows the head near its roots, the torso further down, and lies on it."""

    items: list
    rest: np.ndarray  # [S,P,3]
    share: np.ndarray  # [S,P,1] how much a point follows the head
    low: np.ndarray  # [S,P] points that may touch the shoulders
    torso: Surface  # rest space

    def follow(self, state: FrameState) -> None:
        head, root = state.transforms[1], state.transforms[0]
        # a turn of the head in the root's frame, softened point by point
        relative = np.linalg.inv(root) @ head
        moved = self.rest @ relative[:3, :3].T + relative[:3, 3]
        moved = self.rest + self.share * (moved - self.rest)
        # the blend of two turned copies shortens the lengths: restore them from the root down
        pace = np.linalg.norm(np.diff(self.rest, axis=1), axis=2)
        for k in range(1, moved.shape[1]):
            step = moved[:, k] - moved[:, k - 1]
            step *= (pace[:, k - 1] / np.maximum(np.linalg.norm(step, axis=1), 1e-9))[:, None]
            moved[:, k] = moved[:, k - 1] + step
        moved[self.low] = self.torso.push_out(moved[self.low], 0.016)
        move_curves(self.items[0], moved @ root[:3, :3].T + root[:3, 3])


def build_scene(person: Person, look: Appearance, seed: int) -> StudioScene:
    """The whole scene of one appearance; deterministic in `seed`."""
    rng = np.random.default_rng([seed, APPEARANCES.index(look)])
    skin_rows = person.parts["skin"].vertices
    points, normals = person.fine[skin_rows], person.normals[skin_rows]
    surface = Surface(points, normals)
    none = np.zeros(len(points))
    hair_mask = scalp.hairline(person, look.scalp.recede)(points) if look.scalp else none
    beard = facial.beard_mask(person, look.beard.kind)(points) if look.beard else none
    studio = new_scene(person, look.lighting)
    covered = 0.75 if look.beard and look.beard.kind == "stubble" else 0.9
    under_cloth = dressed(person, points, -0.022, look.outfit)
    add_body(studio, look.skin, 0.95 * hair_mask, covered * beard, under_cloth)
    studio.add(RigidActor(outfit_objects(person, look.outfit, LABEL["cloth"]), 0))
    if look.scalp:
        _add_scalp(studio, person, look, surface, rng)
    _add_facial(studio, person, look, surface, rng)
    worn: list[bpy.types.Object] = []
    if look.glasses:
        worn += accessories.glasses(person, look.glasses, LABEL["accessory"], look.round_glasses)
    if look.earrings:
        worn += accessories.earrings(person, LABEL["accessory"])
    if look.hat:
        worn += accessories.beanie(person, look.hat, LABEL["accessory"])
    if worn:
        studio.add(RigidActor(worn, 1))
    return studio


def _add_scalp(studio: StudioScene, person: Person, look: Appearance, surface, rng) -> None:
    style = look.scalp
    assert style is not None
    strands, tint = scalp.style_scalp(person, style, surface, rng)
    marks = person.landmarks
    if look.hat:  # only what falls below the hat
        strands, tint = _below_hat(person, strands, tint)
    if style.kind == "long":  # nothing crosses the throat
        stray = _crosses_throat(person, strands)
        strands, tint = strands[~stray], tint[~stray]
    radius = hair.taper(style.radius, style.steps)
    item = curve_object("studio scalp hair", strands, radius, hair.hair_material(style.colour),
                        label=LABEL["scalp_hair"], tint=tint)  # fmt: skip
    if style.kind != "long":
        studio.add(RigidActor([item], 1))
        return
    drop = marks.mouth[1] - strands[..., 1]
    fade = np.clip(drop / 0.16, 0, 1)
    share = (1 - 0.62 * fade * fade * (3 - 2 * fade))[..., None]
    studio.add(HangingHair([item], strands, share, drop > 0.02, _torso(person, surface)))


def _torso(person: Person, surface: Surface) -> Surface:
    """The shoulders without the neck, which hair passes behind."""
    points = surface.vertices
    neck = person.joints[1]
    outside = np.hypot(points[:, 0], points[:, 2] - neck[2]) > 0.062
    rows = outside & (points[:, 1] < person.landmarks.chin[1] - 0.01)
    return Surface(points[rows], surface.normals[rows])


def _crosses_throat(person: Person, strands: np.ndarray) -> np.ndarray:
    marks = person.landmarks
    offset = strands - person.joints[1]
    ahead = (offset[..., 2] > 0.012) & (np.hypot(offset[..., 0], offset[..., 2]) < 0.095)
    return (ahead & (strands[..., 1] < marks.mouth[1] - 0.01)).any(1)


def _below_hat(person: Person, strands: np.ndarray, tint: np.ndarray):
    marks = person.landmarks
    root = strands[:, 0]
    slope = (root[:, 2] - marks.back[2]) / (marks.eye[2] - marks.back[2])
    line = marks.eye[1] - 0.012 + 0.052 * slope + 0.012
    keep = root[:, 1] < line
    return strands[keep], tint[keep]


def _add_facial(studio: StudioScene, person: Person, look: Appearance, surface, rng) -> None:
    brow_material = hair.hair_material(look.brows)
    roots, strands = facial.brow_strands(person, surface, look.brow_count, rng)
    tint = hair.tints(look.brows, None, len(strands), rng)
    label = LABEL["facial_hair"]
    studio.add(facial.ride(person, "studio brows", strands, roots, hair.taper(0.00016, 4),
                           brow_material, label, tint))  # fmt: skip
    roots, strands = facial.lash_strands(person, 230, rng)
    dark = np.tile(np.array([0.012, 0.009, 0.008], np.float32), (len(strands), 1))
    studio.add(facial.ride(person, "studio lashes", strands, roots, hair.taper(0.00013, 4),
                           brow_material, label, dark))  # fmt: skip
    if look.beard:
        roots, strands, tint = facial.beard_strands(person, look.beard, surface, rng)
        studio.add(facial.ride(person, "studio beard", strands, roots,
                               hair.taper(look.beard.radius, 4),
                               hair.hair_material(look.beard.colour), label, tint))  # fmt: skip
