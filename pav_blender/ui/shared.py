"""What the panels have in common."""

from __future__ import annotations

from typing import Any

from ..bridge import jobs, packages, requirements


class Sidebar:
    """A panel of the PAV tab of the 3D view's sidebar."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PAV"


def draw_missing(layout: Any) -> None:
    names = requirements.missing()
    if not names:
        return
    box = layout.box()
    box.label(text=f"Missing: {', '.join(names)}", icon="ERROR")
    show = box.operator("preferences.addon_show", text="Install in Preferences", icon="PREFERENCES")
    show.module = packages.ROOT


def draw_job(layout: Any, name: str) -> None:
    job = jobs.current()
    if job is None or job.name != name:
        return
    if job.running:
        layout.progress(factor=job.work.fraction, text=job.status)
        layout.operator("pav.cancel_job", icon="CANCEL")
    else:
        layout.label(text=job.status, icon="ERROR" if job.work.error else "CHECKMARK")
