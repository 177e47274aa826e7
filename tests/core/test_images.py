import numpy as np
import pytest

from pav_blender.core.errors import InputError
from pav_blender.core.files import replacing
from pav_blender.core.images import (
    read_gray,
    read_metadata,
    read_rgba,
    read_scene_linear,
    write_exr,
    write_gray,
    write_rgba,
)


@pytest.fixture
def pixels():
    return np.random.default_rng(0).integers(0, 256, (17, 23, 4), np.uint8)


def test_bytes_come_back_whatever_the_alpha(tmp_path, pixels):
    write_rgba(tmp_path / "a.png", pixels)
    np.testing.assert_array_equal(read_rgba(tmp_path / "a.png"), pixels)


def test_floats_and_16_bits_round_to_the_same_bytes(tmp_path, pixels):
    write_rgba(tmp_path / "a.png", pixels.astype(np.float32) / 255)
    write_rgba(tmp_path / "b.png", pixels, bits=16)
    np.testing.assert_array_equal(read_rgba(tmp_path / "a.png"), pixels)
    np.testing.assert_array_equal(read_rgba(tmp_path / "b.png"), pixels)


def test_grey_keeps_its_depth(tmp_path):
    grey = np.arange(600, dtype=np.uint16).reshape(20, 30) * 100
    write_gray(tmp_path / "g.png", grey)
    np.testing.assert_array_equal(read_gray(tmp_path / "g.png"), grey)


def test_exr_holds_colour_alpha_and_depth(tmp_path):
    import OpenImageIO as oiio

    rgba = np.random.default_rng(0).random((5, 6, 4), np.float32)
    depth = np.linspace(0.3, 1e10, 30, dtype=np.float32).reshape(5, 6)
    write_exr(tmp_path / "a.exr", rgba, depth, {"pav:appearance": "grey"})
    source = oiio.ImageInput.open(str(tmp_path / "a.exr"))
    spec = source.spec()
    stored = source.read_image("float")
    order = [spec.channelnames.index(c) for c in ("R", "G", "B", "A", "Z")]
    np.testing.assert_allclose(stored[..., order[:4]], rgba, atol=1e-3)
    np.testing.assert_array_equal(stored[..., order[4]], depth)
    assert spec.getattribute("pav:appearance") == "grey"


def test_bad_files_are_told_in_one_line(tmp_path, pixels):
    write_rgba(tmp_path / "a.png", pixels)
    whole = (tmp_path / "a.png").read_bytes()
    (tmp_path / "half.png").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.png").write_text("hello")
    for name in ("half.png", "text.png", "none.png"):
        with pytest.raises(InputError) as caught:
            read_rgba(tmp_path / name)
        assert name in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, pixels):
    write_rgba(tmp_path / "a.png", pixels)
    before = (tmp_path / "a.png").read_bytes()

    def fill():
        with replacing(tmp_path / "a.png") as temporary:
            temporary.write_bytes(b"half a file")
            raise RuntimeError("the disk is full")

    with pytest.raises(RuntimeError):
        fill()
    assert (tmp_path / "a.png").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_pixels_that_are_not_finite_are_told(tmp_path, value):
    rgba = np.full((5, 4, 4), 0.25, np.float32)
    write_exr(tmp_path / "a.exr", rgba)
    np.testing.assert_array_equal(read_scene_linear(tmp_path / "a.exr"), rgba)
    rgba[1, 2, 0] = rgba[1, 2, 1] = rgba[4, 0, 3] = value
    write_exr(tmp_path / "b.exr", rgba)
    with pytest.raises(InputError, match=r"b\.exr: 2 pixels are not finite"):
        read_scene_linear(tmp_path / "b.exr")


def test_texts_that_are_not_utf_8_are_left_out(tmp_path, pixels):
    import OpenImageIO as oiio

    path = tmp_path / "a.tga"
    spec = oiio.ImageSpec(23, 17, 3, "uint8")
    spec.attribute("Artist", "Mueller")
    spec.attribute("Software", "Painter")
    sink = oiio.ImageOutput.create(str(path))
    assert sink.open(str(path), spec)
    assert sink.write_image(pixels[..., :3])
    sink.close()
    assert read_metadata(path)["Artist"] == "Mueller"
    path.write_bytes(path.read_bytes().replace(b"Mueller", b"M\xfcller\0"))
    found = read_metadata(path)
    assert "Artist" not in found
    assert found["Software"].startswith("Painter")
    np.testing.assert_array_equal(read_rgba(path)[..., :3], pixels[..., :3])
