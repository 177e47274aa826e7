"""Cameras, a rasteriser, and pictures of an avatar."""

from .cameras import Camera

__all__ = ["Camera"]
