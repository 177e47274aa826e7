"""Arrows point down only: reads every import of the package."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "pav_blender"

# a folder may import those to its right, and itself
OUTER = ["ui", "operators", "benchmarks", "bridge", "studio", "core"]
INNER = [
    {"baking"},
    {"evaluation"},
    {"training", "tracking", "exporting"},
    {"rendering"},
    {"field", "deformation"},
    {"kernels"},
    {"collection"},
    {"head"},
]


def imports(path: Path) -> list[tuple[str, ...]]:
    """Modules a file imports, as paths within the package; others by their own name."""
    here = path.relative_to(PACKAGE.parent).with_suffix("").parts
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [tuple(alias.name.split(".")) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level] if node.level else ()
            module = base + tuple((node.module or "").split(".") if node.module else ())
            found += [(*module, alias.name) for alias in node.names]
    return found


ENTRY_POINTS = {PACKAGE / "bridge" / "child.py"}  # `python -m` this: above every layer


def files(folder: str) -> list[Path]:
    return sorted(set((PACKAGE / folder).rglob("*.py")) - ENTRY_POINTS)


def test_the_reader_of_imports_sees_relative_and_nested_ones():
    found = imports(PACKAGE / "core" / "rendering" / "render.py")
    assert ("pav_blender", "core", "field", "avatar", "Avatar") in found


@pytest.mark.parametrize("folder", ["core", *OUTER[:-1], "verbs"])
def test_the_package_never_imports_itself_by_name(folder):
    """An extension's package is called bl_ext.<repository>.pav_blender."""
    for path in files(folder):
        absolute = [
            node.module
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.ImportFrom) and node.level == 0 and node.module
        ]
        assert not [m for m in absolute if m.split(".")[0] == "pav_blender"], path


def test_core_does_not_know_blender():
    for path in files("core"):
        roots = {module[0] for module in imports(path)}
        assert not roots & {"bpy", "mathutils", "gpu", "bl_ui"}, path


@pytest.mark.parametrize("folder", OUTER)
def test_outer_layers_point_down(folder):
    above = set(OUTER[: OUTER.index(folder)]) | {"cli", "verbs", "addon", "engine"}
    if folder == "bridge":
        above |= {"studio"}
    for path in files(folder):
        reached = {m[1] for m in imports(path) if m[0] == "pav_blender" and len(m) > 1}
        assert not reached & above, f"{path} imports {reached & above}"


def test_core_layers_point_down():
    rank = {name: i for i, names in enumerate(INNER) for name in names}
    for path in files("core"):
        own = path.relative_to(PACKAGE / "core").parts[0]
        if own not in rank:
            continue
        for module in imports(path):
            if module[:2] == ("pav_blender", "core") and len(module) > 2 and module[2] in rank:
                assert rank[module[2]] >= rank[own], f"{path} imports {'.'.join(module)}"
