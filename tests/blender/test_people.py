"""An avatar of two people in Blender: each head is one of them, and wears that one's looks."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("bpy")

import bpy
import small

from pav_blender.bridge import avatars, mesh, sequence
from pav_blender.bridge import scene as bridge_scene
from pav_blender.bridge.animation import render_blend
from pav_blender.bridge.looks import other_appearances
from pav_blender.bridge.properties import appearance_items
from pav_blender.bridge.render import Posed
from pav_blender.bridge.shot import find_actors
from pav_blender.bridge.thumbnails import draw
from pav_blender.core.collection import CollectionWriter, read_collection
from pav_blender.core.errors import InputError, OtherPerson, PavError
from pav_blender.core.field.avatar import Avatar, head_of

ANNA, BEN = ["anna/morning", "anna/evening"], ["ben/morning", "ben/evening"]


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """small.pav, of two people."""
    path = small.write_avatar(tmp_path_factory.mktemp("two") / "two.pav", appearances=ANNA + BEN)
    one = Avatar.load(path)
    other = np.zeros_like(one.betas)
    other[:6] = 3, -2.5, 2, -3, 2.5, 3
    several = Avatar.create(
        one.config,
        one.appearances,
        one.canonical_vertices,
        one.triangles,
        one.uvs,
        one.uv_triangles,
        one.expression_names,
        head_name=one.head_name,
        head_fingerprint=one.head_fingerprint,
        betas=np.stack([one.betas, other]),
        identities={"anna": ANNA, "ben": BEN},
    )
    state = one.field.state_dict()
    for name in ("density.group_weight", "offset.group_weight"):  # turned by whose head it is
        state[name] = several.field.state_dict()[name].normal_(0, 0.5)
    several.field.load_state_dict(state)
    several.save(path)
    return path


def wears(head):
    return [item[0] for item in appearance_items(head.pav, bpy.context)]


def test_a_head_is_that_of_its_appearances_person(scene, two):
    avatar = Avatar.load(two)
    for name, looks, row in (("anna/evening", ANNA, 0), (None, ANNA, 0), ("ben/evening", BEN, 1)):
        made = bridge_scene.build_head(two, name).mesh
        expected = head_of(avatar, looks[0]).shaped(avatar.betas[row])
        assert np.abs(mesh.vertices(made.data) - expected).max() < 1e-6
        assert made.pav.identity == looks[0].split("/")[0]
        assert made.pav.appearance == (name or looks[0])
        assert wears(made) == looks
        assert set(other_appearances(made)) == set(looks) - {made.pav.appearance}
        with pytest.raises(TypeError):
            made.pav.appearance = (set(ANNA + BEN) - set(looks)).pop()
    with pytest.raises(InputError, match="unknown appearance 'ben'"):
        bridge_scene.build_head(two, "ben")


def test_an_avatar_of_one_person_has_no_identity(scene, files):
    made = bridge_scene.build_head(files / "small.pav").mesh
    assert made.pav.identity == ""
    assert wears(made) == small.APPEARANCES


def test_the_operator_adds_the_head_that_is_asked_for(scene, two):
    assert bpy.ops.pav.add_head(filepath=str(two), appearance="ben/evening") == {"FINISHED"}
    assert bpy.context.active_object.pav.identity == "ben"
    with pytest.raises(RuntimeError, match="unknown appearance"):
        bpy.ops.pav.add_head(filepath=str(two), appearance="cy/evening")


def test_nobody_wears_what_is_anothers(scene, two):
    """Also where the file says so: as one that was made for other names."""
    made = bridge_scene.build_head(two, "ben/morning").mesh
    actor = find_actors(bpy.context.evaluated_depsgraph_get())[0]
    assert actor.looks == BEN
    posed = Posed()
    assert posed.scene(actor).condition[-2:].tolist() == [0, 1]
    made.pav.identity = "anna"  # its appearance is no item of the menu any more
    with pytest.raises(InputError, match="has anna/morning, anna/evening"):
        find_actors(bpy.context.evaluated_depsgraph_get())
    object.__setattr__(actor, "identity", "anna")
    with pytest.raises(InputError, match="head of 'anna' and can't wear 'ben/morning'"):
        posed.scene(actor)


def test_all_appearances_are_those_of_the_person(scene, two):
    bridge_scene.build_head(two, "ben/morning")
    assert list(sequence.every_appearance(scene)) == BEN
    bridge_scene.build_head(two, "anna/morning")
    with pytest.raises(InputError, match="no appearance in common"):
        sequence.every_appearance(scene)


def test_a_track_is_checked_against_whose_head_it_moves(scene, two, files, tmp_path):
    of_anna = read_collection(files / "collection")
    with pytest.raises(OtherPerson, match="off ben's"):
        bridge_scene.build_scene(two, of_anna, "walk", appearance="ben/morning")
    assert not scene.objects
    made = bridge_scene.build_scene(two, of_anna, "walk", appearance="anna/morning").mesh
    bridge_scene.check_person(made, of_anna)
    ben = bridge_scene.build_head(two, "ben/morning").mesh
    with pytest.raises(OtherPerson, match="off ben's"):
        bridge_scene.check_person(ben, of_anna)
    clip, head = of_anna.clip("walk"), of_anna.head
    with CollectionWriter(tmp_path / "ben", "builtin", Avatar.load(two).betas[1]) as writer:
        for number in clip.frame_id:
            writer.image("walk", int(number), np.zeros((small.HEIGHT, small.WIDTH, 4), np.uint8))
        writer.clip(clip)
    bridge_scene.check_person(ben, read_collection(tmp_path / "ben"))
    assert head.fingerprint == read_collection(tmp_path / "ben").head.fingerprint


def test_a_scene_file_renders_the_looks_of_its_head(scene, two, files, tmp_path):
    collection = read_collection(files / "collection")
    bridge_scene.build_scene(two, collection, "walk", appearance="anna/evening")
    scene.frame_end, scene.pav.quality = scene.frame_start, "PREVIEW"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    out = str(tmp_path / "{appearance}" / "####.png")
    written = render_blend(tmp_path / "a.blend", "all", out)
    assert written == [tmp_path / name / "0003.png" for name in ANNA]
    with pytest.raises(PavError, match="ben/evening"):
        render_blend(tmp_path / "a.blend", "ben/evening", out)


def test_thumbnails_are_of_each_persons_own_head(scene, two):
    heads = [draw(two, name)[..., 3] > 0.5 for name in (ANNA[0], BEN[0])]
    assert all(shown.any() for shown in heads)
    assert (heads[0] != heads[1]).sum() > 20


def test_a_header_that_is_not_right_is_no_menu(scene, two, tmp_path):
    assert avatars.looks(two, "") == avatars.looks(two, "nobody") == ANNA + BEN
    raw = two.read_bytes()
    wrong = raw.replace(json.dumps("anna").encode()[1:-1] + b'\\": [', b'ann4\\": {', 1)
    assert wrong != raw
    (tmp_path / "b.pav").write_bytes(wrong)
    with pytest.raises(InputError, match=r"b\.pav"):
        avatars.looks(tmp_path / "b.pav", "anna")
