"""An avatar along a track, written as an image sequence."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..collection import Clip, Collection, identity_distance, read_collection, relative_clip
from ..collection.relative import OTHER_PERSON
from ..devices import device_of
from ..errors import InputError, OtherPerson
from ..field.avatar import Avatar
from ..field.identities import Identity, identity
from ..progress import Report
from .cameras import Camera
from .frames import format_of, provenance, write_frame
from .render import RenderSettings, render
from .wearing import Appearance, shares_of


def parse_track(track: str) -> tuple[Collection, Clip]:
    """ "FOLDER:CLIP" -> the collection and its clip; InputError where there is none."""
    folder, separator, name = track.rpartition(":")
    if not separator or not folder:
        raise InputError(f"track {track!r}: write COLLECTION:CLIP, e.g. out/collection:short")
    collection = read_collection(folder)
    return collection, collection.clip(name)


def parse_appearance(text: str, avatar: Avatar) -> Appearance:
    """A name, or "NAME=WEIGHT,NAME=WEIGHT,..."; InputError for unknown names and wrong weights."""
    if text in avatar.appearances or "=" not in text:
        avatar.appearance_index(text)
        return text
    weights: dict[str, float] = {}
    for part in text.split(","):
        name, _, weight = part.rpartition("=")
        try:
            weights[name] = float(weight)
        except ValueError as error:
            raise InputError(f"appearance {text!r}: write NAME=WEIGHT,NAME=WEIGHT") from error
    shares_of(avatar, weights)
    return weights


def parse_frames(text: str | None, clip: Clip) -> np.ndarray:
    """ "A-B" or "A" -> rows of the clip whose frame numbers lie in it; None: all."""
    if text is None:
        return np.arange(len(clip))
    match = re.fullmatch(r"(\d+)(?:-(\d+))?", text)
    if not match:
        raise InputError(f"frames {text!r}: write A-B or a single number")
    low, high = int(match[1]), int(match[2] or match[1])
    rows = np.flatnonzero((clip.frame_id >= low) & (clip.frame_id <= high))
    if len(rows) == 0:
        raise InputError(
            f"frames {text!r}: clip {clip.name!r} has {clip.frame_id.min()} to "
            f"{clip.frame_id.max()}"
        )
    return rows


def numbered(pattern: str, number: int) -> Path:
    """The path of a frame: each run of # becomes the number, padded to the run's length."""
    return Path(re.sub(r"#+", lambda run: f"{number:0{len(run[0])}d}", pattern))


def check_head(avatar: Avatar, collection: Collection) -> None:
    """InputError where the track moves another head than the avatar's."""
    if avatar.head_fingerprint != collection.head.fingerprint:
        raise InputError(
            f"{collection.path}: tracked with head {collection.head_name!r}; the avatar was "
            f"trained on {avatar.head_name!r}, another mesh"
        )


def check_identity(
    who: Identity, collection: Collection, advice: str = "add --other-identity"
) -> None:
    """OtherPerson where the track is not that person's; `advice`: how to drive with it anyway."""
    tracked = collection.head.shaped(collection.betas)
    distance = identity_distance(collection.head, who.neutral(collection), tracked)
    if distance > OTHER_PERSON:
        raise OtherPerson(
            f"{collection.path}: tracked on another person, whose face is {1e3 * distance:.1f} mm "
            f"off {who.name or 'the avatar'}'s (up to {1e3 * OTHER_PERSON:g} mm is one person): "
            f"{advice} to drive {who.name or 'the avatar'} with it anyway, best relative to its "
            "neutral"
        )


def posed_avatar(who: Identity, collection: Collection, clip: Clip, rows: np.ndarray) -> np.ndarray:
    """A person's mesh moved as in rows of a clip, [len(rows), V, 3] float32 metres.

    The person keeps the own identity, so that another's track drives without reshaping it; what a
    clip's own vertices say beyond its parameters is added.
    """
    moved = clip.expression[rows], clip.pose[rows], clip.translation[rows]
    posed = collection.head_with(who.head_offset).pose(who.betas, *moved).numpy()
    if clip.vertices is not None:
        posed += clip.vertices[rows] - collection.head.pose(collection.betas, *moved).numpy()
    return posed


def render_track(
    avatar_path: Path | str,
    track: str,
    appearance: str,
    out: str,
    *,
    size: int | None = None,
    frames: str | None = None,
    depth: bool = False,
    quality: str = "final",
    format: str | None = None,
    progress: Report | None = None,
    should_stop: Callable[[], bool] | None = None,
    device: str = "cpu",
    relative: bool = False,
    other_identity: bool = False,
) -> list[Path]:
    """Renders and writes one picture a frame; returns their paths.

    appearance: a name, a blend (`parse_appearance`), or "all" with {appearance} in `out`; format: a
    name in `frames.FORMATS`, by default as `out` ends. The mesh is posed by the avatar's own
    identity, that of the person whose appearance it is where there are several.
    relative: the motion from its neutral, see `relative_clip`; other_identity: another person's
    track is meant. Raises InputError before anything is written.
    """
    where = device_of(device)
    avatar = Avatar.load(avatar_path)
    avatar.field.to(where)
    collection, clip = parse_track(track)
    check_head(avatar, collection)
    names = avatar.appearances if appearance == "all" else [appearance]
    worn = {name: parse_appearance(name, avatar) for name in names}
    of = {name: _whose(avatar, look) for name, look in worn.items()}
    people = {who.name: who for who in of.values()}
    for who in people.values():
        if not other_identity:
            check_identity(who, collection)
    if relative:
        clip = relative_clip(clip)
    rows = parse_frames(frames, clip)
    settings = RenderSettings.preset(quality)
    check_pattern(out, several=len(rows) > 1, appearances=len(names), depth=depth)
    kind = format_of(out, format)
    if size is not None and not 1 <= size <= 16384:
        raise InputError(f"--size {size}: from 1 to 16384")
    posed = {who.name: posed_avatar(who, collection, clip, rows) for who in people.values()}
    written = []
    total = len(rows) * len(names)
    for name in names:
        for at, row in enumerate(rows):
            camera = Camera(
                clip.width, clip.height, clip.intrinsics[row], clip.camera_to_world[row]
            )
            if size is not None:
                scale = size / max(clip.width, clip.height)
                camera = camera.resized(
                    max(1, round(clip.width * scale)), max(1, round(clip.height * scale))
                )
            picture = render(
                avatar,
                posed[of[name].name][at],
                camera,
                worn[name],
                settings,
                expression=clip.expression[row],
                should_stop=should_stop,
            )
            path = numbered(out.replace("{appearance}", name), int(clip.frame_id[row]))
            metadata = provenance(
                [Path(avatar_path).name], [name], int(clip.frame_id[row]), quality
            )
            write_frame(path, kind, picture.rgba, None, picture.depth, metadata)
            written.append(path)
            if progress:
                progress(len(written) / total, picture=str(path))
    return written


def _whose(avatar: Avatar, appearance: Appearance) -> Identity:
    """Whose head it is that wears something."""
    return identity(avatar, avatar.appearances[shares_of(avatar, appearance)[0][0]])


def check_pattern(out: str, *, several: bool, appearances: int, depth: bool = False) -> None:
    """InputError where the pictures of a sequence could not all have a path of their own."""
    suffix = Path(out).suffix
    if suffix not in (".png", ".exr"):
        raise InputError(f"--out {out!r}: pictures end in .png or .exr")
    if depth and suffix != ".exr":
        raise InputError(f"--out {out!r}: depth needs .exr")
    if several and "#" not in out:
        raise InputError(f"--out {out!r}: several frames need # for the number, e.g. ####.png")
    if appearances > 1 and "{appearance}" not in out:
        raise InputError(f"--out {out!r}: several appearances need {{appearance}} in it")
