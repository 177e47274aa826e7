"""A scene that shows an avatar moving as a clip moved; `pav scene`."""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import InputError
from .avatars import stored_path
from .lens import from_intrinsics
from .view import use_standard

ENGINE = "PAV"


@dataclass
class SceneObjects:
    """What `build_scene` made."""

    mesh: Any
    armature: Any
    camera: Any


def build_head(avatar_path: Path, appearance: str | None = None) -> Any:
    """Adds the head of an avatar to the current scene, at rest: a `rig.Rig` with its properties.

    Of an avatar of several people it is the head of the one whose the appearance is, for good: it
    wears that person's appearances alone. InputError where the avatar, its head model or the
    appearance is wrong.
    """
    import bpy

    from ..core.field.avatar import head_of
    from ..core.field.identities import identity
    from . import avatars
    from .rig import build_rig

    avatar = avatars.load(avatar_path)
    name = avatar.appearances[0] if appearance is None else appearance
    check_appearance(avatar.appearances, name)  # told before anything is built
    try:
        head = head_of(avatar, name)
    except InputError as error:
        raise InputError(f"{avatar_path}: {error}") from error
    if head.expression_names != avatar.expression_names:  # another version's names for the same
        head = replace(head, expression_names=avatar.expression_names)
    who = identity(avatar, name)
    rig = build_rig(head, who.betas, avatar_path.stem, bpy.context.scene.collection)
    rig.mesh.pav.identity = who.name
    rig.mesh.pav.avatar = stored_path(avatar_path, bpy.data.filepath)
    choose_appearance(rig.mesh, avatar.appearances, name)
    return rig


def check_appearance(known: list[str], name: str) -> None:
    """InputError naming the appearances there are, unless `name` is one."""
    if name not in known:
        raise InputError(f"unknown appearance {name!r}; the avatar has {', '.join(known)}")


def choose_appearance(mesh: Any, known: list[str], name: str) -> None:
    """Sets the appearance of a head object whose avatar has the appearances `known`."""
    check_appearance(known, name)
    mesh.pav.appearance = name


def wear_only(mesh: Any, known: list[str], name: str) -> None:
    """Makes a head wear one appearance throughout: no layers, no keyframes of either."""
    from .motion import curves

    check_appearance(known, name)
    mesh.pav.layers.clear()
    if mesh.animation_data is not None:
        for driver in [d for d in mesh.animation_data.drivers if d.data_path.startswith("pav.")]:
            mesh.animation_data.drivers.remove(driver)
        if mesh.animation_data.action is not None:
            found = curves(mesh)
            for curve in [c for c in found if c.data_path.startswith("pav.")]:
                found.remove(curve)
    choose_appearance(mesh, known, name)


def import_track(
    mesh: Any,
    collection: Any,
    clip_name: str,
    fps: float | None = None,
    *,
    relative: bool = False,
    neutral: int | None = None,
) -> Any:
    """Animates a head object, and a camera of its own, as in a clip of a `Collection`; returns
    the camera, now the scene's.

    relative: the motion from the clip's neutral, as another person's is put on; see
    `core.collection.relative_clip`, also for `neutral`.

    The scene's frame numbers are the clip's own (`frame_id`); frames of held-out cameras are left
    out; between frames everything is linear. Sets the scene's range, size and, if given, rate. The
    clip's pictures stand behind the head in the camera's view, as its background images.
    """
    import bpy

    from ..core.collection import relative_clip
    from . import backdrop
    from .motion import Motion, apply_camera, apply_motion
    from .overrides import check_editable
    from .rig import find_armature

    scene = bpy.context.scene
    clip = collection.clip(clip_name)
    if relative:
        clip = relative_clip(clip, neutral)
    armature = find_armature(mesh)
    keys = mesh.data.shape_keys
    head = collection.head
    lacking = [n for n in head.expression_names if keys is None or n not in keys.key_blocks]
    if armature is None or lacking:
        what = f"shape key {lacking[0]!r}" if lacking else "armature"
        raise InputError(
            f"object {mesh.name!r} has no {what}: clip {clip_name!r} moves the head "
            f"{collection.head_name!r}; import that clip's avatar first"
        )
    check_editable(mesh, armature)
    rows = filmed_rows(clip)
    frames = clip.frame_id[rows].astype(np.float64)
    motion = Motion(clip.expression[rows], clip.pose[rows], clip.translation[rows], frames)
    apply_motion(mesh, armature, head.expression_names, head.joint_names, motion)
    lenses = [from_intrinsics(k, clip.width, clip.height) for k in clip.intrinsics[rows]]
    camera = _track_camera(scene, mesh)
    camera.data.type, camera.data.sensor_fit = "PERSP", lenses[0].sensor_fit
    camera.data.sensor_width = lenses[0].sensor_width
    apply_camera(camera, frames, clip.camera_to_world[rows], lenses)
    render = scene.render
    render.resolution_x, render.resolution_y = clip.width, clip.height
    render.resolution_percentage = 100
    render.pixel_aspect_x, render.pixel_aspect_y = lenses[0].aspect_x, lenses[0].aspect_y
    scene.frame_start, scene.frame_end = int(frames[0]), int(frames[-1])
    if fps is not None:
        render.fps, render.fps_base = frame_rate(fps)
    first = collection.image_path(clip, int(rows[0]))
    backdrop.show_pictures(camera, first.parent, clip.frame_id[rows])
    for image in backdrop.pictures_of(camera):
        image.filepath = stored_path(first, bpy.data.filepath)
    scene.frame_set(scene.frame_start)
    return camera


def check_person(mesh: Any, collection: Any) -> None:
    """InputError where a collection was tracked on another person than a head object's avatar, or
    on another head model."""
    from ..core.field.identities import identity
    from ..core.rendering.sequence import check_head, check_identity
    from . import avatars

    path = avatars.path_of(mesh.pav)
    avatar = avatars.load(path)
    check_head(avatar, collection)
    who = identity(avatar, avatars.looks(path, mesh.pav.identity)[0])
    check_identity(who, collection, 'tick "Another Person\'s Track" (confirm_identity)')


def use_engine(scene: Any) -> None:
    """Settings under which the avatar's colours reach the file as they were learned."""
    scene.render.engine = ENGINE
    scene.render.film_transparent = True
    scene.render.dither_intensity = 0.0
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):  # Blender 5: the formats on offer depend on it
        settings.media_type = "IMAGE"
    settings.file_format, settings.color_mode, settings.color_depth = "PNG", "RGBA", "8"
    use_standard(scene)


def build_scene(
    avatar_path: Path,
    collection: Any,
    clip_name: str,
    *,
    appearance: str | None = None,
    fps: float | None = None,
    relative: bool = False,
    other_identity: bool = False,
) -> SceneObjects:
    """Adds to the current scene an avatar that moves as a clip of a `Collection`, with the clip's
    camera, size and frames, ready to render. InputError where they do not fit together, and where
    the clip is another person's, unless `other_identity` says that this is meant."""
    import bpy

    from ..core.field.identities import identity
    from ..core.rendering.sequence import check_head, check_identity
    from . import avatars

    avatar = avatars.load(avatar_path)
    check_head(avatar, collection)
    name = avatar.appearances[0] if appearance is None else appearance
    who = identity(avatar, name)
    if not other_identity:
        check_identity(who, collection)
    collection.clip(clip_name)  # a wrong name is told before anything is built
    rig = build_head(avatar_path, appearance)
    camera = import_track(rig.mesh, collection, clip_name, fps, relative=relative)
    use_engine(bpy.context.scene)
    return SceneObjects(rig.mesh, rig.armature, camera)


def filmed_rows(clip: Any) -> np.ndarray:
    """Rows of the clip's own camera by rising frame number; all, where there are no others."""
    rows = clip.indices("train", "test")
    if len(rows) == 0:
        rows = np.arange(len(clip))
    return rows[np.argsort(clip.frame_id[rows], kind="stable")]


def _track_camera(scene: Any, mesh: Any) -> Any:
    """The head's own camera, made when it has none: the user's cameras stay as they are."""
    import bpy

    camera = mesh.pav.camera
    linked = camera is not None and any(
        thing.library or thing.override_library for thing in (camera, camera.data)
    )
    if camera is None or linked or camera.name not in scene.objects:
        name = f"{mesh.name} camera"
        camera = bpy.data.objects.new(name, bpy.data.cameras.new(name))
        camera.data.clip_start = 0.01
        scene.collection.objects.link(camera)
        mesh.pav.camera = camera
    scene.camera = camera
    return camera


def frame_rate(fps: float) -> tuple[int, float]:
    """Blender's whole rate and its divisor, as 29.97 = 30 / 1.001."""
    whole = max(1, round(fps))
    return whole, whole / fps


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("avatar", type=Path, metavar="AVATAR", help="the avatar file (.pav)")
    parser.add_argument(
        "--track",
        required=True,
        metavar="COLLECTION:CLIP",
        help="the clip whose motion and camera the scene gets",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.blend")
    parser.add_argument("--appearance", metavar="NAME", help="default: the avatar's first")
    parser.add_argument("--fps", type=float, default=25.0, help="frames a second (default 25)")
    parser.add_argument(
        "--relative", action="store_true", help="move from the track's neutral, not as it is"
    )
    parser.add_argument(
        "--other-identity", action="store_true", help="yes, the track is another person's"
    )


def run(args: argparse.Namespace) -> int:
    """`pav scene`: builds the scene in an empty file and saves it, whole or not at all."""
    from ..core.rendering.sequence import parse_track
    from . import backdrop

    if args.out.suffix != ".blend":
        raise InputError(f"--out {args.out}: a Blender file ends in .blend")
    if not args.out.resolve().parent.is_dir():
        raise InputError(f"--out {args.out}: no such folder")
    if not args.fps > 0:
        raise InputError(f"--fps {args.fps}: above 0")
    collection, clip = parse_track(args.track)
    with blender():
        made = build_scene(
            args.avatar,
            collection,
            clip.name,
            appearance=args.appearance,
            fps=args.fps,
            relative=args.relative,
            other_identity=args.other_identity,
        )
        made.mesh.pav.avatar = stored_path(args.avatar, str(args.out))
        first = collection.image_path(clip, int(filmed_rows(clip)[0]))
        for image in backdrop.pictures_of(made.camera):
            image.filepath = stored_path(first, str(args.out))
        _scene().render.filepath = f"//{args.out.stem}/"
        save_copy(args.out)
    print(f"{args.out}: clip {clip.name}, {len(clip)} frames")
    if clip.vertices is not None:
        print("  the clip has meshes beyond its parameters: the rig moves by the parameters alone")
    return 0


def save_copy(path: Path) -> None:
    """Saves the open file as `path` through a temporary name beside it."""
    import bpy

    temporary = path.resolve().with_name(f".{path.stem}.partial-{os.getpid()}.blend")
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(temporary), copy=True, compress=True)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _scene() -> Any:
    import bpy

    return bpy.context.scene


class blender:
    """An empty Blender file with the add-on registered; on the bpy wheel it is unregistered on
    the way out, for a class left registered hangs or crashes that process at its end."""

    def __enter__(self) -> None:
        try:
            import bpy
        except ImportError as error:
            raise InputError(
                "`pav scene` needs Blender: `blender --command pav scene ...`, or `pip install bpy`"
            ) from error
        from .. import register

        bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
        self.registered = not hasattr(bpy.types.Object, "pav")
        if self.registered:
            register()

    def __exit__(self, *_error: object) -> None:
        from .. import unregister

        if self.registered:
            unregister()
