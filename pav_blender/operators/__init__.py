"""Operators: a few lines each over `bridge`."""

from . import avatar, compositing, files, jobs, layers, motion, output, setup, training

modules = (avatar, files, layers, motion, training, output, compositing, jobs, setup)


def register() -> None:
    for module in modules:
        module.register()


def unregister() -> None:
    for module in reversed(modules):
        module.unregister()
