import dataclasses
import json
import struct

import numpy as np
import pytest
import torch

from pav_blender.core.config import APPEARANCE_MODES, Config
from pav_blender.core.errors import InputError
from pav_blender.core.field.avatar import Avatar, read_header
from pav_blender.core.field.directions import spherical_harmonics
from pav_blender.core.field.field import Field, Samples, condition
from pav_blender.core.field.limits import overflowing

TINY = Config(
    levels=4,
    log2_entries=10,
    finest_resolution=64,
    latent_size=8,
    occupancy_resolution=8,
    sees_expression=True,
)


def make_field(config=TINY, appearances=3):
    torch.manual_seed(0)
    triangles = torch.tensor([[0, 1, 2], [1, 2, 3]], dtype=torch.int32)
    corner_uvs = torch.rand(2, 3, 2)
    field = Field(config, appearances, 5, triangles, corner_uvs, 4)
    for parameter in field.parameters():  # away from the zeros of a fresh field
        torch.nn.init.normal_(parameter, 0, 0.3)
    return field


def make_samples(count=40, seed=0):
    g = torch.Generator().manual_seed(seed)
    barycentric = torch.rand(count, 3, generator=g)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    return Samples(
        canonical=torch.rand(count, 3, generator=g),
        still=torch.rand(count, 3, generator=g),
        triangle=torch.randint(0, 2, (count,), generator=g, dtype=torch.int32),
        barycentric=barycentric / barycentric.sum(1, keepdim=True),
        distance=torch.rand(count, generator=g) * 0.02,
        appearance=torch.randint(0, 3, (count,), generator=g, dtype=torch.int32),
        frame=torch.randint(0, 2, (count,), generator=g, dtype=torch.int32),
        ray=torch.arange(count, dtype=torch.int32),
        condition=torch.rand(2, 8, generator=g),
        direction=direction,
    )


def avatar(config=TINY):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.2]], np.float32) * 0.2
    triangles = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    uvs = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], np.float32)
    made = Avatar.create(
        config, ["young", "old"], vertices, triangles, uvs, triangles, ("smile", "blink"),
        record={"note": "toy"},
    )  # fmt: skip
    made.occupied[1, 2, 3, 4] = False
    return made


def test_spherical_harmonics_are_orthonormal():
    random = np.random.default_rng(0)
    directions = random.normal(size=(200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    basis = spherical_harmonics(torch.from_numpy(directions)).numpy()
    gram = 4 * np.pi * basis.T @ basis / len(basis)
    np.testing.assert_allclose(gram, np.eye(16), atol=0.03)


@pytest.mark.parametrize("mode", APPEARANCE_MODES)
@pytest.mark.parametrize("offset", [True, False])
def test_every_kind_of_field_answers_and_learns(mode, offset):
    config = dataclasses.replace(TINY, appearance=mode, density_offset=offset, global_channels=6)
    field = make_field(config)
    sigma, rgb = field(make_samples())
    assert sigma.shape == (40,)
    assert rgb.shape == (40, 3)
    assert (sigma > 0).all()
    assert (rgb >= 0).all()
    assert (rgb <= 1).all()
    (sigma.log().sum() + rgb.sum()).backward()
    for name, parameter in field.named_parameters():
        if parameter.numel():
            assert parameter.grad is not None, name
            assert parameter.grad.abs().sum() > 0, name


def test_appearances_differ_in_density_and_colour_except_in_insta():
    samples = make_samples()
    other = dataclasses.replace(samples, appearance=(samples.appearance + 1) % 3)
    for mode in APPEARANCE_MODES:
        field = make_field(dataclasses.replace(TINY, appearance=mode, global_channels=6))
        with torch.no_grad():
            changed = [
                bool((a != b).any()) for a, b in zip(field(samples), field(other), strict=True)
            ]
        assert changed == [mode != "none"] * 2


def test_without_the_offset_density_is_shared():
    field = make_field(dataclasses.replace(TINY, density_offset=False))
    samples = make_samples()
    other = dataclasses.replace(samples, appearance=(samples.appearance + 1) % 3)
    with torch.no_grad():
        assert torch.equal(field(samples)[0], field(other)[0])
        assert not torch.equal(field(samples)[1], field(other)[1])


def test_expression_and_direction_enter_as_the_first_layers_inputs():
    """What is folded into a bias a frame or ray is what concatenating it would give."""
    field = make_field()
    samples = make_samples()
    with torch.no_grad():
        encoded = torch.rand(40, field.encoded_width)
        folded = field.density(encoded, samples.condition, samples.frame)
        weight = torch.cat([field.density.weights[0], field.density.group_weight], 1)
        inputs = torch.cat([encoded, samples.condition[samples.frame.long()]], 1)
        plain = torch.relu(inputs @ weight.T + field.density.biases[0])
        for w, b in list(zip(field.density.weights, field.density.biases, strict=True))[1:-1]:
            plain = torch.relu(plain @ w.T + b)
        plain = plain @ field.density.weights[-1].T + field.density.biases[-1]
    torch.testing.assert_close(folded, plain, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("expression", [False, True])
@pytest.mark.parametrize("turn", [False, True])
def test_a_field_sees_of_a_frame_what_its_settings_say(expression, turn):
    config = dataclasses.replace(TINY, sees_expression=expression, sees_turn=turn)
    field = make_field(config)
    moved = [
        condition(config, np.full(5, smile, np.float32), np.full(3, turned, np.float32))
        for smile, turned in ((0.1, 0.1), (0.9, 0.1), (0.1, 0.9))
    ]
    with torch.no_grad():
        still, smiling, turning = (
            field(dataclasses.replace(make_samples(), condition=torch.stack([c, c])))[0]
            for c in moved
        )
    assert torch.equal(still, smiling) != expression
    assert torch.equal(still, turning) != turn


def test_density_alone_is_the_density_of_the_whole():
    field = make_field()
    with torch.no_grad():
        alone, whole = field.geometry(make_samples())[0], field(make_samples())[0]
    torch.testing.assert_close(alone, whole, rtol=1e-5, atol=0)


def test_extreme_weights_stay_finite():
    field = make_field()
    with torch.no_grad():
        for scale in (1e4, 1e-30):
            for parameter in field.density.parameters():
                parameter.fill_(scale)
            sigma, rgb = field(make_samples())
            assert torch.isfinite(sigma).all()
            assert torch.isfinite(rgb).all()


def test_an_appearance_alone_is_that_appearance():
    field, samples = make_field(), make_samples()
    alone = dataclasses.replace(samples, appearance=torch.full((40,), 2, dtype=torch.int32))
    mixed = dataclasses.replace(samples, appearance=torch.zeros(40, dtype=torch.int32))
    third = field.wearing([2])
    with torch.no_grad():
        for a, b in zip(field(alone), field(mixed, third), strict=True):
            torch.testing.assert_close(a, b)


def test_an_avatar_file_holds_everything(tmp_path):
    made = avatar()
    made.save(tmp_path / "a.pav")
    read = Avatar.load(tmp_path / "a.pav")
    assert read.config == made.config
    assert read.appearances == ["young", "old"]
    assert read.expression_names == ("smile", "blink")
    assert read.record == {"note": "toy"}
    for name in ("canonical_vertices", "triangles", "uvs", "uv_triangles", "box_min", "occupied"):
        np.testing.assert_array_equal(getattr(read, name), getattr(made, name))
    for key, value in made.field.state_dict().items():
        assert torch.equal(read.field.state_dict()[key], value)
    assert read_header(tmp_path / "a.pav")["appearances"] == ["young", "old"]


def test_unknown_appearances_are_told():
    with pytest.raises(InputError, match="young, old"):
        avatar().appearance_index("bald")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("pav") / "a.pav"
    avatar().save(path)
    return path.read_bytes()


@pytest.mark.parametrize("length", [0, 3, 8, 50, 3000, -1])
def test_truncated_avatars_are_told(tmp_path, whole, length):
    (tmp_path / "b.pav").write_bytes(whole[:length])
    with pytest.raises(InputError, match=r"b\.pav") as caught:
        Avatar.load(tmp_path / "b.pav")
    assert "\n" not in str(caught.value)


def test_what_is_no_avatar_is_told(tmp_path):
    for content in (b"hello\n" * 100, b"", struct.pack("<Q", 2**60) + b"{}"):
        (tmp_path / "b.pav").write_bytes(content)
        with pytest.raises(InputError, match="not an avatar"):
            Avatar.load(tmp_path / "b.pav")
    with pytest.raises(InputError, match="no such"):
        Avatar.load(tmp_path / "none.pav")


def edited(whole, change):
    """The file with its JSON header changed; tensors stay."""
    size = struct.unpack("<Q", whole[:8])[0]
    outer = json.loads(whole[8 : 8 + size])
    header = json.loads(outer["__metadata__"]["pav"])
    change(header)
    outer["__metadata__"]["pav"] = json.dumps(header)
    raw = json.dumps(outer).encode()
    raw += b" " * (-len(raw) % 8)
    return struct.pack("<Q", len(raw)) + raw + whole[8 + size :]


@pytest.mark.parametrize(
    "change",
    [
        lambda h: h.update(version=7),
        lambda h: h.update(appearances=["a", "b", "c"]),
        lambda h: h["config"].update(hidden=32),
        lambda h: h["config"].update(levels=1000),
        lambda h: h["config"].update(log2_entries=24),
        lambda h: h["config"].update(occupancy_resolution=4096),
        lambda h: h["config"].update(latent_channels=10**6),
        lambda h: h["config"].update(surprise=1),
        lambda h: h["config"].update(hidden="64"),
        lambda h: h.pop("box_size"),
    ],
)
def test_headers_that_do_not_fit_the_tensors_are_told(tmp_path, whole, change):
    (tmp_path / "b.pav").write_bytes(edited(whole, change))
    with pytest.raises(InputError, match=r"b\.pav") as caught:
        Avatar.load(tmp_path / "b.pav")
    assert "\n" not in str(caught.value)


def test_weights_that_are_not_finite_are_refused_by_name(tmp_path):
    made = avatar()
    with torch.no_grad():
        made.field.tables[5, 1] = float("nan")
    made.save(tmp_path / "b.pav")
    with pytest.raises(InputError, match=r"field\.tables"):
        Avatar.load(tmp_path / "b.pav")


def test_settings_survive_json_and_presets_are_checked():
    assert Config.from_json(json.loads(json.dumps(Config.paper().to_json()))) == Config.paper()
    with pytest.raises(InputError, match="preset"):
        Config.preset("fastest")
    with pytest.raises(InputError, match="appearance"):
        Config(appearance="beard")


def test_weights_that_may_overflow_are_named():
    field = make_field()
    assert overflowing(field) is None
    for name, part in (
        ("tables", "tables"),
        ("latent", "latent"),
        ("density.weights.0", "density"),
        ("offset.weights.1", "offset"),
        ("colour.biases.1", "colour"),
    ):
        for value in (3e38, float("nan"), float("inf")):
            field = make_field()
            with torch.no_grad():
                field.state_dict()[name].view(-1)[0] = value
            assert overflowing(field) == part, (name, value)


def test_weights_that_do_not_overflow_are_finite_whatever_is_asked():
    """Blown up as far as they may be, values of random samples stay finite."""
    field, grown = make_field(), 1.0
    while overflowing(field) is None:
        with torch.no_grad():
            for parameter in field.parameters():
                parameter.mul_(2)
        grown *= 2
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.div_(2)
    assert grown > 1e3
    density, colour = field(make_samples())
    assert density.isfinite().all()
    assert colour.isfinite().all()


@pytest.mark.parametrize("name", ["step", "reach", "learning_rate", "density_bias", "beta1"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_settings_that_are_not_finite_are_named(name, value):
    with pytest.raises(InputError, match=name):
        Config.from_json({name: value})
