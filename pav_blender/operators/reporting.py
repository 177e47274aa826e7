"""Errors of the project become one line in Blender's status bar (an exception from Python)."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from ..core.errors import PavError


def reporting(execute: Callable[[Any, Any], set[str]]) -> Callable[[Any, Any], set[str]]:
    """Decorates `execute`: a PavError is reported, and the operator cancelled."""

    @functools.wraps(execute)
    def wrapped(self: Any, context: Any) -> set[str]:
        try:
            return execute(self, context)
        except PavError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}

    return wrapped
