"""Panels: each draws, none computes."""

from . import avatar, files, motion, output, training

modules = (avatar, files, motion, training, output)


def register() -> None:
    for module in modules:
        module.register()


def unregister() -> None:
    for module in reversed(modules):
        module.unregister()
