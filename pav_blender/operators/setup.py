"""Installing what Blender's Python lacks, and looking at what is there."""

from __future__ import annotations

from typing import Any

import bpy

from ..bridge import environment, install, jobs, packages
from ..core.errors import PavError
from .context import StartsJob
from .reporting import reporting

BUILDS = (
    ("CPU", "CPU", "Runs everywhere"),
    ("CUDA", "CUDA", "For NVIDIA graphics cards, on Linux and Windows"),
)


class PAV_OT_install_torch(StartsJob, bpy.types.Operator):
    """Install PyTorch, and what else is missing, into the add-on's own folder"""

    bl_idname = "pav.install_torch"
    bl_label = "Install PyTorch"

    build: bpy.props.EnumProperty(name="Build", items=BUILDS)  # type: ignore[valid-type]
    tracking: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="For Videos Too",
        description="Also PyAV and MediaPipe, which training from videos needs",
        default=True,
    )

    def invoke(self, context: Any, _event: Any) -> set[str]:
        if not bpy.app.online_access:
            return self.execute(context)  # says so
        return context.window_manager.invoke_props_dialog(self, width=460)

    def draw(self, _context: Any) -> None:
        layout, build = self.layout, install.BUILDS[self.build]
        layout.row().prop(self, "build", expand=True)
        layout.prop(self, "tracking")
        layout.label(text=f"From {build.index}", icon="URL")
        loaded, taken = build.megabytes / 1000, build.on_disk / 1000
        layout.label(
            text=f"About {loaded:.1f} GB to load, {taken:.1f} GB on disk", icon="DISK_DRIVE"
        )
        layout.label(text=f"Into {packages.own_folder()}", icon="FILE_FOLDER")

    @reporting
    def execute(self, _context: Any) -> set[str]:
        if not bpy.app.online_access:
            raise PavError(
                "online access is off: allow it in Preferences > System > Network, or name an "
                "environment that has PyTorch"
            )
        build = install.BUILDS[self.build]
        jobs.start(
            jobs.INSTALLING,
            lambda: install.start(build, tracking=self.tracking),
            "Installed; restart Blender if PyTorch was in use",
        )
        environment.forget()
        return {"FINISHED"}


class PAV_OT_remove_packages(bpy.types.Operator):
    """Remove the packages that were installed into the add-on's folder"""

    bl_idname = "pav.remove_packages"
    bl_label = "Remove Installed Packages"

    @classmethod
    def poll(cls, _context: Any) -> bool:
        return not jobs.running() and packages.own_folder().is_dir()

    def invoke(self, context: Any, event: Any) -> set[str]:
        return context.window_manager.invoke_confirm(self, event)

    @reporting
    def execute(self, _context: Any) -> set[str]:
        install.remove()
        environment.forget()
        return {"FINISHED"}


class PAV_OT_check_environment(StartsJob, bpy.types.Operator):
    """Look at packages and devices in the Python that training runs in"""

    bl_idname = "pav.check_environment"
    bl_label = "Check Environment"

    @reporting
    def execute(self, _context: Any) -> set[str]:
        environment.forget()
        jobs.start(jobs.CHECKING, environment.check, "Checked")
        return {"FINISHED"}


classes = (PAV_OT_install_torch, PAV_OT_remove_packages, PAV_OT_check_environment)
register, unregister = bpy.utils.register_classes_factory(classes)
