"""What each pixel of a cut-out person shows, from the fitted mesh, the matte and colours.

On the mesh the mesh says it. Beside it, hair lies about the skull and cloth about the neck. What
covers the mesh - hair over forehead, ears and shoulders, a beard, a collar - is told by colour,
learnt from what is certain in the same picture. Glasses and jewellery are not found.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from ..collection import LABELS, Clip
from ..head import HeadModel
from ..rendering.cameras import Camera
from ..rendering.rasterise import rasterise

# later ones win where regions meet
_OF_REGION = (
    ("face", "face"),
    ("eye_sockets", "face"),
    ("scalp", "scalp_hair"),
    ("ears", "ears"),
    ("neck", "neck"),
    ("torso", "cloth"),
    ("lips", "lips"),
    ("mouth_interior", "mouth"),
    ("tongue", "mouth"),
    ("teeth", "mouth"),
    ("eyeballs", "eyes"),
)
_NUMBER = {name: number for number, name in enumerate(LABELS)}
_FACE, _EARS, _NECK, _HAIR, _CLOTH, _BEARD, _EYES, _LIPS = (
    _NUMBER[n]
    for n in ("face", "ears", "neck", "scalp_hair", "cloth", "facial_hair", "eyes", "lips")
)
_OPAQUE = 64  # alpha from which on a pixel shows the person
_EAR = 0.04  # of the picture: how far an ear may stand off the fitted one
_LEAST = 30  # pixels from which a colour can be learnt
_DARKER = 0.4  # of the skin's brightness: a beard, not a shadow
_SPREAD = 12.0  # of 255: two colours as near as this are one


def label(
    head: HeadModel,
    parts: np.ndarray,
    betas: np.ndarray,
    clip: Clip,
    row: int,
    rgba: np.ndarray,
) -> np.ndarray:
    """uint8 [H, W], indices into LABELS, of a picture [H, W, 4] uint8 and its fitted head; parts
    [T]: see `of_triangles`."""
    one = slice(row, row + 1)
    posed = head.pose(betas, clip.expression[one], clip.pose[one], clip.translation[one])[0].numpy()
    camera = Camera(clip.width, clip.height, clip.intrinsics[row], clip.camera_to_world[row])
    _, triangle, _ = rasterise(posed, head.triangles, camera)
    mesh = np.where(triangle >= 0, parts[triangle.clip(0)], 0).astype(np.uint8)
    return from_mesh(mesh, rgba)


def from_mesh(mesh: np.ndarray, rgba: np.ndarray) -> np.ndarray:
    """See `label`; mesh uint8 [H, W]: what the bare head would show."""
    person = rgba[..., 3] >= _OPAQUE
    mesh = np.where(person, mesh, 0)
    if not mesh.any():
        return np.where(person, _CLOTH, 0).astype(np.uint8)
    # beside the mesh: as the nearest part of it
    away, place = ndimage.distance_transform_edt(mesh == 0, return_indices=True)
    nearest = mesh[tuple(place)]
    low = np.isin(nearest, (_NECK, _CLOTH))
    out = np.where(mesh > 0, mesh, np.where(low, _CLOTH, _HAIR))
    out = _by_colour(out, mesh, rgba, person, (nearest == _EARS) & (away <= _EAR * len(mesh)))
    return np.where(person, out, 0).astype(np.uint8)


def _by_colour(
    out: np.ndarray, mesh: np.ndarray, rgba: np.ndarray, person: np.ndarray, by_ears: np.ndarray
) -> np.ndarray:
    """Decides again, by colour, what lies below the face: neck, cloth or hair."""
    rgb = rgba[..., :3].astype(np.float32)
    height = np.arange(len(mesh))[:, None]
    eyes, lips = _middle_row(mesh, _EYES), _middle_row(mesh, _LIPS)
    face_rows = np.flatnonzero((mesh == _FACE).any(axis=1))
    if len(face_rows) == 0:
        return out
    chin = int(face_rows[-1])
    # eyes shut, or turned away: where they would be
    brow = eyes if eyes is not None else int(0.45 * face_rows[0] + 0.55 * chin)
    mouth = lips if lips is not None else int(0.25 * face_rows[0] + 0.75 * chin)
    nose = (brow + mouth) // 2
    skin = (mesh == _FACE) & (height > brow) & (height < nose)
    hair = _inner((out == _HAIR) & (height < chin))
    cloth = _inner((out == _CLOTH) & (height > chin))
    known = {
        key: rgb[mask & person]
        for key, mask in ((_NECK, skin), (_HAIR, hair), (_CLOTH, cloth))
        if np.count_nonzero(mask & person) >= _LEAST
    }
    out = out.copy()
    first = out.copy()
    below = person & np.isin(out, (_NECK, _CLOTH)) & ~_bare(mesh)
    _decide(out, below, rgb, known)
    fringe = np.isin(mesh, (_FACE, _EARS)) & (height < brow - (brow - face_rows[0]) // 4)
    fringe = person & (fringe | by_ears)
    _decide(out, fringe, rgb, {key: known[key] for key in (_NECK, _HAIR) if key in known})
    skin_there = np.where(by_ears, _EARS, _FACE)
    out = np.where(fringe & (out == _NECK), skin_there, out)
    if _NECK in known:
        jaw = person & (mesh == _FACE) & (height > nose)
        out[jaw & (_darker(known[_NECK], rgb) > _DARKER)] = _BEARD
    return np.where(out != first, ndimage.median_filter(out, 3), out)


def _middle_row(mesh: np.ndarray, part: int) -> int | None:
    rows = np.flatnonzero((mesh == part).any(axis=1))
    return int(np.median(rows)) if len(rows) else None


def _decide(
    out: np.ndarray, where: np.ndarray, rgb: np.ndarray, known: dict[int, np.ndarray]
) -> None:
    """Gives the pixels `where` the likeliest of `known`: label -> colours [n, 3] it has."""
    if len(known) < 2 or not where.any():
        return
    keys = np.array(list(known))
    odds = np.stack([_likely(samples, rgb[where]) for samples in known.values()])
    # what geometry says is worth a good deal of colour
    now = np.where(np.isin(out[where], (_FACE, _EARS)), _NECK, out[where])
    odds += 1.5 * (keys[:, None] == now[None])
    out[where] = keys[odds.argmax(axis=0)]


def _darker(skin: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """By how much of the skin's brightness (median) pixels are darker, [H, W]."""
    usual = float(np.median(skin.mean(axis=1)))
    return 1 - rgb.mean(axis=2) / max(usual, 1.0)


def _inner(mask: np.ndarray) -> np.ndarray:
    return ndimage.binary_erosion(mask, iterations=2)


def _bare(mesh: np.ndarray) -> np.ndarray:
    """The upper half of the neck on the mesh, which no collar reaches."""
    rows = np.flatnonzero((mesh == _NECK).any(axis=1))
    if len(rows) == 0:
        return np.zeros(mesh.shape, bool)
    upper = np.arange(len(mesh))[:, None] < (rows[0] + rows[-1]) / 2
    return (mesh == _NECK) & upper


def _likely(samples: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """Logarithms of how likely `colours` [n, 3] are: a normal distribution of the samples'."""
    middle = np.median(samples, axis=0)
    covariance = np.cov(samples.T) + _SPREAD**2 * np.eye(3)
    away = colours - middle
    square = np.einsum("ni,ij,nj->n", away, np.linalg.inv(covariance), away)
    return -0.5 * (square + np.linalg.slogdet(covariance)[1])


def of_triangles(head: HeadModel) -> np.ndarray:
    """[T] the label of each triangle of the bare head."""
    vertex = np.zeros(head.vertex_count, int)
    rank = np.zeros(head.vertex_count, int)
    for place, (region, name) in enumerate(_OF_REGION):
        if region in head.regions:
            vertex[head.regions[region]] = _NUMBER[name]
            rank[head.regions[region]] = place + 1
    corners = head.triangles
    highest = rank[corners].argmax(axis=1)
    return vertex[corners[np.arange(len(corners)), highest]]
