"""What a scene is: a function from what it is given to claims, and the raw figures beside them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from ...core.evaluation.report import Claim
from .subjects import Head, ball_of, head_of


@dataclass(eq=False)
class Given:
    """folder: where the trained avatar lies, and what a scene may write in. The subjects are made
    when they are first asked for."""

    folder: Path
    _balls: dict[int, Head] = field(default_factory=dict)

    @cached_property
    def head(self) -> Head:
        """A person, trained for seconds on the built-in collection."""
        return head_of(self.folder)

    @property
    def ball(self) -> Head:
        """320 triangles in two loud appearances: small enough that every sample of a ray can be
        held against every triangle in float64. Made anew each time: a scene may spoil it."""
        return ball_of()


@dataclass
class Found:
    """What was seen in a scene."""

    claims: list[Claim] = field(default_factory=list)
    raw: dict[str, Any] = field(default_factory=dict)

    def at_most(self, name: str, value: float, target: float, unit: str = "") -> None:
        self.claims.append(Claim.at_most(name, float(value), target, unit))

    def at_least(self, name: str, value: float, target: float, unit: str = "") -> None:
        self.claims.append(Claim.at_least(name, float(value), target, unit))


@dataclass(frozen=True)
class Scene:
    """alone: runs in a process of its own, so that its greatest memory is its own."""

    name: str
    run: Callable[[Given], Found]
    alone: bool = False
