"""The heads of a scene put together by depth with the rest of it, which Cycles or EEVEE renders.

Two scenes: the user's keeps everything and renders what is not a head (the heads' meshes only cast
their shadows there); a second one, which this module owns, renders the heads. A node group in the
user's compositor lays the nearer of the two over the farther, pixel by pixel.
"""

from __future__ import annotations

from typing import Any

import bpy

from ..core.errors import InputError
from ..core.rendering.frames import EMPTY_DEPTH
from .avatars import heads_of
from .scene import ENGINE

HEADS, JOIN = "PAV Heads", "PAV Join by Depth"
NODE_HEADS, NODE_JOIN = "pav heads", "pav join"
_VERSION_5 = bpy.app.version >= (5, 0, 0)


def composite(scene: Any, engine: str) -> Any:
    """Sets up `scene` so that its render shows the heads among its other objects; returns the
    scene that renders them. Doing it again brings an existing set-up up to date.

    engine: renders the rest where the scene's own is PAV. InputError where it cannot work.
    """
    if scene.pav.frames.shown_in is not None:
        raise InputError(
            f"scene {scene.name!r} renders the heads of {scene.pav.frames.shown_in.name!r}; "
            "switch to that one"
        )
    heads = heads_of(scene.objects)
    if not heads:
        raise InputError(f"scene {scene.name!r} has no head with an avatar")
    for head in heads:
        if head.library is not None:
            raise InputError(
                f"object {head.name!r} is linked from {head.library.filepath}: make a library "
                "override of it first (its camera visibility is switched off)"
            )
    if scene.camera is None:
        raise InputError(f"scene {scene.name!r} has no camera; add one or import a track")
    tree = _tree(scene)
    layers, target = _ends(tree, scene)
    if scene.render.engine == ENGINE:
        scene.render.engine = engine
    scene.view_layers[layers.layer].use_pass_z = True  # before the node is asked for its Depth
    inner = _head_scene(scene, heads)
    _join(tree, scene, inner, layers, target)
    scene.render.use_compositing = True
    for head in heads:
        head.visible_camera = False  # its shadow stays in the scene
    return inner


def separate(scene: Any) -> None:
    """Undoes `composite`: the compositor shows what it did before. InputError where there is
    nothing to undo."""
    inner, tree = head_scene(scene), _tree_of(scene)
    nodes = tree.nodes if tree is not None else {}
    join, heads = nodes.get(NODE_JOIN), nodes.get(NODE_HEADS)
    if inner is None and join is None:
        raise InputError(f"scene {scene.name!r} is not composited with its heads")
    if tree is not None and join is not None:
        before = [link.from_socket for link in join.inputs["Scene"].links]
        after = [link.to_socket for link in join.outputs["Image"].links]
        for socket in after if before else ():
            tree.links.new(before[0], socket)
        tree.nodes.remove(join)
    if tree is not None and heads is not None:
        tree.nodes.remove(heads)
    for head in heads_of(scene.objects):
        head.visible_camera = True
    if inner is not None:
        bpy.data.scenes.remove(inner)


def head_scene(scene: Any) -> Any | None:
    """The scene that renders the heads of `scene`; None where it was not set up."""
    return next((other for other in bpy.data.scenes if other.pav.frames.shown_in == scene), None)


def _head_scene(scene: Any, heads: list[Any]) -> Any:
    """Made, or brought up to date. Size, border, pixel aspect and quality it takes from `scene`
    when it renders (`shot.shown_in`)."""
    inner = head_scene(scene)
    if inner is None:
        inner = bpy.data.scenes.new(f"{scene.name} heads")
        inner.pav.frames.shown_in = scene
    wanted, there = [*heads, scene.camera], list(inner.collection.objects)
    for thing in there:
        if thing not in wanted:
            inner.collection.objects.unlink(thing)
    for thing in wanted:
        if thing not in there:
            inner.collection.objects.link(thing)
    inner.camera = scene.camera
    inner.frame_start, inner.frame_end = scene.frame_start, scene.frame_end
    inner.render.fps, inner.render.fps_base = scene.render.fps, scene.render.fps_base
    inner.render.engine = ENGINE
    inner.render.film_transparent = True
    inner.view_layers[0].use_pass_z = True
    return inner


def _tree_of(scene: Any) -> Any | None:
    """The compositor's nodes of a scene, if it uses any."""
    if _VERSION_5:
        return scene.compositing_node_group
    return scene.node_tree if scene.use_nodes else None


def _tree(scene: Any) -> Any:
    """The same, made where there is none."""
    tree = _tree_of(scene)
    if tree is not None:
        return tree
    if _VERSION_5:
        tree = bpy.data.node_groups.new(f"{scene.name} compositing", "CompositorNodeTree")
        scene.compositing_node_group = tree
        return tree
    scene.use_nodes = True
    return scene.node_tree


def _ends(tree: Any, scene: Any) -> tuple[Any, Any]:
    """The node with the scene's own layers, and the socket that takes the finished picture; both
    made where they lack."""
    layers = next(
        (
            node
            for node in tree.nodes
            if node.bl_idname == "CompositorNodeRLayers" and node.scene == scene
        ),
        None,
    )
    if layers is None:
        layers = tree.nodes.new("CompositorNodeRLayers")
        layers.scene, layers.location = scene, (-600, 200)
    output = "NodeGroupOutput" if _VERSION_5 else "CompositorNodeComposite"
    ends = [node for node in tree.nodes if node.bl_idname == output]
    end = next((node for node in ends if getattr(node, "is_active_output", True)), None)
    if end is None:
        end = tree.nodes.new(output)
        end.location = 400, 200
    if _VERSION_5 and not any(socket.type == "RGBA" for socket in end.inputs):
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    target = next(socket for socket in end.inputs if socket.type == "RGBA")
    if not target.is_linked:
        tree.links.new(layers.outputs["Image"], target)
    return layers, target


def _join(tree: Any, scene: Any, inner: Any, layers: Any, target: Any) -> None:
    """Puts the two nodes of ours between the finished picture and where it went."""
    heads = tree.nodes.get(NODE_HEADS) or tree.nodes.new("CompositorNodeRLayers")
    heads.name, heads.label = NODE_HEADS, "Heads"
    heads.scene, heads.layer = inner, inner.view_layers[0].name
    join = tree.nodes.get(NODE_JOIN)
    if join is None:
        join = tree.nodes.new("CompositorNodeGroup")
        join.name, join.label = NODE_JOIN, "Join by Depth"
        place = target.node.location
        join.location, heads.location = (place[0] - 200, place[1]), (place[0] - 500, place[1] - 400)
    join.node_tree = bpy.data.node_groups.get(JOIN) or _make_join()
    if target.links[0].from_node != join:
        tree.links.new(target.links[0].from_socket, join.inputs["Scene"])
        tree.links.new(join.outputs["Image"], target)
    tree.links.new(layers.outputs["Depth"], join.inputs["Scene Depth"])
    tree.links.new(heads.outputs["Image"], join.inputs["Heads"])
    tree.links.new(heads.outputs["Depth"], join.inputs["Heads Depth"])


def _make_join() -> Any:
    """heads over scene where they are nearer, else scene over heads: premultiplied, both exact.

    Blender's own Z Combine takes the nearer picture's colour for a straight one, which darkens the
    soft edges of hair. Where an object stands before a head, its outline is smoothed; a head's own
    is soft already and stays as it is.
    """
    tree = bpy.data.node_groups.new(JOIN, "CompositorNodeTree")
    for name, kind in (
        ("Scene", "NodeSocketColor"),
        ("Scene Depth", "NodeSocketFloat"),
        ("Heads", "NodeSocketColor"),
        ("Heads Depth", "NodeSocketFloat"),
    ):
        tree.interface.new_socket(name, in_out="INPUT", socket_type=kind)
    tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    given, end = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    scene, scene_depth, heads, heads_depth = list(given.outputs)[:4]
    nearer = _math(tree, "LESS_THAN", heads_depth, scene_depth)
    empty = _math(tree, "GREATER_THAN", heads_depth, 0.1 * EMPTY_DEPTH)
    # smoothed twice, so that a head's outline is an edge in neither where it is looked at: before
    # a head (nearer 0) what is empty counts as behind too, and behind one as before
    before = _smooth(tree, nearer)
    behind = _smooth(tree, _math(tree, "MAXIMUM", nearer, empty))
    share = _math(tree, "MULTIPLY_ADD", nearer, _math(tree, "SUBTRACT", behind, before), before)
    picture = _mix(tree, share, _over(tree, heads, scene), _over(tree, scene, heads))
    tree.links.new(picture, end.inputs["Image"])
    for column, node in enumerate(tree.nodes):
        node.location = 200 * column, 0
    return tree


def _math(tree: Any, operation: str, *operands: Any) -> Any:
    """A node of arithmetic on sockets and numbers; its output."""
    node = tree.nodes.new("ShaderNodeMath" if _VERSION_5 else "CompositorNodeMath")
    node.operation = operation
    for socket, operand in zip(node.inputs, operands, strict=False):
        if isinstance(operand, float):
            socket.default_value = operand
        else:
            tree.links.new(operand, socket)
    return node.outputs[0]


def _smooth(tree: Any, mask: Any) -> Any:
    node = tree.nodes.new("CompositorNodeAntiAliasing")
    tree.links.new(mask, node.inputs[0])
    return node.outputs[0]


def _over(tree: Any, below: Any, above: Any) -> Any:
    """Premultiplied `above` laid over `below`; the socket with both."""
    node = tree.nodes.new("CompositorNodeAlphaOver")
    colours = [socket for socket in node.inputs if socket.type == "RGBA"]
    tree.links.new(below, colours[0])
    tree.links.new(above, colours[1])
    return node.outputs[0]


def _mix(tree: Any, factor: Any, zero: Any, one: Any) -> Any:
    """`zero` where the factor is 0, `one` where it is 1, alpha included."""
    if _VERSION_5:
        node = tree.nodes.new("ShaderNodeMix")
        node.data_type = "RGBA"
    else:
        node = tree.nodes.new("CompositorNodeMixRGB")
    enabled = [socket for socket in node.inputs if socket.enabled]
    colours = [socket for socket in enabled if socket.type == "RGBA"]
    tree.links.new(factor, next(socket for socket in enabled if socket.type == "VALUE"))
    tree.links.new(zero, colours[0])
    tree.links.new(one, colours[1])
    return next(socket for socket in node.outputs if socket.enabled)
