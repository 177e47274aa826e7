"""What the Python that jobs run in offers, as `pav doctor` found it there."""

from __future__ import annotations

from typing import Any

from . import requirements
from .process import Fields, Process

_found: list[dict[str, Any]] = []


def found() -> dict[str, Any] | None:
    """What the last check found: machine, versions, devices, missing; None before one."""
    return _found[-1] if _found else None


def forget() -> None:
    _found.clear()


def check() -> Process:
    """Starts the check in the Python that jobs run in."""

    def listen(said: Fields) -> None:
        if isinstance(said.get("environment"), dict):
            _found[:] = [said["environment"]]

    return Process(["doctor", "--json"], listen=listen, merged=True, message="Looking")


def next_step(environment_problem: str) -> str:
    """What to do next, as one line; "" where everything is there."""
    if environment_problem:
        return "Name another environment, or leave it empty and install PyTorch"
    lacking = requirements.missing()
    if lacking:
        return f"Press Install PyTorch: {', '.join(lacking)} will be put into the add-on's folder"
    checked = found()
    if checked and checked["missing"]:
        wanted = " ".join(checked["missing"])
        return f"In the Python for jobs: pip install {wanted}"
    if requirements.missing(requirements.TRACKING):
        return "To train from videos, install what tracking needs too"
    return ""
