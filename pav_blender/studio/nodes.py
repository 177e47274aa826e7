"""Shader graphs in a few words."""

from __future__ import annotations

from typing import Any

import bpy


class Graph:
    """Builds a node tree: `add` makes a node, keyword arguments feed its sockets."""

    def __init__(self, tree):
        self.tree = tree
        tree.nodes.clear()

    def add(self, kind: str, settings: dict[str, Any] | None = None, **sockets):
        node = self.tree.nodes.new(f"ShaderNode{kind}")
        for key, value in (settings or {}).items():
            setattr(node, key, value)
        for key, value in sockets.items():
            self.feed(node, key, value)
        return node

    def feed(self, node, key: str, value) -> None:
        """`key` is a socket's name with underscores for spaces, or `_N` for the N-th socket."""
        if key[0] == "_" and key[1:].isdigit():
            socket = node.inputs[int(key[1:])]
        else:
            socket = node.inputs[key.replace("_", " ")]
        if isinstance(value, bpy.types.NodeSocket):
            self.tree.links.new(value, socket)
        elif isinstance(value, tuple) and len(value) == 3 and len(socket.default_value) == 4:
            socket.default_value = (*value, 1.0)
        else:
            socket.default_value = value

    def attribute(self, name: str):
        return self.add("Attribute", {"attribute_name": name})

    def math(self, operation: str, *values):
        node = self.add("Math", {"operation": operation})
        for k, value in enumerate(values):
            self.feed(node, f"_{k}", value)
        return node.outputs[0]

    def mix(self, factor, first, second, blend: str = "MIX"):
        """A colour mix; `factor` and the colours are values or sockets."""
        node = self.add("Mix", {"data_type": "RGBA", "blend_type": blend})
        self.feed(node, "_0", factor)
        self.feed(node, "_6", first)
        self.feed(node, "_7", second)
        return node.outputs[2]

    def smooth(self, value, low: float, high: float):
        """0 below `low`, 1 above `high`, smooth between (either order)."""
        node = self.add("MapRange", {"interpolation_type": "SMOOTHSTEP"})
        first, last = (low, high) if low < high else (high, low)
        for key, v in zip(("_0", "_1", "_2"), (value, first, last), strict=True):
            self.feed(node, key, v)
        self.feed(node, "_3", 0.0 if low < high else 1.0)
        self.feed(node, "_4", 1.0 if low < high else 0.0)
        return node.outputs[0]

    def noise(self, vector, scale: float, detail: float = 2.0):
        return self.add("TexNoise", Vector=vector, Scale=scale, Detail=detail).outputs[0]

    def bump(self, height, strength: float, distance: float):
        node = self.add("Bump", Height=height, Strength=strength, Distance=distance)
        return node.outputs[0]

    def surface(self, shader) -> None:
        out = self.add("OutputMaterial")
        self.tree.links.new(shader.outputs[0], out.inputs[0])

    def principled(self, **sockets):
        node = self.add("BsdfPrincipled", **sockets)
        self.surface(node)
        return node


def new_material(name: str) -> tuple[bpy.types.Material, Graph]:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    return material, Graph(material.node_tree)
