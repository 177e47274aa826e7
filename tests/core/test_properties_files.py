"""What is written is read: collections, avatars, head files and recordings, whatever they hold."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from fuzzing import MORE
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from test_head_pose import SMALL
from test_livelink import COLUMNS, HEADER, row, write

from pav_blender.core.collection import Clip, CollectionWriter, read_collection
from pav_blender.core.collection.model import SPLITS
from pav_blender.core.config import APPEARANCE_MODES, FRAME_MODES, Config
from pav_blender.core.errors import InputError
from pav_blender.core.field.avatar import Avatar, read_header
from pav_blender.core.files import check_folder_name
from pav_blender.core.head import read_head, write_head
from pav_blender.core.head.livelink import ARKIT_NAMES, pose_of, read_take, resample
from pav_blender.core.images import read_gray, read_rgba

FEW = settings(max_examples=20 * MORE, deadline=None, derandomize=True)

seeds = st.integers(0, 2**32 - 1)
names = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", fullmatch=True)
# whatever a person may type: any script, blanks, quotes
texts = st.text(st.characters(exclude_categories=("Cc", "Cs")), max_size=20)


# the same, but pictures are written into a folder of that name
def names_a_folder(name):
    try:
        return check_folder_name(name, "") == name
    except InputError:
        return False


looks = (
    st.text(st.characters(categories=("L", "N"), include_characters=" _-.'()"), max_size=20)
    .map(lambda name: name.strip(" ."))
    .filter(names_a_folder)
)
records = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=8,
)
headers = st.dictionaries(texts, records, max_size=3)


def numbers(random, *shape):
    """float32 of every size, zeros of both signs and the smallest there are among them."""
    values = random.normal(size=shape) * 10.0 ** random.integers(-30, 6, shape)
    values[random.random(shape) < 0.1] = -0.0
    values[random.random(shape) < 0.05] = 1e-45
    return values.astype(np.float32)


def exact(found, wanted):
    assert found.dtype == wanted.dtype
    assert found.shape == wanted.shape
    assert found.tobytes() == np.ascontiguousarray(wanted).tobytes()


def make_clip(random, head, name, appearance, optional):
    frames = int(random.integers(1, 5))
    joints, vertices = len(head.joint_names), len(head.template)
    return Clip(
        name=name,
        appearance=appearance,
        width=int(random.integers(1, 16385)),
        height=int(random.integers(1, 16385)),
        expression=numbers(random, frames, len(head.expression_names)),
        pose=numbers(random, frames, joints, 3),
        translation=numbers(random, frames, 3),
        intrinsics=numbers(random, frames, 3, 3),
        camera_to_world=numbers(random, frames, 4, 4),
        frame_id=random.choice(10**6, frames, replace=False).astype(np.int32),
        split=random.choice(SPLITS, frames),
        vertices=numbers(random, frames, vertices, 3) if optional else None,
        landmarks=(
            numbers(random, frames, len(head.landmark_triangles), 2) if optional else None
        ),
    )  # fmt: skip


@FEW
@given(
    st.lists(st.tuples(names, looks, st.booleans()), min_size=1, max_size=3,
             unique_by=lambda clip: clip[0].casefold()),
    headers, seeds, st.booleans(), st.integers(0, 3),
)  # fmt: skip
def test_a_collection_is_read_as_it_was_written(clips, extra, seed, own_offset, betas):
    random = np.random.default_rng(seed)
    made = [make_clip(random, SMALL, *clip) for clip in clips]
    identity = numbers(random, betas)
    offset = numbers(random, 12, 3) if own_offset else None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        write_head(path / "head.npz", SMALL)
        head = str(path / "head.npz")
        with CollectionWriter(path / "c", head, identity, offset=offset, extra=extra) as writer:
            for clip in made:
                writer.clip(clip)
        read = read_collection(path / "c")
        assert sorted(found.name for found in path.iterdir()) == ["c", "head.npz"]
    exact(read.betas, identity)
    assert read.extra == extra
    assert read.head.fingerprint == SMALL.fingerprint
    if offset is None:
        assert read.head_offset is None
    else:
        exact(read.head_offset, offset)
        exact(read.head.template, SMALL.template + offset)
    assert [clip.name for clip in read.clips] == [clip.name for clip in made]
    for found, wanted in zip(read.clips, made, strict=True):
        for field in dataclasses.fields(Clip):
            one, other = getattr(found, field.name), getattr(wanted, field.name)
            if not isinstance(other, np.ndarray):
                assert one == other
            elif field.name == "split":
                assert one.tolist() == other.tolist()
            else:
                exact(one, other)


@FEW
@given(seeds, st.integers(1, 20), st.integers(1, 20), st.integers(0, 10**6))
def test_pictures_of_a_collection_are_read_as_they_were_written(seed, width, height, number):
    """Colour where there is any alpha, labels, and depth to a twentieth of a millimetre."""
    random = np.random.default_rng(seed)
    rgba = random.integers(0, 256, (height, width, 4), np.uint8)
    rgba[random.random((height, width)) < 0.3, 3] = 0
    labels = random.integers(0, 11, (height, width), np.uint8)
    depth = random.uniform(1e-4, 6.5, (height, width))
    depth[random.random((height, width)) < 0.2] = np.inf
    with tempfile.TemporaryDirectory() as folder:
        with CollectionWriter(Path(folder) / "c", "builtin", np.zeros(1)) as writer:
            writer.image("a", number, rgba)
            writer.labels("a", number, labels)
            writer.depth("a", number, depth)
            writer.clip(make_clip(random, SMALL, "a", "x", False))
        clip = Path(folder) / "c/clips/a"
        file = f"{number:06d}.png"
        found = read_rgba(clip / "images" / file)
        exact(read_gray(clip / "labels" / file), labels)
        tenths = read_gray(clip / "depth" / file)
    visible = rgba[..., 3] > 0
    exact(found[visible], rgba[visible])
    assert not found[~visible].any()
    np.testing.assert_array_equal(tenths == 0, ~np.isfinite(depth))
    there = np.isfinite(depth)
    np.testing.assert_allclose(tenths[there] * 1e-4, depth[there], atol=0.5001e-4)


@st.composite
def configs(draw):
    """Small fields of every kind."""
    return Config(
        levels=draw(st.integers(1, 3)),
        log2_entries=draw(st.integers(3, 6)),
        base_resolution=2,
        finest_resolution=draw(st.integers(2, 9)),
        shoulder_levels=draw(st.integers(0, 2)),
        appearance=draw(st.sampled_from(APPEARANCE_MODES)),
        latent_channels=draw(st.integers(1, 4)),
        latent_size=draw(st.integers(1, 5)),
        appearance_code=draw(st.booleans()),
        global_channels=3,
        hidden=draw(st.integers(1, 8)),
        geometry_channels=draw(st.integers(1, 4)),
        density_layers=draw(st.integers(1, 2)),
        density_offset=draw(st.booleans()),
        sees_turn=draw(st.booleans()),
        sees_expression=draw(st.booleans()),
        offset_sees_geometry=draw(st.booleans()),
        frames=draw(st.sampled_from(FRAME_MODES)),
        occupancy_resolution=draw(st.integers(1, 7)),
        reach=draw(st.floats(1e-3, 1)),
        step=draw(st.floats(1e-5, 1e-2)),
        seed=draw(st.integers(0, 2**31 - 1)),
    )


@st.composite
def avatars(draw):
    """An avatar of one person or of two, its weights anything."""
    config, random = draw(configs()), np.random.default_rng(draw(seeds))
    names = draw(st.lists(looks, min_size=2, max_size=3, unique=True))
    several = draw(st.booleans())
    people = {"one": names[:1], "other": names[1:]} if several else {}
    rows = (2,) if several else ()
    triangles = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    cells = (len(names), *(config.occupancy_resolution,) * 3)
    avatar = Avatar.create(
        config, names, random.normal(size=(4, 3)), triangles, random.random((4, 2)),
        triangles[:, ::-1],
        tuple(draw(st.lists(texts, max_size=3, unique=True))),
        rigid_weights=random.random(4).astype(np.float32),
        occupied=random.random(cells) < 0.5,
        head_name=draw(texts), head_fingerprint=draw(texts),
        betas=numbers(random, *rows, draw(st.integers(0, 3))),
        head_offset=numbers(random, *rows, 4, 3) if draw(st.booleans()) else None,
        record=draw(headers), identities=people,
    )  # fmt: skip
    size = 10.0 ** draw(st.integers(-9, 2))
    generator = torch.Generator().manual_seed(draw(seeds))
    with torch.no_grad():
        for values in avatar.field.parameters():
            values.copy_(torch.randn(values.shape, generator=generator) * size)
    return avatar


def saved(avatar, *, half=False):
    """The avatar as it is read, and how large its file is."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.pav"
        avatar.save(path, half=half)
        assert [file.name for file in path.parent.iterdir()] == ["a.pav"]
        assert read_header(path)["appearances"] == avatar.appearances
        return Avatar.load(path), path.stat().st_size


@FEW
@given(avatars())
def test_an_avatar_is_read_as_it_was_written(made):
    read, _ = saved(made)
    state = read.field.state_dict()
    assert state.keys() == made.field.state_dict().keys()
    for name, values in made.field.state_dict().items():
        exact(state[name].numpy(), values.numpy())
    for field in dataclasses.fields(Avatar):
        one, other = getattr(read, field.name), getattr(made, field.name)
        if isinstance(other, np.ndarray):
            exact(one, other)
        elif field.name != "field":
            assert one == other
    again, _ = saved(read)
    assert again.record == made.record


@FEW
@given(avatars(), st.sampled_from([1.0, 65504.0, 65519.0, 1e6]))
def test_half_an_avatar_is_within_halfs_rounding(made, largest):
    """And where a table's value is beyond the largest of half it is kept whole. All else is exact;
    written in half again it changes no more."""
    with torch.no_grad():
        made.field.tables[0, 0] = largest
        for values in made.field.parameters():
            values.mul_(1 if values is made.field.tables else 1e-3)
    read, small = saved(made, half=True)
    assert small <= saved(made)[1]
    wanted = made.field.state_dict()
    for name, values in read.field.state_dict().items():
        assert values.dtype == torch.float32
        if wanted[name].numel() and wanted[name].abs().max() > 65504:
            exact(values.numpy(), wanted[name].numpy())
            continue
        error = (values.double() - wanted[name].double()).abs()
        assert (error <= (2.0**-11 * wanted[name].double().abs()).clamp(min=2.0**-25)).all()
    exact(read.canonical_vertices, made.canonical_vertices)
    exact(read.betas, made.betas)
    exact(read.occupied, made.occupied)
    again, _ = saved(read, half=True)
    for name, values in again.field.state_dict().items():
        exact(values.numpy(), read.field.state_dict()[name].numpy())


@st.composite
def heads(draw):
    """The small head with numbers, names and regions of its own."""
    random = np.random.default_rng(draw(seeds))
    count = draw(st.integers(0, 4))
    regions = draw(st.lists(texts, max_size=3, unique=True))
    landmarks = slice(0, 2 * draw(st.booleans()))
    return dataclasses.replace(
        SMALL,
        name=draw(texts),
        origin=draw(texts),
        template=numbers(random, 12, 3),
        shape_basis=random.normal(0, 0.01, (draw(st.integers(0, 3)), 12, 3)),
        expression_basis=random.normal(0, 0.01, (count, 12, 3)),
        expression_names=draw(st.lists(texts, min_size=count, max_size=count, unique=True)),
        pose_basis=SMALL.pose_basis[: draw(st.sampled_from([0, 36]))],
        joint_names=draw(st.lists(texts, min_size=5, max_size=5)),
        regions={name: random.random(12) < 0.5 for name in regions},
        landmark_triangles=SMALL.landmark_triangles[landmarks],
        landmark_barycentrics=SMALL.landmark_barycentrics[landmarks],
        joints_follow_expression=draw(st.booleans()),
    )


def kept(head, step=None):
    """The head as it is read."""
    with tempfile.TemporaryDirectory() as folder:
        write_head(Path(folder) / "head.npz", head, step=step)
        assert [file.name for file in Path(folder).iterdir()] == ["head.npz"]
        return read_head(Path(folder) / "head.npz")


@FEW
@given(heads())
def test_a_head_is_read_as_it_was_written(head):
    read = kept(head)
    assert read.fingerprint == head.fingerprint
    assert read.regions.keys() == head.regions.keys()
    for name, mask in head.regions.items():
        exact(read.regions[name], mask)
    for field in dataclasses.fields(head):
        one, other = getattr(read, field.name), getattr(head, field.name)
        if isinstance(other, np.ndarray):
            exact(one, other)
        elif field.name != "regions":
            assert one == other


@FEW
@given(heads(), st.floats(2e-6, 1e-3))
def test_a_rounded_head_is_within_half_a_step_and_stays_so(head, step):
    once = kept(head, step)
    for name in ("shape_basis", "expression_basis", "pose_basis"):
        error = np.abs(getattr(once, name) - getattr(head, name))
        assert error.size == 0 or error.max() <= 0.51 * step
    exact(once.template, head.template)
    assert kept(once, step).fingerprint == once.fingerprint


@FEW
@given(
    st.lists(st.integers(1, 300), max_size=20),
    st.lists(st.floats(-1.5, 1.5), min_size=9, max_size=9),
    seeds,
    st.booleans(),
)
def test_a_recording_is_read_as_it_was_written(gaps, angles, seed, dropped):
    """Row for row, the columns in any order; a frame without a face is no row."""
    random = np.random.default_rng(seed)
    ticks = np.concatenate([[0], np.cumsum(gaps)]).astype(int)
    values = random.uniform(-1, 1, (len(ticks), len(COLUMNS))).round(6)
    values[:, 52:] = angles
    order = random.permutation(len(COLUMNS))
    header = ",".join(["Timecode", "BlendShapeCount", *(COLUMNS[i] for i in order)])
    assert len(header) == len(HEADER)

    def timecode(tick):
        return f"{tick // 216000:02d}:{tick // 3600 % 60:02d}:{tick // 60 % 60:02d}:{tick % 60:02d}"

    lines = [row(timecode(t), v[order]) for t, v in zip(ticks, values, strict=True)]
    if dropped:
        lines.append(f"{timecode(ticks[-1] + 1)},0")
    with tempfile.TemporaryDirectory() as folder:
        take = read_take(write(Path(folder) / "take.csv", *lines, header=header), 60)
    np.testing.assert_allclose(take.seconds, ticks / 60, atol=1e-9)
    shapes = np.stack([take.shapes[name] for name in ARKIT_NAMES], 1)
    np.testing.assert_allclose(shapes, values[:, :52], atol=1e-9)
    found = np.stack([take.angles[part] for part in ("Head", "LeftEye", "RightEye")], 1)
    np.testing.assert_allclose(found.reshape(-1, 9), values[:, 52:], atol=1e-9)
    pose = pose_of(take, ("smile",), SMALL.joint_names)
    for joint, part in (("neck", "Head"), ("left_eye", "RightEye"), ("right_eye", "LeftEye")):
        turn = Rotation.from_rotvec(pose[:, SMALL.joint_names.index(joint)])
        back = turn.as_euler("YXZ") * (-1, 1, -1)
        np.testing.assert_allclose(back, take.angles[part], atol=1e-7)
    # at the frames' own times it is what it was; twice the same rate changes no more
    even = resample(take, 60)
    np.testing.assert_allclose(even.shapes["jawOpen"][ticks], take.shapes["jawOpen"], atol=1e-9)
    again = resample(even, 60)
    np.testing.assert_allclose(again.shapes["jawOpen"], even.shapes["jawOpen"], atol=1e-12)


# what an array of a file may hold by accident or malice: (its values) -> others
DAMAGE = {
    "no rows": lambda a: a[:0],
    "a row less": lambda a: a[:-1],
    "a column less": lambda a: a[..., :-1],
    "one axis more": lambda a: a[None],
    "a number": lambda a: np.array(3),
    "text": lambda a: np.full(a.shape, "x"),
    "bytes": lambda a: np.full(a.shape, b"x"),
    "complex": lambda a: np.zeros(a.shape, np.complex64),
    "dates": lambda a: np.zeros(a.shape, "M8[s]"),
    "not a number": lambda a: np.full(a.shape, np.nan),
    "too large for single precision": lambda a: np.full(a.shape, 1e300),
    "too large for an index": lambda a: np.arange(a.size).reshape(a.shape) + 2**40,
    "below nothing": lambda a: np.full(a.shape, -1, np.int64),
    "halves": lambda a: np.arange(a.size).reshape(a.shape) + 0.5,
}


def damaged(path, data, shaped):
    """One array of an npz replaced by another: its name, its kind of damage."""
    with np.load(path) as stored:
        content = {key: stored[key] for key in stored.files}
    key = data.draw(st.sampled_from(sorted(k for k, v in content.items() if shaped(v))))
    how = data.draw(st.sampled_from(sorted(DAMAGE)))
    np.savez(path, **(content | {key: DAMAGE[how](content[key])}))
    return key, how


@settings(FEW, max_examples=60 * MORE)
@given(st.data(), seeds)
def test_damaged_frames_are_an_input_error_or_numbers(data, seed):
    clip = make_clip(np.random.default_rng(seed), SMALL, "a", "a", True)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        write_head(path / "head.npz", SMALL)
        with CollectionWriter(path / "c", str(path / "head.npz"), np.zeros(2)) as writer:
            writer.clip(clip)
        damaged(path / "c/clips/a/frames.npz", data, lambda values: True)
        try:
            read = read_collection(path / "c").clips[0]
        except InputError as error:
            assert "frames.npz" in str(error)  # noqa: PT017
            assert "\n" not in str(error)  # noqa: PT017
            return
    assert len(read) > 0
    for field in dataclasses.fields(Clip):
        values = getattr(read, field.name)
        if isinstance(values, np.ndarray) and field.name not in ("frame_id", "split"):
            assert values.dtype == np.float32
            assert np.isfinite(values).all()
    assert read.frame_id.dtype == np.int32
    assert len(np.unique(read.frame_id)) == len(read)


@settings(FEW, max_examples=60 * MORE)
@given(st.data())
def test_damaged_heads_are_an_input_error_or_heads(data):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "head.npz"
        write_head(path, SMALL, step=data.draw(st.sampled_from([None, 2e-6])))
        damaged(path, data, lambda values: values.ndim > 0)
        try:
            head = read_head(path)
        except InputError as error:
            assert "head.npz" in str(error)  # noqa: PT017
            assert "\n" not in str(error)  # noqa: PT017
            return
    still = np.zeros((1, len(head.joint_names), 3)), np.zeros((1, 3))
    assert torch.isfinite(head.pose([], np.zeros((1, 0)), *still)).all()
    assert head.triangles.max() < head.vertex_count
    assert head.regions["face"].dtype == bool


@settings(FEW, max_examples=60 * MORE)
@given(st.data(), avatars())
def test_damaged_avatars_are_an_input_error_or_avatars(data, made):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.pav"
        made.save(path)
        with safetensors.safe_open(path, "pt") as stored:
            header = stored.metadata()
            tensors = {key: stored.get_tensor(key) for key in stored.keys()}  # noqa: SIM118
        kinds = set(DAMAGE) - {"text", "bytes", "complex", "dates"}
        key = data.draw(st.sampled_from(sorted(k for k, v in tensors.items() if v.numel())))
        values = DAMAGE[data.draw(st.sampled_from(sorted(kinds)))](tensors[key].numpy())
        tensors[key] = torch.from_numpy(np.ascontiguousarray(values))
        safetensors.torch.save_file(tensors, path, header)
        try:
            read = Avatar.load(path)
        except InputError as error:
            assert "a.pav" in str(error)  # noqa: PT017
            assert "\n" not in str(error)  # noqa: PT017
            return
    for field in ("canonical_vertices", "uvs", "rigid_weights", "box_min", "betas"):
        values = getattr(read, field)
        assert values.dtype == np.float32
        assert np.isfinite(values).all()
    assert read.box_min.shape == (3,)
    assert read.uvs[read.uv_triangles].shape == (*read.triangles.shape, 2)
    assert read.canonical_vertices[read.triangles].shape == (*read.triangles.shape, 3)
