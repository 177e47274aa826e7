"""Operators: a few lines each over `bridge`."""

from . import avatar, files, jobs, layers, motion, output, setup, training

modules = (avatar, files, layers, motion, training, output, jobs, setup)


def register() -> None:
    for module in modules:
        module.register()


def unregister() -> None:
    for module in reversed(modules):
        module.unregister()
