"""What the Training panel asks for, kept with the scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ..core.errors import InputError
from . import avatars
from .training import Wanted

SOURCES = (
    ("VIDEOS", "Videos", "Track the head in videos first, then learn it"),
    ("COLLECTION", "Tracked Collection", "Learn from a collection that was tracked or imported"),
)


class PavClip(bpy.types.PropertyGroup):
    """A video of the person."""

    path: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Video", description="Video file, or a folder of pictures", subtype="FILE_PATH"
    )
    appearance: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Appearance",
        description="What the person looks like in this video. Videos of one look share its name",
    )


class PavTraining(bpy.types.PropertyGroup):
    """What to train an avatar from, how long, and where to write it."""

    source: bpy.props.EnumProperty(name="Source", items=SOURCES)  # type: ignore[valid-type]
    clips: bpy.props.CollectionProperty(type=PavClip)  # type: ignore[valid-type]
    active_clip: bpy.props.IntProperty()  # type: ignore[valid-type]
    collection: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Collection",
        description="Folder of tracked clips (collection.json)",
        subtype="DIR_PATH",
    )
    output: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Avatar", description="Avatar file (.pav) to write", subtype="FILE_PATH"
    )
    minutes: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Minutes",
        description="How long to learn, tracking not counted; 0: for 15,000 iterations",
        min=0,
        soft_max=240,
        default=20,
        precision=1,
    )
    track_again: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Track Again",
        description="Track the videos anew even if that was done before, replacing the collection "
        "beside the avatar",
    )
    options: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Options",
        description="Further options of `pav train`, as on a command line",
    )


def output_of(settings: Any) -> Path | None:
    """The avatar file to write; None where none is named, or it cannot be known yet."""
    if not settings.output:
        return None
    try:
        return avatars.resolve(settings.output)
    except InputError:
        return None


def wanted_of(settings: Any) -> Wanted:
    """What the panel asks for. InputError for what is not filled in, or not there."""
    if not settings.output:
        raise InputError("choose the avatar file to write")
    videos = settings.source == "VIDEOS"
    folder = settings.collection if not videos else ""
    return Wanted(
        avatars.resolve(settings.output),
        tuple((avatars.resolve(c.path), c.appearance) for c in settings.clips) if videos else (),
        avatars.resolve(folder) if folder else None,
        round(settings.minutes, 3),
        settings.options,
        settings.track_again and videos,
    )


classes = (PavClip, PavTraining)
