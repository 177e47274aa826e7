"""Panels and preferences."""

from . import panels

register, unregister = panels.register, panels.unregister
