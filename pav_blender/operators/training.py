"""Training beside Blender's window."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..bridge import jobs, training
from ..bridge.training_properties import output_of, wanted_of
from .context import ChoosesFile, StartsJob
from .reporting import reporting


def _start(wanted: training.Wanted, resume: bool) -> set[str]:
    jobs.start(
        jobs.TRAINING,
        lambda: training.start(wanted, resume=resume),
        f"Wrote {wanted.output.name}",
    )
    return {"FINISHED"}


class PAV_OT_train(StartsJob, bpy.types.Operator):
    """Train an avatar from the videos or the collection, in a process beside Blender"""

    bl_idname = "pav.train"
    bl_label = "Train"

    @reporting
    def execute(self, context: Any) -> set[str]:
        return _start(wanted_of(context.scene.pav.training), resume=False)


class PAV_OT_resume_training(bpy.types.Operator):
    """Go on with the training of this avatar that was cancelled, or ended with Blender"""

    bl_idname = "pav.resume_training"
    bl_label = "Resume"

    @classmethod
    def poll(cls, context: Any) -> bool:
        output = output_of(context.scene.pav.training)
        return not jobs.running() and output is not None and training.unfinished(output)

    @reporting
    def execute(self, context: Any) -> set[str]:
        output = output_of(context.scene.pav.training)
        assert output is not None  # poll
        return _start(training.read_note(output), resume=True)


class PAV_OT_discard_training(bpy.types.Operator):
    """Forget the unfinished training of this avatar. Videos, collections and finished avatars
    stay"""

    bl_idname = "pav.discard_training"
    bl_label = "Discard"

    @classmethod
    def poll(cls, context: Any) -> bool:
        return bool(PAV_OT_resume_training.poll(context))

    def invoke(self, context: Any, event: Any) -> set[str]:
        return context.window_manager.invoke_confirm(self, event)

    @reporting
    def execute(self, context: Any) -> set[str]:
        output = output_of(context.scene.pav.training)
        assert output is not None  # poll
        training.discard(output)
        return {"FINISHED"}


class PAV_OT_add_clips(ChoosesFile, bpy.types.Operator):
    """Add videos of the person; their appearances are named as their files are"""

    bl_idname = "pav.add_clips"
    bl_label = "Add Videos"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    files: bpy.props.CollectionProperty(  # type: ignore[valid-type]
        type=bpy.types.OperatorFileListElement, options={"HIDDEN", "SKIP_SAVE"}
    )
    directory: bpy.props.StringProperty(subtype="DIR_PATH")  # type: ignore[valid-type]
    filter_folder: bpy.props.BoolProperty(  # type: ignore[valid-type]
        default=True, options={"HIDDEN"}
    )
    filter_movie: bpy.props.BoolProperty(  # type: ignore[valid-type]
        default=True, options={"HIDDEN"}
    )

    @reporting
    def execute(self, context: Any) -> set[str]:
        settings = context.scene.pav.training
        known = {clip.path for clip in settings.clips}
        for name in [file.name for file in self.files if file.name]:
            path = str(Path(self.directory) / name)
            if path not in known:
                known.add(path)
                clip = settings.clips.add()
                clip.path, clip.appearance = path, Path(name).stem
        settings.active_clip = max(0, len(settings.clips) - 1)
        return {"FINISHED"}


class PAV_OT_remove_clip(bpy.types.Operator):
    """Take the chosen video off the list"""

    bl_idname = "pav.remove_clip"
    bl_label = "Remove Video"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        return bool(context.scene.pav.training.clips)

    def execute(self, context: Any) -> set[str]:
        settings = context.scene.pav.training
        settings.clips.remove(settings.active_clip)
        settings.active_clip = max(0, min(settings.active_clip, len(settings.clips) - 1))
        return {"FINISHED"}


classes = (
    PAV_OT_train,
    PAV_OT_resume_training,
    PAV_OT_discard_training,
    PAV_OT_add_clips,
    PAV_OT_remove_clip,
)
register, unregister = bpy.utils.register_classes_factory(classes)
