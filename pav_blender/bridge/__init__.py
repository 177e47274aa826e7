"""Blender data to core data and back. Nothing in core knows of it."""
