"""The add-on's preferences: what is there, what is missing, and where else to look."""

from __future__ import annotations

import os
from typing import Any

import bpy

from ..bridge import environment, jobs, packages, requirements
from .shared import draw_job

_USES = {
    "torch": "networks",
    "numba": "compiled kernels",
    "safetensors": "avatar files",
    "scipy": "geometry",
    "OpenImageIO": "pictures",
    "av": "videos",
    "mediapipe": "faces in videos",
}


def _changed(_self: Any, _context: Any) -> None:
    packages.activate()
    environment.forget()


class PavPreferences(bpy.types.AddonPreferences):
    """Where jobs run and where packages come from."""

    bl_idname = packages.ROOT

    environment: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Environment",
        description="A Python environment that has PyTorch, or its site-packages folder. It must "
        "be made for Blender's version of Python",
        subtype="DIR_PATH",
        update=_changed,
    )
    python: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Python for Jobs",
        description="Python to track and train in, of any version that PAV supports; empty for "
        "Blender's",
        subtype="FILE_PATH",
        update=_changed,
    )

    def draw(self, _context: Any) -> None:
        layout = self.layout
        wrong = packages.problem(packages.chosen_environment())
        _draw_packages(layout)
        step = environment.next_step(wrong)
        if step:
            layout.label(text=step, icon="FORWARD")
        row = layout.row()
        row.operator("pav.install_torch", icon="IMPORT")
        row.operator("pav.check_environment", icon="VIEWZOOM")
        row.operator("pav.remove_packages", icon="TRASH", text="Remove")
        draw_job(layout, jobs.INSTALLING)
        draw_job(layout, jobs.CHECKING)
        _draw_checked(layout)
        column = layout.column()
        column.use_property_split = True
        column.prop(self, "environment")
        if wrong:
            column.label(text=wrong, icon="ERROR")
        column.prop(self, "python")
        python = packages.chosen_python()
        if python and not os.access(python, os.X_OK):
            column.label(text=f"{python}: not a program", icon="ERROR")


def _draw_packages(layout: Any) -> None:
    grid = layout.box().grid_flow(row_major=True, columns=2, even_columns=True, align=True)
    for name, use in _USES.items():
        version = requirements.version(name)
        needed = name in requirements.NEEDED
        icon = "CHECKMARK" if version else "ERROR" if needed else "INFO"
        split = grid.row().split(factor=0.55)
        split.label(text=f"{name} {version or 'missing'}", icon=icon)
        split.label(text=use)


def _draw_checked(layout: Any) -> None:
    checked = environment.found()
    if checked is None:
        return
    box = layout.box()
    versions, machine = checked["versions"], checked["machine"]
    where = packages.chosen_python() or "Blender's Python"
    box.label(text=f"Jobs run in {where}, {versions['python']}", icon="CONSOLE")
    listed = ", ".join(f"{name} {v}" for name, v in versions.items() if name != "python")
    box.label(text=listed or "no packages")
    devices = ", ".join(checked["devices"]) or "none: PyTorch is missing or does not load"
    box.label(text=f"Devices: {devices}; {machine['threads']} threads")


classes = (PavPreferences,)
_register, _unregister = bpy.utils.register_classes_factory(classes)


def register() -> None:
    _register()
    packages.activate()


def unregister() -> None:
    packages.deactivate()
    _unregister()
