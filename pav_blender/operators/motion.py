"""Moving a head by what was tracked."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..bridge import avatars, requirements
from ..bridge import scene as bridge_scene
from ..core.errors import InputError, OtherPerson, PavError
from .context import ChoosesFile, OfHead, chosen_head, object_mode
from .reporting import reporting


class PAV_OT_import_track(OfHead, bpy.types.Operator):
    """Animate the active head, and the camera, as in a clip of a collection"""

    bl_idname = "pav.import_track"
    bl_label = "Import Track"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    relative: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Relative",
        description="Put the motion on the head as it differs from the clip's neutral: for "
        "another person's track",
    )
    neutral: bpy.props.IntProperty(  # type: ignore[valid-type]
        name="Neutral Frame",
        description="Frame of the clip in which the person does nothing; -1: the median of all",
        default=-1,
        min=-1,
    )
    confirm_identity: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Another Person's Track",
        description="Yes, the track is of another person than the avatar",
        options={"SKIP_SAVE"},
    )

    def invoke(self, context: Any, _event: Any) -> set[str]:
        try:
            requirements.check()
            collection, _ = _chosen(context)
            bridge_scene.check_person(chosen_head(context), collection)
        except OtherPerson as error:
            self.warning, self.relative = str(error), True
            return context.window_manager.invoke_props_dialog(self, width=500)
        except PavError:
            pass  # `execute` reports it
        return self.execute(context)

    def draw(self, _context: Any) -> None:
        if getattr(self, "warning", ""):
            for line in textwrap.wrap(self.warning, 80):
                self.layout.label(text=line)
            self.layout.prop(self, "confirm_identity")
        self.layout.prop(self, "relative")
        self.layout.prop(self, "neutral")

    @reporting
    def execute(self, context: Any) -> set[str]:
        requirements.check()
        object_mode(context)
        collection, clip = _chosen(context)
        head = chosen_head(context)
        if not self.confirm_identity:
            bridge_scene.check_person(head, collection)
        neutral = self.neutral if self.neutral >= 0 else None
        bridge_scene.import_track(head, collection, clip, relative=self.relative, neutral=neutral)
        bridge_scene.use_engine(context.scene)
        self.report({"INFO"}, f"{clip}: {len(collection.clip(clip))} frames")
        return {"FINISHED"}


def _chosen(context: Any) -> tuple[Any, str]:
    """The collection and the clip's name that the panel says."""
    from ..core.collection import read_collection

    settings = context.scene.pav
    if not settings.collection:
        raise InputError("choose the collection's folder first")
    collection = read_collection(avatars.resolve(settings.collection))
    return collection, settings.clip or collection.clips[0].name


class PAV_OT_import_livelink(OfHead, ChoosesFile, bpy.types.Operator):
    """Animate the active head as the app Live Link Face recorded it (CSV)"""

    bl_idname = "pav.import_livelink"
    bl_label = "Import Live Link Face"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    filepath: bpy.props.StringProperty(subtype="FILE_PATH")  # type: ignore[valid-type]
    filter_glob: bpy.props.StringProperty(  # type: ignore[valid-type]
        default="*.csv", options={"HIDDEN"}
    )
    start: bpy.props.IntProperty(  # type: ignore[valid-type]
        name="First Frame", description="The scene's frame of the recording's first", default=1
    )
    timecode_rate: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Timecode Rate",
        description="Frames a second that the recording's timecodes count; 0: told from them",
        min=0.0,
    )
    turn_head: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Turn the Head", description="The head's rotation turns the neck", default=True
    )

    @reporting
    def execute(self, context: Any) -> set[str]:
        requirements.check()
        from ..bridge import livelink

        object_mode(context)
        done = livelink.import_take(
            chosen_head(context),
            Path(bpy.path.abspath(self.filepath)),
            start=self.start,
            timecode_rate=self.timecode_rate,
            turn_head=self.turn_head,
        )
        self.report({"INFO"}, done)
        return {"FINISHED"}


classes = (PAV_OT_import_track, PAV_OT_import_livelink)
register, unregister = bpy.utils.register_classes_factory(classes)
