"""The steps of ``tools/build_builtin_head.py``."""
