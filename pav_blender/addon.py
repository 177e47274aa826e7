"""What the extension adds to Blender, in order, undone in reverse."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import bpy

from . import engine, operators, ui
from .bridge import jobs, links, properties

_parts = (properties, links, jobs, engine, operators, ui)
_commands: list[object] = []


def register() -> None:
    done = []
    try:
        for part in _parts:
            part.register()
            done.append(part)
    except Exception:
        for part in reversed(done):
            part.unregister()
        raise
    _commands.append(bpy.utils.register_cli_command("pav", _command))


def unregister() -> None:
    bpy.utils.unregister_cli_command(_commands.pop())
    for part in reversed(_parts):
        part.unregister()


def _command(argv: Sequence[str]) -> int:
    """`blender --command pav ...`: Blender leaves with the number returned."""
    from .cli import main

    code = main(list(argv))
    sys.stdout.flush()
    sys.stderr.flush()
    return code
