"""Personalised head avatars from unstructured clips, trained and animated in Blender."""
